"""Image files to float arrays and back, and resizing: all pixels on disk that `nets.data` reads pass here.

Values are passed on as stored. No colour conversion happens here; callers state the transfer curve.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nets import decoding
from nets.decoding import DecodingError
from nets.text import printable

NORMAL_Z_FLOOR = 0.02
"""Smallest z of a stored normal: the surface faces the viewer, slopes are at most 50."""

ROUGHNESS_FLOOR = 1.0 / 255.0
"""Smallest roughness a file gives: the first 8-bit step above zero, which is not a legal roughness."""


class DataError(ValueError):
    """A file or folder that cannot be read as what it should be; the message, of one line, names it."""

    def __init__(self, message: str) -> None:
        """Take the message."""
        super().__init__(printable(message))


LISTED = 5
"""Reasons quoted in an error."""


def listed(reasons: Sequence[str]) -> str:
    """Join the first reasons for leaving files out, and say how many more there are."""
    more = len(reasons) - LISTED
    return "; ".join(reasons[:LISTED]) + (f"; and {more} more" if more > 0 else "")


def read_image(path: Path) -> tuple[Float[np.ndarray, "height width channels"], bool]:
    """Read an image file as stored, alpha and further channels dropped.

    Args:
        path: any format OpenImageIO reads.

    Returns:
        The picture, one or three channels, integer formats scaled to [0, 1], with no colour conversion;
        and whether the file stores floating-point numbers (and so linear light, by convention).

    Raises:
        DataError: the file is missing, not an image, truncated, too large, or holds NaN.
    """
    if not path.is_file():
        raise DataError(f"{path} does not exist")
    try:
        file = decoding.decode_file(path)
    except DecodingError as error:
        raise DataError(f"{path} {PROBLEMS[error.kind].format(error.reason)}") from error
    stored = file.pixels[..., : 3 if file.pixels.shape[2] >= 3 else 1]
    array = stored.astype(np.float32)
    if stored.dtype.kind == "u":
        array /= np.float32(np.iinfo(stored.dtype).max)
    if not np.isfinite(array).all():
        raise DataError(f"{path} holds NaN or infinity")
    return array, not file.integer


PROBLEMS = {
    "format": "is not a readable image: {}",
    "damage": "is damaged or truncated: {}",
    "size": "is too large to decode: {}",
    "flat": "is a deep or volume image, not a flat picture",
    "name": "has a name that is not text",
    "memory": "takes too much memory to decode",
    "time": "takes too long to decode",
    "crash": "makes the decoder fail, so it is damaged or forged",
}
"""What is said of a file, by the kind of `DecodingError`."""


def write_image(path: Path, pixels: UInt8[np.ndarray, "height width channels"]) -> None:
    """Write 8-bit pixels as they are; the file appears whole or not at all.

    Raises:
        DataError: the file cannot be written.
    """
    height, width, channels = pixels.shape
    partial = path.with_name(f".{uuid.uuid4().hex}{path.suffix}")
    output = oiio.ImageOutput.create(str(partial))
    if output is None:
        raise DataError(f"{path} cannot be written: {_reason(oiio.geterror())}")
    try:
        spec = oiio.ImageSpec(width, height, channels, "uint8")
        written = output.open(str(partial), spec) and output.write_image(np.ascontiguousarray(pixels))
        reason = output.geterror()
        output.close()
        if not written:
            raise DataError(f"{path} cannot be written: {_reason(reason)}")
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def to_tensor(pixels: Float[np.ndarray, "height width channels"]) -> Float[Tensor, "1 channels height width"]:
    """Turn an HWC array into a batch of one."""
    return torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)))[None]


def rgb(image: Float[Tensor, "1 channels h w"]) -> Float[Tensor, "1 3 h w"]:
    """Repeat a single channel to three; leave three alone."""
    return image.expand(-1, 3, -1, -1) if image.shape[1] == 1 else image


def grey(image: Float[Tensor, "1 channels h w"]) -> Float[Tensor, "1 1 h w"]:
    """Average the channels."""
    return image.mean(dim=1, keepdim=True)


def decode_normal(
    encoded: Float[Tensor, "batch 3 h w"], *, flip_green: bool = False
) -> Float[Tensor, "batch 3 h w"]:
    """Turn `(n + 1) / 2` into unit vectors that face the viewer, +y up.

    Args:
        encoded: values in [0, 1].
        flip_green: the file has +y down (DirectX).
    """
    vectors = encoded * 2.0 - 1.0
    if flip_green:
        vectors = vectors * torch.tensor([1.0, -1.0, 1.0])[:, None, None]
    return unit_normal(vectors)


def unit_normal(vectors: Float[Tensor, "batch 3 h w"]) -> Float[Tensor, "batch 3 h w"]:
    """Normalise, after raising z to `NORMAL_Z_FLOOR`; a zero vector becomes the flat normal."""
    x, y, z = vectors[:, 0:1], vectors[:, 1:2], vectors[:, 2:3].clamp(min=NORMAL_Z_FLOOR)
    inverse = (x * x + y * y + z * z).rsqrt()  # much faster than a norm along the channels
    return torch.cat([x * inverse, y * inverse, z * inverse], dim=1)


def resize(
    image: Float[Tensor, "batch channels h w"], height: int, width: int
) -> Float[Tensor, "batch channels height width"]:
    """Resize linear values: exact area averages when shrinking, bilinear when enlarging, per axis."""
    if image.shape[-2:] == (height, width):
        return image
    rows = _axis_weights(image.shape[-2], height)
    columns = _axis_weights(image.shape[-1], width)
    return rows @ image @ columns.T


def _axis_weights(source: int, target: int) -> Float[Tensor, "target source"]:
    """Return the weight of each source pixel in each target pixel; rows sum to one."""
    index = torch.arange(source, dtype=torch.float64)[None]
    if target < source:
        start = torch.arange(target, dtype=torch.float64)[:, None] * source / target
        weights = torch.minimum(index + 1, start + source / target) - torch.maximum(index, start)
    else:
        centre = (torch.arange(target, dtype=torch.float64)[:, None] + 0.5) * source / target - 0.5
        weights = 1.0 - (index - centre.clamp(0, source - 1)).abs()
    weights = weights.clamp(min=0.0)
    return (weights / weights.sum(dim=1, keepdim=True)).float()


def _reason(message: str) -> str:
    """Return the first line of an OpenImageIO message, without a final stop."""
    return (message.strip().splitlines() or ["no reason given"])[0].rstrip(".")
