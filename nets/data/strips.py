"""Strips, the Deschaintre file format: `[input |] normal | diffuse | roughness | specular` side by side.

8-bit, normals stored as (n + 1) / 2. The diffuse, roughness and specular of the published sets are linear.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nets.color import linear_to_srgb, srgb_to_linear
from nets.data.images import ROUGHNESS_FLOOR, DataError, decode_normal, grey, read_image, rgb, to_tensor
from nets.data.images import write_image as _write_image
from nets.svbrdf import SVBRDF

__all__ = ["DataError", "Strip", "read_strip", "write_strip"]


@dataclass(frozen=True)
class Strip:
    """What a strip holds.

    Attributes:
        svbrdf: a batch of one.
        input: the photo tile as stored (encoded values in [0, 1]; its curve is the caller's knowledge),
            or None in a strip of four tiles.
    """

    svbrdf: SVBRDF
    input: Float[Tensor, "1 3 h w"] | None


def read_strip(
    path: Path, *, gamma: Literal["linear", "srgb"] = "linear", has_input: bool | None = None
) -> Strip:
    """Read a strip of four or five tiles.

    Args:
        path: the image file.
        gamma: transfer curve of the diffuse and specular tiles; roughness and normals are always linear.
        has_input: whether a photo comes first. None tells it from the shape: a strip five (four) times as
            wide as high has (has no) input. State it for tiles that are not square.

    Returns:
        Maps as `SVBRDF` states them, legal; roughness is the mean of its tile's channels.

    Raises:
        DataError: the file is no image, is truncated, or its width is not four or five tiles.
    """
    pixels, _ = read_image(Path(path))
    height, width = pixels.shape[:2]
    if has_input is None:
        check_square_tiles(path, width, height)
        has_input = width == 5 * height
    count = 5 if has_input else 4
    if width % count:
        raise DataError(f"{path} is {width} pixels wide, which does not divide into {count} tiles")

    tiles = list(rgb(to_tensor(pixels)).chunk(count, dim=3))
    photo = tiles.pop(0).contiguous() if has_input else None
    normal, diffuse, roughness, specular = tiles
    if gamma == "srgb":
        diffuse, specular = srgb_to_linear(diffuse), srgb_to_linear(specular)
    svbrdf = SVBRDF(
        normal=decode_normal(normal),
        diffuse=diffuse.clamp(0.0, 1.0).contiguous(),
        roughness=grey(roughness).clamp(ROUGHNESS_FLOOR, 1.0),
        specular=specular.clamp(0.0, 1.0).contiguous(),
    )
    return Strip(svbrdf, photo)


def check_square_tiles(path: Path, width: int, height: int) -> None:
    """Check that an image has a strip's shape.

    Raises:
        DataError: it is not four or five times as wide as high.
    """
    if height < 1 or width not in (4 * height, 5 * height):
        raise DataError(f"{path} is {width} x {height} pixels, which is not four or five square tiles")


def write_strip(
    path: Path,
    svbrdf: SVBRDF,
    input: Float[Tensor, "1 3 h w"] | None = None,
    *,
    gamma: Literal["linear", "srgb"] = "linear",
) -> None:
    """Write one material as an 8-bit strip; the file appears whole or not at all.

    Args:
        path: where to; the suffix chooses the format (use `.png`).
        svbrdf: a batch of one.
        input: photo tile, encoded values in [0, 1], written as it is.
        gamma: transfer curve to store diffuse and specular with.

    Raises:
        DataError: not exactly one material, a photo of another size, or the file cannot be written.
    """
    if svbrdf.batch != 1:
        raise DataError(f"{path} can hold one material, not {svbrdf.batch}")
    if input is not None and tuple(input.shape) != (1, 3, *svbrdf.size):
        raise DataError(f"{path}: input has shape {tuple(input.shape)}, expected {(1, 3, *svbrdf.size)}")
    diffuse, specular = svbrdf.diffuse, svbrdf.specular
    if gamma == "srgb":
        diffuse, specular = linear_to_srgb(diffuse), linear_to_srgb(specular)
    tiles = [] if input is None else [input]
    tiles += [(svbrdf.normal + 1.0) / 2.0, diffuse, rgb(svbrdf.roughness), specular]
    strip = torch.cat([tile.detach().float().cpu() for tile in tiles], dim=3)[0].clamp(0.0, 1.0)
    _write_image(Path(path), np.rint(strip.permute(1, 2, 0).numpy() * 255.0).astype(np.uint8))
