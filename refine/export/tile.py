"""Seamless tiling: a material whose opposite borders match, all maps cut and blended alike.

The left and the right border strip are laid over each other. What is coarse is cross-faded over the whole
strip, what is fine is cut along the path where the strips differ least, over all maps together (A. A. Efros
and W. T. Freeman, "Image quilting for texture synthesis and transfer", SIGGRAPH 2001, with two bands of
P. J. Burt and E. H. Adelson, "A multiresolution spline with application to image mosaics", TOG 2(4), 1983).
Then top and bottom, on what already repeats from left to right. The weights are the same for every map, so
what belongs together stays together. Of the overlaps in `OVERLAPS` the one is taken at which the strips agree
best, so that courses of bricks and weaves stay regular.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import uniform_filter
from torch.nn.functional import normalize

from nets.color import gamma_encode
from nets.svbrdf import SVBRDF
from refine.errors import UserError
from refine.maps import SMALLEST_ROUGHNESS

OVERLAPS = (0.1, 0.3)
"""Share of a side that is laid over the opposite border, least and most: what the tile is smaller by."""

SEARCH_SIDE = 512
"""Pixels of a side at which the overlap is chosen."""

COARSE = 0.5
"""Width of the blur that tells coarse from fine, as a share of the overlap; at most two thirds."""

FEATHER = 2
"""Pixels to either side of the cut over which fine detail is faded."""

SMALLEST_SIDE = 32
"""Pixels of a side below which there is nothing to cut through."""

Stack = Float[np.ndarray, "height width channels"]


def make_seamless(svbrdf: SVBRDF) -> SVBRDF:
    """Return a material, smaller by 10 to 30 % (`OVERLAPS`), whose opposite borders match.

    Args:
        svbrdf: one material (a batch of one).

    Raises:
        UserError: a side is shorter than `SMALLEST_SIDE`.
    """
    if min(svbrdf.size) < SMALLEST_SIDE:
        height, width = svbrdf.size
        raise UserError(
            f"A tile needs {SMALLEST_SIDE} pixels a side, the maps are {width} x {height}; "
            "refine at a higher resolution."
        )
    stack = svbrdf.channels()[0].movedim(0, -1).float().cpu().numpy()
    closed = _close(stack, repeats=False)
    closed = _close(closed.swapaxes(0, 1), repeats=True).swapaxes(0, 1)
    channels = torch.from_numpy(np.ascontiguousarray(closed)).movedim(-1, 0)[None].to(svbrdf.normal)
    tile = SVBRDF.from_channels(channels)
    upward = torch.cat([tile.normal[:, :2], tile.normal[:, 2:].clamp(min=0.0)], dim=1)
    return SVBRDF(
        normalize(upward, dim=1),
        tile.diffuse.clamp(0.0, 1.0),
        tile.roughness.clamp(SMALLEST_ROUGHNESS, 1.0),
        tile.specular.clamp(0.0, 1.0),
    )


def _close(stack: Stack, *, repeats: bool) -> Float[np.ndarray, "height narrower channels"]:
    """Make the left border match the right one; `repeats` says whether top and bottom already do."""
    width = stack.shape[1]
    seen = _as_seen(stack)
    overlap = _best_overlap(seen)
    left, right = stack[:, :overlap], stack[:, width - overlap :]
    blur = round(overlap * COARSE)
    coarse_left = _blur(stack[:, : 2 * overlap], blur, repeats=repeats)[:, :overlap]
    coarse_right = _blur(stack[:, width - 2 * overlap :], blur, repeats=repeats)[:, overlap:]
    across = np.arange(overlap)
    ramp = np.clip((across - FEATHER) / (overlap - 1.0 - 2 * FEATHER), 0.0, 1.0)
    fade = (ramp**2 * (3.0 - 2.0 * ramp))[None, :, None]
    cut = _cut(_difference(seen[:, :overlap], seen[:, width - overlap :]), repeats=repeats)
    sharp = np.clip((across[None, :] - cut[:, None]) / (2.0 * FEATHER) + 0.5, 0.0, 1.0)[..., None]
    seam = (
        fade * coarse_left
        + (1.0 - fade) * coarse_right
        + sharp * (left - coarse_left)
        + (1.0 - sharp) * (right - coarse_right)
    )
    return np.concatenate([seam.astype(stack.dtype), stack[:, overlap : width - overlap]], axis=1)


def _blur(strip: Stack, width: int, *, repeats: bool) -> Stack:
    """Blur a strip along both sides of the picture: three box filters, which are nearly a Gaussian."""
    mode = ("wrap" if repeats else "nearest", "nearest", "nearest")
    for _ in range(3):
        strip = uniform_filter(strip, (width, width, 1), mode=mode)
    return strip


def _as_seen(stack: Stack) -> Stack:
    """Encode the colours among the channels as the eye sees them, for comparison."""
    maps = SVBRDF.from_channels(torch.from_numpy(np.ascontiguousarray(stack)).movedim(-1, 0)[None])
    seen = SVBRDF(maps.normal, gamma_encode(maps.diffuse), maps.roughness, gamma_encode(maps.specular))
    encoded: Stack = seen.channels()[0].movedim(0, -1).numpy()
    return encoded


def _best_overlap(stack: Stack) -> int:
    """Return the overlap, in pixels, at which the strips and what a cut through them costs differ least."""
    stride = max(1, max(stack.shape[:2]) // SEARCH_SIDE)
    small = stack[::stride, ::stride]
    width = small.shape[1]
    best, lowest = 0, np.inf
    for overlap in range(round(width * OVERLAPS[0]), round(width * OVERLAPS[1]) + 1):
        cost = _difference(small[:, :overlap], small[:, width - overlap :])
        path = _cheapest(cost)
        score = cost.mean() + cost[np.arange(len(path)), path].mean()
        if score < lowest:
            best, lowest = overlap, score
    return max(best * stride, 4 * FEATHER)


def _difference(left: Stack, right: Stack) -> Float[np.ndarray, "height overlap"]:
    """Squared difference of two strips over all maps."""
    difference: Float[np.ndarray, "height overlap"] = ((left - right) ** 2).sum(axis=-1)
    return difference


def _cut(cost: Float[np.ndarray, "height overlap"], *, repeats: bool) -> Int[np.ndarray, " height"]:
    """Return the column of the cheapest path from top to bottom; one that `repeats` ends where it began."""
    allowed = cost.copy()
    allowed[:, :FEATHER] = allowed[:, cost.shape[1] - FEATHER :] = np.inf
    path = _cheapest(allowed)
    if not repeats:
        return path
    middle = len(path) // 2
    turned = np.roll(allowed, -middle, axis=0)
    closed = np.concatenate([turned, turned[:1]])  # the first row again: there and back
    for row in (0, -1):
        closed[row] = np.inf
        closed[row, path[middle]] = 0.0
    return np.roll(_cheapest(closed)[:-1], middle)


def _cheapest(cost: Float[np.ndarray, "height overlap"]) -> Int[np.ndarray, " height"]:
    """Return the columns of the cheapest path that moves by at most one column a row."""
    total = cost.copy()
    for row in range(1, len(cost)):
        before = np.pad(total[row - 1], 1, constant_values=np.inf)
        total[row] += np.minimum(np.minimum(before[:-2], before[1:-1]), before[2:])
    path = np.empty(len(cost), dtype=np.int64)
    path[-1] = int(total[-1].argmin())
    for row in range(len(cost) - 2, -1, -1):
        low = max(path[row + 1] - 1, 0)
        path[row] = low + int(total[row, low : path[row + 1] + 2].argmin())
    return path
