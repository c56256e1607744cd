"""Which part of a registered video and which of its frames make a scene (paper Sec. 5.2): numerics only.

The paper asks for "crops containing reasonable lighting" and "frames with sufficiently different light
positions". Here reasonable is neither clipped nor dark, and different is told by where the brightness is:
the lights' positions are not known.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from nets.color import luminance
from nets.data.images import resize
from nets.data.pairs import decode_photo, encode_photo

SATURATED = 250
"""8-bit code of the brightest channel from which on a pixel is clipped."""

DARK = 0.01
"""Linear luminance below which a pixel says nothing of its material (8-bit sRGB code 25)."""

WELL_LIT = 0.85
"""Share of a crop that must be neither clipped nor dark in half of the frames."""

MAXIMUM_CLIPPED = 0.15
"""Share of clipped pixels above which a frame of a crop is not used."""

MAXIMUM_DARK = 0.5
"""Share of dark pixels above which a frame of a crop is not used."""

MINIMUM_TEXTURE = 0.002
"""Mean local contrast (deviation over mean, 5 x 5 survey pixels) below which a crop shows nothing."""

SHARPNESS = 0.7
"""Of a frame, as a share of its neighbours' median: below, the camera moved during the exposure."""

LIGHT_CHANGE = 0.1
"""Least difference of two frames' light: RMS difference of the logarithms of their brightness patterns."""

PATTERN = 8
"""Blocks a side of a brightness pattern."""

CROP_SHARES = (1.0, 0.8, 0.6)
"""Sides of crops tried, as shares of the shorter side of what all frames show."""

CROP_OVERLAP = 0.25
"""Share of a crop that may be in another one."""

Box = tuple[float, float, float, float]
"""Centre and half extent of a crop, (x, y, half width, half height), in the first frame's [-1, 1]."""


def find_crops(
    survey: Float[Tensor, "frames 3 h w"],
    room: Bool[Tensor, "h w"],
    count: int,
    smallest: float,
) -> list[Box]:
    """Choose square crops with reasonable lighting, the largest size of which there are as many as asked for.

    Args:
        survey: small registered frames, linear.
        room: where all frames show the surface.
        count: most crops to choose.
        smallest: side of the smallest crop, survey pixels.

    Returns:
        At most `count` crops, the best first; they overlap by at most `CROP_OVERLAP`.
    """
    height, width = room.shape
    grey = luminance(survey)[:, 0]
    clipped = (survey.amax(dim=1) >= decode_photo(torch.full((3, 1, 1), SATURATED).byte())[0, 0, 0]).float()
    poor = ((clipped + (grey < DARK).float()).clamp(max=1.0).mean(dim=0) > 0.5).double()
    typical = grey.quantile(0.5, dim=0)[None, None]
    mean, square = (_box_mean(image, 5) for image in (typical, typical**2))
    texture = ((square - mean**2).clamp(min=0.0).sqrt() / (mean + DARK))[0, 0].double()

    sums = [_integral(image) for image in ((~room).double(), poor, texture)]
    extent = min(int(room.any(dim=1).sum()), int(room.any(dim=0).sum()))
    found: list[list[tuple[int, int, int]]] = [[]]
    for share in CROP_SHARES:
        side = int(share * extent)
        if side < max(smallest, 8.0):
            break
        outside, badly_lit, detail = (_window_means(total, side) for total in sums)
        fits = (outside == 0.0) & (1.0 - badly_lit >= WELL_LIT) & (detail >= MINIMUM_TEXTURE)
        score = torch.where(fits, 1.0 - badly_lit + 0.01 * detail.clamp(max=1.0), torch.zeros_like(detail))
        found.append(_pick(score, side, count))
        if len(found[-1]) == count:
            break
    best = max(found, key=len)  # of equally many the first, which are the largest
    return [
        ((2 * left + s) / width - 1.0, (2 * top + s) / height - 1.0, s / width, s / height)
        for top, left, s in best
    ]


def choose_frames(
    photos: Float[Tensor, "frames 3 size size"], count: int, generator: torch.Generator
) -> list[int]:
    """Choose frames with light as different as can be: farthest points among brightness patterns.

    A pattern is the logarithm of the mean luminance of `PATTERN` x `PATTERN` blocks less its own mean, since
    an automatic exposure is no light. Frames that are clipped, dark or blurred are not chosen.

    Args:
        photos: linear, registered, in the order of the video.
        count: most frames to choose.
        generator: draws the frame from which the first is the farthest.

    Returns:
        Their positions, ascending; each differs from all others by `LIGHT_CHANGE` or more. May be empty.
    """
    grey = luminance(photos)
    codes = encode_photo(photos).amax(dim=1)
    clipped = (codes >= SATURATED).flatten(1).float().mean(dim=1)
    dark = (grey < DARK).flatten(1).float().mean(dim=1)
    good = (clipped <= MAXIMUM_CLIPPED) & (dark <= MAXIMUM_DARK) & _sharp(grey)
    candidates = good.nonzero().flatten().tolist()
    if not candidates:
        return []
    patterns = (resize(grey, PATTERN, PATTERN) + DARK).log().flatten(1)
    patterns = patterns - patterns.mean(dim=1, keepdim=True)
    distance = torch.cdist(patterns, patterns) / PATTERN  # RMS over the blocks
    start = candidates[int(torch.randint(len(candidates), (1,), generator=generator))]
    chosen = [max(candidates, key=lambda row: float(distance[start, row]))]
    while len(chosen) < count:
        nearest = distance[chosen].amin(dim=0)
        row = max(candidates, key=lambda candidate: float(nearest[candidate]))
        if float(nearest[row]) < LIGHT_CHANGE:
            break
        chosen.append(row)
    return sorted(chosen)


def _sharp(grey: Float[Tensor, "frames 1 h w"]) -> Bool[Tensor, "frames"]:
    """Tell frames that are not blurred: as much fine detail as their neighbours, under nearly their light."""
    encoded = (grey + DARK).log()
    kernel = torch.tensor([[0.0, 1.0, 0.0], [1.0, -4.0, 1.0], [0.0, 1.0, 0.0]])[None, None]
    detail = functional.conv2d(encoded, kernel).abs().flatten(1).mean(dim=1)
    padded = functional.pad(detail[None, None], (3, 3), mode="replicate")[0, 0]
    return detail >= SHARPNESS * padded.unfold(0, 7, 1).median(dim=1).values


def _box_mean(image: Float[Tensor, "1 1 h w"], side: int) -> Float[Tensor, "1 1 h w"]:
    return functional.avg_pool2d(image, side, 1, side // 2, count_include_pad=False)


def _integral(image: Float[Tensor, "h w"]) -> Float[Tensor, "rows columns"]:
    return functional.pad(image.cumsum(0).cumsum(1), (1, 0, 1, 0))


def _window_means(integral: Float[Tensor, "rows columns"], side: int) -> Float[Tensor, "tops lefts"]:
    """Return the mean of every square window, by its top left pixel."""
    total = (
        integral[side:, side:] - integral[:-side, side:] - integral[side:, :-side] + integral[:-side, :-side]
    )
    # Differences of sums are exact for counts only, and one stray pixel must not pass as none.
    return torch.where(total < 1e-6, 0.0, total) / side**2


def _pick(score: Float[Tensor, "tops lefts"], side: int, count: int) -> list[tuple[int, int, int]]:
    """Take the best windows in turn that hardly overlap those taken."""
    score = score.clone()
    picked: list[tuple[int, int, int]] = []
    top = torch.arange(score.shape[0])[:, None]
    left = torch.arange(score.shape[1])[None]
    while len(picked) < count and float(score.max()) > 0.0:
        # Of equals the first: a row-major scan from a corner, so that more fit beside it.
        y, x = divmod(int(score.flatten().argmax()), score.shape[1])
        picked.append((y, x, side))
        common = (side - (top - y).abs()).clamp(min=0) * (side - (left - x).abs()).clamp(min=0)
        score[common > CROP_OVERLAP * side**2] = 0.0
    return picked
