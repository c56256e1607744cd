"""A few rows of a photo at a time: what is computed pixel by pixel takes memory for one band only.

Bands do not show in results: every pixel is computed from the same numbers in the same way as if the photo
were one band, and what is summed over bands is summed in float64.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from losses.refinement import photo_distance
from nets.render import (
    PAPER,
    Camera,
    Conventions,
    Geometry,
    PointLight,
    pixel_points,
    shade,
    shading_geometry,
)
from nets.svbrdf import SVBRDF
from refine.capture import Capture

BAND_PIXELS = 2**18
"""Most pixels of a band, but for photos that are wider: whatever has no more than 512 x 512 is one band."""


def bands(height: int, width: int) -> list[slice]:
    """Cut a photo into bands of whole rows, from top to bottom."""
    rows = max(1, BAND_PIXELS // width)
    return [slice(top, min(top + rows, height)) for top in range(0, height, rows)]


def pixel_geometry(
    pixels: Int[Tensor, "h w"],
    size: tuple[int, int],
    light: PointLight | None,
    camera: Camera | None = None,
    conventions: Conventions = PAPER,
    dtype: torch.dtype = torch.float32,
) -> Geometry:
    """Return the shading geometry of some pixels of a photo.

    Args:
        pixels: numbered row by row; their arrangement is that of the result, `[1, C, h, w]`.
        size: height and width of the photo.
        light: of the photo.
        camera: as in `nets.render.render`.
        conventions: as there.
        dtype: of the result.

    Raises:
        ValueError: the light is not known.
    """
    if light is None:
        raise ValueError("the light of a photo is not known; fit it or give it before the stages run")
    points = pixel_points(pixels, *size, grid=conventions.grid, dtype=dtype)
    return shading_geometry(points, light.to(dtype), camera, conventions)


def photo_geometry(capture: Capture, conventions: Conventions = PAPER) -> Geometry:
    """Return the shading geometry of a whole photo, in its type and on its device; errors as above."""
    height, width = capture.photo.shape[-2:]
    pixels = torch.arange(height * width, device=capture.photo.device).reshape(height, width)
    size, dtype = (height, width), capture.photo.dtype
    return pixel_geometry(pixels, size, capture.light, capture.camera, conventions, dtype)


@torch.no_grad()
def render_in_bands(
    svbrdf: SVBRDF, light: PointLight, camera: Camera | None = None
) -> Float[Tensor, "1 3 h w"]:
    """Render one material as `nets.render.render` does, without gradients."""
    rendering = torch.empty_like(svbrdf.diffuse)
    for rows in bands(*svbrdf.size):
        rendering[..., rows, :] = _shade_rows(svbrdf, rows, light, camera)
    return rendering


@torch.no_grad()
def distance_in_bands(svbrdf: SVBRDF, capture: Capture) -> float:
    """Return `losses.refinement.photo_distance` of a material and the photo it explains.

    Raises:
        ValueError: the photo's light is not known.
    """
    height, width = svbrdf.size
    total = 0.0
    for rows in bands(height, width):
        rendering = _shade_rows(svbrdf, rows, capture.light, capture.camera)
        mean = photo_distance(rendering, capture.photo[..., rows, :], capture.unsaturated[..., rows, :])
        total += float(mean) * (rows.stop - rows.start)
    return total / height


def cut(svbrdf: SVBRDF, rows: slice) -> SVBRDF:
    """Return some rows of a material."""
    return svbrdf.map(lambda tensor: tensor[..., rows, :])


def rows_geometry(
    svbrdf: SVBRDF, rows: slice, light: PointLight | None, camera: Camera | None = None
) -> Geometry:
    """Return the shading geometry of some rows of a whole material, in its type and on its device.

    Raises:
        ValueError: the light is not known.
    """
    height, width = svbrdf.size
    pixels = torch.arange(rows.start * width, rows.stop * width, device=svbrdf.normal.device)
    dtype = svbrdf.normal.dtype
    return pixel_geometry(pixels.reshape(-1, width), (height, width), light, camera, dtype=dtype)


def _shade_rows(svbrdf: SVBRDF, rows: slice, light: PointLight | None, camera: Camera | None) -> Tensor:
    return shade(cut(svbrdf, rows), rows_geometry(svbrdf, rows, light, camera))
