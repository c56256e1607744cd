"""Pictures that end-to-end tests run on: a rendered flash photo, and image files of any kind."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch

from nets.color import linear_to_srgb
from nets.render import PointLight, render
from nets.svbrdf import SVBRDF

LIGHT = (0.2, -0.1, 2.0)


def flash_photo(height: int, width: int) -> np.ndarray:
    """Return the sRGB-encoded photo of a bumpy, shiny material, float `[h, w, 3]`."""
    y, x = torch.meshgrid(torch.arange(height) / 10.0, torch.arange(width) / 10.0, indexing="ij")
    slopes = torch.stack([0.3 * torch.sin(x * math.pi), 0.2 * torch.cos(y * math.pi), torch.ones_like(x)])
    flat = SVBRDF.constant(height, width, diffuse=0.3, roughness=0.35, specular=0.05)
    normal = torch.nn.functional.normalize(slopes[None], dim=1)
    material = SVBRDF(normal, flat.diffuse, flat.roughness, flat.specular)
    encoded = linear_to_srgb(render(material, PointLight.at(LIGHT)).clamp(max=1.0))
    return np.ascontiguousarray(encoded[0].permute(1, 2, 0).numpy())


def save_picture(path: Path, pixels: np.ndarray, storage: str = "uint8", **attributes: object) -> Path:
    """Write an image as another program would."""
    pixels = np.atleast_3d(pixels)
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], storage)
    for name, value in attributes.items():
        spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    assert output is not None, oiio.geterror()
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(np.ascontiguousarray(pixels)), output.geterror()
    assert output.close()
    return path
