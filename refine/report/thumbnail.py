"""A small picture of a result for an index of many: photo, material under another light, the four maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from nets.color import linear_to_srgb
from nets.render import PointLight, render
from refine.errors import UserError
from refine.refiner import Refined
from refine.shrinking import shrink

SIDE = 192
"""Of the square that is shown of a result, pixels; a map is half as large."""

NOVEL_LIGHT = (-0.6, 0.6, 1.4)
"""Where the other light is, surface units: from the upper left, as drawings are shaded."""

QUALITY = 88
"""Of the JPEG file."""


def draw_thumbnail(refined: Refined) -> Float[Tensor, "3 192 576"]:
    """Return the picture in [0, 1], sRGB-encoded: photo, rendering, normal over roughness, diffuse over F0.

    Of a result that is not square the middle is shown.
    """
    height, width = refined.svbrdf.size
    scale = min(1.0, SIDE / min(height, width))
    size = round(height * scale), round(width * scale)
    maps = shrink(refined.svbrdf, *size)
    light = PointLight.at(NOVEL_LIGHT).to(maps.normal.device)
    photo = interpolate(refined.capture.photo, size=size, mode="area")
    left = [_square(linear_to_srgb(linear.clamp(0.0, 1.0)), SIDE) for linear in (photo, render(maps, light))]
    columns = [
        torch.cat([_square(above, SIDE // 2), _square(below, SIDE // 2)], dim=1)
        for above, below in (
            (maps.normal * 0.5 + 0.5, maps.roughness.expand(-1, 3, -1, -1)),
            (linear_to_srgb(maps.diffuse), linear_to_srgb(maps.specular)),
        )
    ]
    return torch.cat([*left, *columns], dim=2).clamp(0.0, 1.0).cpu()


def write_thumbnail(path: Path | str, refined: Refined) -> None:
    """Write the picture as JPEG; the same result gives the same bytes.

    Raises:
        UserError: it cannot be written.
    """
    pixels = np.ascontiguousarray(draw_thumbnail(refined).permute(1, 2, 0).float().numpy())
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "uint8")
    spec.attribute("compression", f"jpeg:{QUALITY}")
    spec.attribute("DateTime", "")
    output = oiio.ImageOutput.create(str(path))
    if output is None:
        raise RuntimeError(f"OpenImageIO was built without JPEG: {oiio.geterror()}")
    written = output.open(str(path), spec) and output.write_image(pixels)
    if not (output.close() and written):
        raise UserError(f"Cannot write {path}: {output.geterror().strip()}; make room there.")


def _square(image: Float[Tensor, "1 3 h w"], side: int) -> Float[Tensor, "3 side side"]:
    """Return the middle of an image, at that size."""
    height, width = image.shape[-2:]
    shorter = min(height, width)
    top, left = (height - shorter) // 2, (width - shorter) // 2
    middle = image[..., top : top + shorter, left : left + shorter]
    if shorter == side:
        return middle[0]
    smaller = side < shorter
    resized = interpolate(middle, (side, side), mode="area" if smaller else "nearest-exact")
    return resized[0]
