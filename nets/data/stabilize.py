"""Registers the frames of a video of a flat surface to its first, though the light moves (paper Sec. 5.2).

The mathematics only: frames in, homographies out. Decoding, choosing and writing: `nets.data.videos`.

A plane seen by a moving camera moves by a homography. What must not count as motion is the light: frames are
compared after local contrast normalisation, which takes a highlight's slow brightness away; pixels that
still disagree are weighed down (Tukey's biweight); and each frame is compared with the mean of all frames
registered before it, since shading turns around with the light but colour and structure stay. The comparison
is minimised by the inverse compositional algorithm of Baker and Matthews (2004): Gauss-Newton on the
template's gradients, coarse to fine, started from the frame before.

Homographies map normalised coordinates of the first frame to those of another: (x, y, 1), both in [-1, 1]
from edge to edge, x right, y down. So they hold at any resolution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from nets.data.images import resize

LEVELS = 4
"""Of the pyramid, each half the size of the one before."""

MODELS = ("translation", "affine", "homography", "homography")
"""What may move per level, coarse to fine: the coarse ones show too little for eight parameters."""

PARAMETERS = {"translation": (2, 5), "affine": (0, 1, 2, 3, 4, 5), "homography": (0, 1, 2, 3, 4, 5, 6, 7)}
"""Entries of the row-major homography that move, by model."""

ITERATIONS = 25
"""Most Gauss-Newton steps per level."""

CONVERGED = 0.01
"""Pixels of the level: a step that moves no corner further ends a level."""

CONTRAST_RADIUS = 4.0
"""Standard deviation of the Gaussian window of local contrast, pixels of the level."""

CONTRAST_FLOOR = 0.01
"""Encoded luminance: weaker contrast is noise and is not blown up to full strength."""

SATURATED = 0.97
"""Encoded luminance from which on a pixel shows no structure."""

BIWEIGHT = 4.685
"""Tukey's constant, in robust standard deviations: 95 % efficient if the noise is normal."""

DAMPING = 1e-4
"""Share of the mean curvature added to all: a stripe pattern says nothing of its own direction."""

MINIMUM_CORRELATION = 0.4
"""Weighted correlation with the mean of other frames below which a frame counts as lost."""

MAXIMUM_DRIFT = 0.004
"""Shares of the longer side by which the two passes may disagree at a corner: else a frame counts as lost."""

_CORNERS = torch.tensor(
    [[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [-1.0, 1.0, 1.0], [1.0, 1.0, 1.0]], dtype=torch.float64
)


@dataclass(frozen=True)
class Stabilization:
    """Where the first frame's points are in every frame.

    Attributes:
        homographies: from normalised coordinates of the first frame to each frame's; the first is identity.
        correlation: of each registered frame with the mean of the others, local contrasts, [-1, 1].
        reliable: frames that correlate well enough and on which two passes agree.
    """

    homographies: Float[Tensor, "frames 3 3"]
    correlation: Float[Tensor, "frames"]
    reliable: Bool[Tensor, "frames"]


def warp(
    image: Float[Tensor, "1 channels h w"],
    homography: Float[Tensor, "3 3"],
    height: int,
    width: int,
    *,
    mode: str = "bilinear",
) -> Float[Tensor, "1 channels height width"]:
    """Sample a frame where the first frame's pixels are in it.

    Args:
        image: any values; of any size, since coordinates are normalised.
        homography: from the first frame to this one.
        height: of the result, pixels.
        width: of the result, pixels.
        mode: `bilinear` or `bicubic`, as torch's `grid_sample`.

    Returns:
        The frame as the first frame's camera would have seen it; 0 outside.
    """
    points = _pixel_centres(height, width) @ homography.T
    depth = points[:, 2:].clamp(min=1e-6)
    grid = (points[:, :2] / depth).reshape(1, height, width, 2).to(image.dtype)
    return functional.grid_sample(image, grid, mode=mode, padding_mode="zeros", align_corners=False)


def corner_motion(
    first: Float[Tensor, "*batch 3 3"], second: Float[Tensor, "*batch 3 3"], height: int, width: int
) -> Float[Tensor, "*batch"]:
    """Return how far apart two homographies put the corners: the largest distance of the four, pixels."""

    def corners(homography: Tensor) -> Tensor:
        points = _CORNERS @ homography.double().transpose(-1, -2)
        return points[..., :2] / points[..., 2:]

    half = torch.tensor([width / 2.0, height / 2.0], dtype=torch.float64)
    return torch.linalg.vector_norm((corners(first) - corners(second)) * half, dim=-1).amax(dim=-1)


def normalize_contrast(
    luminance: Float[Tensor, "1 1 h w"],
) -> tuple[Float[Tensor, "1 1 h w"], Float[Tensor, "1 1 h w"]]:
    """Take the local mean away and divide by the local contrast, in a Gaussian window.

    Args:
        luminance: encoded (sRGB or gamma), [0, 1].

    Returns:
        Local contrast, about zero mean and unit variance where there is structure; and weights in [0, 1]:
        0 where the frame is saturated.
    """
    weight = (luminance < SATURATED).to(luminance.dtype)
    # A window that looks across a highlight's edge would see nothing but that edge.
    share = _blur(weight).clamp(min=1e-3)
    mean = _blur(luminance * weight) / share
    variance = (_blur(luminance**2 * weight) / share - mean**2).clamp(min=0.0)
    contrast = (luminance - mean) / (variance + CONTRAST_FLOOR**2).sqrt()
    return contrast * weight, weight * (share - 0.5).clamp(min=0.0) * 2.0


def stabilize(frames: Sequence[Float[Tensor, "1 1 h w"]]) -> Stabilization:
    """Register every frame to the first, in two passes.

    The first pass goes through the frames in order and compares each with the mean of those before it. The
    second compares each with the mean of all others, which holds every light. Where the passes disagree, or a
    frame looks unlike the mean, registration is not to be trusted.

    Args:
        frames: encoded luminance in [0, 1], all of one size, at least 64 pixels a side; about 480 pixels are
            enough for a tenth of a pixel.

    Returns:
        One homography per frame.
    """
    pyramids = [_pyramid(frame) for frame in frames]
    height, width = frames[0].shape[-2:]
    identity = torch.eye(3, dtype=torch.float64)

    found, joined, mean = [identity], [True], _Mean()
    mean.add(pyramids[0], identity)
    for pyramid in pyramids[1:]:
        homography, correlation = _register(mean.levels(), pyramid, found[-1])
        joined.append(correlation >= MINIMUM_CORRELATION)
        if joined[-1]:
            mean.add(pyramid, homography)
        # A lost frame must not lead the next ones astray.
        found.append(homography if joined[-1] else found[-1])

    refined, correlations = [], []
    for pyramid, start, inside in zip(pyramids, found, joined, strict=True):
        # Without the frame itself: a mean that holds it where it is wrong would say that it is right.
        mean.add(pyramid, start, -1.0 * inside)
        homography, correlation = _register(mean.levels(), pyramid, start, levels=2)
        mean.add(pyramid, start, 1.0 * inside)
        refined.append(homography)
        correlations.append(correlation)
    drift = corner_motion(torch.stack(refined), torch.stack(found), height, width) / max(height, width)
    # The mean has its own idea of where the first frame is, since it has seen other lights: go back.
    back = torch.linalg.inv(refined[0])
    homographies = torch.stack([_unit(homography @ back) for homography in refined])
    likeness = torch.tensor(correlations, dtype=torch.float64)
    reliable = (likeness >= MINIMUM_CORRELATION) & (drift <= MAXIMUM_DRIFT)
    return Stabilization(homographies, likeness, reliable)


Pyramid = list[tuple[Tensor, Tensor]]
"""Local contrast and weight per level, coarse to fine, [1,1,h,w] each."""


class _Mean:
    """The weighted mean of registered frames, per level of their pyramids."""

    def __init__(self) -> None:
        self._sums: Pyramid = []

    def add(self, pyramid: Pyramid, homography: Tensor, times: float = 1.0) -> None:
        registered = [_registered(level, homography) for level in pyramid]
        terms = [(times * contrast * weight, times * weight) for contrast, weight in registered]
        if not self._sums:
            self._sums = terms
        else:
            self._sums = [(a + c, b + d) for (a, b), (c, d) in zip(self._sums, terms, strict=True)]

    def levels(self) -> Pyramid:
        return [
            (total / weight.clamp(min=1e-6), weight / weight.amax().clamp(min=1e-6))
            for total, weight in self._sums
        ]


def _register(template: Pyramid, frame: Pyramid, start: Tensor, levels: int = LEVELS) -> tuple[Tensor, float]:
    """Register a frame from a first guess; return the homography and the correlation it reaches."""
    homography = start
    if levels == LEVELS:
        homography = _leap(template[0], frame[0], start)
    for level in range(LEVELS - levels, LEVELS):
        homography = _descend(template[level], frame[level], homography, MODELS[level])
    return homography, _correlation(template[-1], _registered(frame[-1], homography))


def _leap(template: tuple[Tensor, Tensor], frame: tuple[Tensor, Tensor], start: Tensor) -> Tensor:
    """Return the start, or the start after the translation of phase correlation if that correlates better.

    Gauss-Newton sees as far as the structure is wide, which is a few pixels; a jolt is more.
    """
    now = _registered(frame, start)
    height, width = now[0].shape[-2:]
    window = torch.outer(*(torch.hann_window(size, periodic=False) for size in (height, width)))
    spectra = [torch.fft.rfft2((level[0] * level[1])[0, 0] * window) for level in (template, now)]
    cross = spectra[1] * spectra[0].conj()
    peak = int(torch.fft.irfft2(cross / cross.abs().clamp(min=1e-9), s=(height, width)).argmax())
    down, right = peak // width, peak % width
    down, right = down - height * (down > height // 2), right - width * (right > width // 2)
    shift = torch.eye(3, dtype=torch.float64)
    shift[0, 2], shift[1, 2] = 2.0 * right / width, 2.0 * down / height
    leapt = _unit(start @ shift)
    if _correlation(template, _registered(frame, leapt)) > _correlation(template, now) + 0.05:
        return leapt
    return start


def _descend(
    template: tuple[Tensor, Tensor], frame: tuple[Tensor, Tensor], homography: Tensor, model: str
) -> Tensor:
    """Minimise the robust difference of one level over one motion model: inverse compositional steps."""
    target, target_weight = template
    height, width = target.shape[-2:]
    free = list(PARAMETERS[model])
    steepest = _steepest_descent(target)[:, free]
    for _ in range(ITERATIONS):
        seen, seen_weight = _registered(frame, homography)
        weight = (target_weight * seen_weight).flatten()
        residual = _matched(seen.flatten(), target.flatten(), weight) - target.flatten()
        weight = weight * _biweight(residual, weight)
        weighted = steepest * weight[:, None]
        curvature = weighted.T.double() @ steepest.double()
        curvature = curvature + DAMPING * curvature.diagonal().mean().clamp(min=1e-9) * torch.eye(len(free))
        step = torch.zeros(9, dtype=torch.float64)
        step[free] = torch.linalg.solve(curvature, weighted.T.double() @ residual.double())
        change = torch.eye(3, dtype=torch.float64) + step.reshape(3, 3)
        moved = _unit(homography @ torch.linalg.inv(change))
        motion = float(corner_motion(homography, moved, height, width))
        if not motion < 0.25 * max(height, width):  # lost, or NaN: what was found before is the best there is
            return homography
        homography = moved
        if motion < CONVERGED:
            break
    return homography


def _steepest_descent(template: Tensor) -> Float[Tensor, "pixels 9"]:
    """Return the template's derivative by each entry of a homography, at the identity."""
    height, width = template.shape[-2:]
    padded = functional.pad(template, (1, 1, 1, 1), mode="replicate")
    by_x = ((padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) / 2.0 * (width / 2.0)).flatten()
    by_y = ((padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) / 2.0 * (height / 2.0)).flatten()
    x, y, one = _pixel_centres(height, width).float().unbind(dim=1)
    inward = -(x * by_x + y * by_y)  # the third row divides: it moves every point along its own radius
    columns = [
        x * by_x,
        y * by_x,
        one * by_x,
        x * by_y,
        y * by_y,
        one * by_y,
        x * inward,
        y * inward,
        one * 0.0,
    ]
    return torch.stack(columns, dim=1)


def _matched(values: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Scale values to the target's spread: a mean of many lights has less contrast than each of them."""
    spread = (weight * values**2).sum().clamp(min=1e-9)
    return values * ((weight * target**2).sum() / spread).sqrt()


def _biweight(residual: Tensor, weight: Tensor) -> Tensor:
    """Return Tukey's weights, the scale taken from the median absolute residual."""
    inside = residual[weight > 0.0].abs()
    if len(inside) == 0:
        return torch.zeros_like(residual)
    scale = BIWEIGHT * 1.4826 * inside.median().clamp(min=1e-6)
    return (1.0 - (residual / scale) ** 2).clamp(min=0.0) ** 2


def _registered(level: tuple[Tensor, Tensor], homography: Tensor) -> tuple[Tensor, Tensor]:
    """Warp local contrast and weight; what the frame does not show has weight 0."""
    height, width = level[0].shape[-2:]
    both = warp(torch.cat(level, dim=1), homography, height, width)
    return both[:, :1], both[:, 1:]


def _correlation(template: tuple[Tensor, Tensor], seen: tuple[Tensor, Tensor]) -> float:
    weight = template[1] * seen[1]
    if float(weight.sum()) < 0.2 * weight.numel():  # too little in common to tell
        return -1.0
    a, b = template[0], seen[0]
    norm = ((weight * a**2).sum() * (weight * b**2).sum()).sqrt().clamp(min=1e-9)
    return float((weight * a * b).sum() / norm)


def _pyramid(luminance: Float[Tensor, "1 1 h w"]) -> Pyramid:
    height, width = luminance.shape[-2:]
    sizes = [(round(height / 2**n), round(width / 2**n)) for n in reversed(range(LEVELS))]
    return [normalize_contrast(resize(luminance, *size)) for size in sizes]


def _blur(image: Tensor) -> Tensor:
    radius = int(2.5 * CONTRAST_RADIUS)
    taps = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / CONTRAST_RADIUS) ** 2)
    taps = (taps / taps.sum()).to(image.dtype)
    padded = functional.pad(image, (radius,) * 4, mode="replicate")
    return functional.conv2d(functional.conv2d(padded, taps[None, None, :, None]), taps[None, None, None, :])


def _pixel_centres(height: int, width: int) -> Float[Tensor, "pixels 3"]:
    """Return normalised homogeneous coordinates of all pixel centres."""
    y = (torch.arange(height, dtype=torch.float64) * 2.0 + 1.0) / height - 1.0
    x = (torch.arange(width, dtype=torch.float64) * 2.0 + 1.0) / width - 1.0
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([columns, rows, torch.ones_like(rows)], dim=-1).reshape(-1, 3)


def _unit(homography: Tensor) -> Tensor:
    return homography / homography[2, 2]
