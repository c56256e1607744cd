"""A material at fewer pixels, for pictures of it: each pixel the mean of those it covers."""

from __future__ import annotations

from torch.nn.functional import interpolate, normalize

from nets.svbrdf import SVBRDF


def shrink(svbrdf: SVBRDF, height: int, width: int) -> SVBRDF:
    """Average maps down to a size; normals are made unit vectors again.

    Returns:
        A legal material; the very same one if it has that size.

    Raises:
        ValueError: a side would grow.
    """
    if svbrdf.size == (height, width):
        return svbrdf
    if not (0 < height <= svbrdf.size[0] and 0 < width <= svbrdf.size[1]):
        raise ValueError(f"maps of {svbrdf.size} cannot be shrunk to {(height, width)}")
    small = svbrdf.map(lambda tensor: interpolate(tensor, size=(height, width), mode="area"))
    return SVBRDF(normalize(small.normal, dim=1), small.diffuse, small.roughness, small.specular).validate()


def within(size: tuple[int, int], longest: int) -> tuple[int, int]:
    """Return the size of a picture whose longer side is `longest`, or its own if that is shorter."""
    scale = min(1.0, longest / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
