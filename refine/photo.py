"""Photos in: read any image file or array and make it linear Rec. 709 light, noting what was done.

Nothing here crops, guesses exposure or knows about lights; `files.py` does the decoding.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor
from torch.nn.functional import interpolate

from nets.color import srgb_to_linear
from nets.decoding import Limits
from nets.text import printable
from refine.bands import bands
from refine.color_spaces import CHOICES, SRGB, ColorSpace, embedded_space, to_rec709
from refine.errors import UserError
from refine.files import DecodedImage, decode_image

MINIMUM_SIDE = 16
"""Shortest side of a photo, in pixels."""

NEGATIVE = -1e-4
"""What is below is told to have been negative; less is rounding."""

BRIGHTEST = 1e30
"""Light is clamped here: room for sums of it, far beyond any photo."""

CLIPPED = 254.5 / 255.0
"""Stored value, as a fraction of the format's maximum, from which on a channel counts as clipped."""

ColorSpaceChoice = Literal["auto", "srgb", "linear", "gamma22", "display-p3", "adobe-rgb"]
"""What a caller may say about the colours of a photo; "auto" believes the file."""


@dataclass(frozen=True)
class Photo:
    """One photo in linear light.

    Attributes:
        linear: linear light with Rec. 709 (sRGB) primaries, row 0 at the top; >= 0, and above 1 only
            in float images and in colours outside Rec. 709.
        unsaturated: False where a channel was clipped: at or above `CLIPPED` of the maximum before any
            colour conversion. Linear float images are never clipped.
        notes: what was done to the file, in plain words.
        source: path of the file, or "array".
    """

    linear: Float[Tensor, "1 3 h w"]
    unsaturated: Bool[Tensor, "1 1 h w"]
    notes: tuple[str, ...]
    source: str

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.linear.shape[-2], self.linear.shape[-1]


def read_photo(
    path: Path | str, *, color_space: ColorSpaceChoice = "auto", limits: Limits | None = None
) -> Photo:
    """Read a photo (JPEG, PNG, TIFF, EXR, HDR, ...) and make it linear.

    The EXIF orientation is applied, alpha is dropped, grey becomes three equal channels and embedded
    colour spaces are converted to Rec. 709; `Photo.notes` lists all of it.

    Args:
        path: an image file; its content decides the format, not its extension.
        color_space: "auto" honours the embedded profile or tag, and without one takes integer files as
            sRGB (the piecewise curve) and float files as linear; any other value overrules the file.
        limits: memory and time that the file may take; by default those of `nets.decoder.Limits`.

    Raises:
        UserError: the file cannot be decoded (see `decode_image`), has a side below `MINIMUM_SIDE`, or
            holds NaN or infinity; or `color_space` is unknown.
    """
    source = os.fspath(path)
    chosen = _chosen(color_space)
    decoded = decode_image(path, limits)
    notes = list(decoded.notes)
    colors = _colors(decoded, notes)
    if chosen is None:
        space = embedded_space(decoded, notes)
        notes.append(f"colours read as {space.name}")
    else:
        space = chosen
        notes.append(f"colours read as {space.name}, as asked, whatever the file says")
    return _linear_photo(colors, decoded.size, space, decoded.integer, notes, source)


def photo_from_array(
    array: np.ndarray | Tensor,  # numpy [h, w], [h, w, 1..4]; torch [h, w], [1..4, h, w], [1, 1..4, h, w]
    *,
    color_space: ColorSpaceChoice = "auto",
) -> Photo:
    """Make a photo from an array, row 0 at the top.

    Numpy arrays are height x width x channels (as from Pillow, scikit-image, matplotlib), torch tensors
    channels x height x width. One, two, three or four channels are grey, grey + alpha, RGB, RGB + alpha.

    "auto" takes every array as sRGB-encoded: uint8 over 255, uint16 over 65535, and floats in [0, 1],
    because that is what image libraries hand out. **Linear light must be said**: `color_space="linear"`;
    only then may floats exceed 1, and only linear floats are never counted as clipped.

    Raises:
        UserError: a shape, type or range that does not fit the above, a side below `MINIMUM_SIDE`, NaN
            or infinity, or an unknown `color_space`.
    """
    space = _chosen(color_space)
    pixels, layout = _height_width_channels(array)
    if not 1 <= pixels.shape[-1] <= 4:
        raise UserError(f"The array has shape {tuple(array.shape)}; expected {layout}.")
    notes: list[str] = []
    integer = pixels.dtype in (np.uint8, np.uint16)
    if integer:
        pixels = pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
    elif pixels.dtype.kind == "f":
        pixels = pixels.astype(np.float32)
    else:
        raise UserError(f"The array holds {pixels.dtype}; convert it to uint8, uint16 or float first.")
    if pixels.shape[-1] in (2, 4):
        _note_alpha(float(np.mean(pixels[..., -1] < 1.0)), notes)
        pixels = pixels[..., :-1]
    if pixels.shape[-1] == 1:
        notes.append("grey repeated to three channels")
        pixels = np.repeat(pixels, 3, axis=-1)
    encoded = space is None or space.transfer != 1.0
    if encoded and not integer and np.nanmax(pixels, initial=0.0) > 1.0:
        raise UserError(
            f"The float array reaches {np.nanmax(pixels):.4g} but encoded floats end at 1; "
            'say color_space="linear" for linear light, or divide by its maximum.'
        )
    notes.append(f"{'float' if not integer else 'integer'} array, colours read as {(space or SRGB).name}")
    size = pixels.shape[0], pixels.shape[1]
    return _linear_photo(lambda rows: pixels[rows], size, space or SRGB, integer, notes, "array")


def as_photo(img: str | Path | Photo | np.ndarray | Tensor, color_space: ColorSpaceChoice = "auto") -> Photo:
    """Read a file, take an array, or return a photo as it is; arguments and errors as above."""
    if isinstance(img, Photo):
        return img
    if isinstance(img, str | Path):
        return read_photo(img, color_space=color_space)
    return photo_from_array(img, color_space=color_space)


def resize_photo(photo: Photo, longer_side: int) -> Photo:
    """Shrink a photo so that its longer side has `longer_side` pixels, keeping its aspect.

    Linear light is averaged with an antialiasing triangle filter; a pixel is saturated if any pixel that
    contributes to it is. A photo that is already small enough is returned unchanged, with a note.

    Raises:
        UserError: a side would fall below `MINIMUM_SIDE`.
    """
    height, width = photo.size
    scale = longer_side / max(height, width)
    if scale >= 1.0:
        if scale == 1.0:
            return photo
        return replace(photo, notes=(*photo.notes, f"not enlarged: kept at {width} x {height} pixels"))
    size = (round(height * scale), round(width * scale))
    if min(size) < MINIMUM_SIDE:
        shrunk = f"{photo.source} would shrink to {size[1]} x {size[0]} pixels"
        raise UserError(f"{shrunk}; ask for a larger size, so that both sides keep at least {MINIMUM_SIDE}.")

    def shrink(image: Tensor) -> Tensor:
        return interpolate(image, size, mode="bilinear", align_corners=False, antialias=True)

    linear = shrink(photo.linear).clamp(min=0.0)
    saturated = shrink((~photo.unsaturated).to(photo.linear.dtype))
    note = f"shrunk from {width} x {height} to {size[1]} x {size[0]} pixels in linear light"
    return Photo(linear, saturated <= 0.0, (*photo.notes, note), photo.source)


def _chosen(color_space: str) -> ColorSpace | None:
    """The colour space a caller insists on; None for "auto"."""
    if color_space not in get_args(ColorSpaceChoice):
        choices = ", ".join(get_args(ColorSpaceChoice))
        raise UserError(f"Colour space {color_space!r} is unknown; choose one of {choices}.")
    return CHOICES.get(color_space)


Rows = Callable[[slice], Float32[np.ndarray, "rows w 3"]]
"""Some rows of a picture: a photo is made linear a band at a time, which takes little memory besides."""


def _colors(decoded: DecodedImage, notes: list[str]) -> Rows:
    """Reduce whatever channels a file has to RGB, alpha divided out where it was multiplied in."""
    names = list(decoded.file.channels)
    alpha = names.index("A") if "A" in names else -1  # the header's own index is wrong for GIF
    colors = [index for index in range(len(names)) if index != alpha]
    kept = colors[:3] if len(colors) >= 3 else colors[:1] * 3
    if not colors:
        raise UserError("The picture has no channel but alpha; export it with its colours.")
    divide = False
    if alpha >= 0:
        height, width = decoded.size
        transparent = sum(
            int(np.count_nonzero(decoded.rows(rows)[..., alpha] < 1.0)) for rows in bands(height, width)
        )
        divide = transparent > 0 and not decoded.file.attributes["oiio:UnassociatedAlpha"]
        _note_alpha(transparent / (height * width), notes, divided=divide)
    if len(colors) > 3 or len(colors) == 2:
        used = [names[index] for index in dict.fromkeys(kept)]
        ignored = [names[index] for index in colors if index not in kept]
        notes.append(f"channels {printable(', '.join(ignored))} ignored, {printable(', '.join(used))} used")
    if len(colors) < 3:
        notes.append("grey repeated to three channels")

    def rows_of(rows: slice) -> Float32[np.ndarray, "rows w 3"]:
        pixels = decoded.rows(rows)
        picture = pixels[..., kept]
        if divide:
            opacity = pixels[..., alpha : alpha + 1]
            np.divide(picture, opacity, out=picture, where=(opacity > 0.0) & (opacity < 1.0))
        return picture

    return rows_of


def _note_alpha(transparent: float, notes: list[str], *, divided: bool = False) -> None:
    note = "alpha dropped"
    if transparent > 0.0:
        note += f" ({transparent:.1%} of the pixels were not opaque)"
    notes.append(note + (", colours divided by it" if divided else ""))


def _linear_photo(
    colors: Rows,
    size: tuple[int, int],
    space: ColorSpace,
    integer: bool,
    notes: list[str],
    source: str,
) -> Photo:
    """Check the pixels, mark the clipped ones and take them from `space` to linear Rec. 709."""
    height, width = size
    if min(size) < MINIMUM_SIDE:
        raise UserError(f"{source} has {width} x {height} pixels; both sides need at least {MINIMUM_SIDE}.")
    matrix = None
    if not space.rec709:
        matrix = torch.from_numpy(to_rec709(space.primaries)).float()
    can_clip = integer or space.transfer != 1.0
    linear, unsaturated = torch.empty(1, 3, *size), torch.empty(1, 1, *size, dtype=torch.bool)
    illegal = negative = outside = 0
    for rows in bands(height, width):
        stored = torch.from_numpy(np.ascontiguousarray(colors(rows).transpose(2, 0, 1)))[None]
        illegal += _count(~torch.isfinite(stored))
        saturated = (stored >= CLIPPED).any(dim=1, keepdim=True) & can_clip
        unsaturated[..., rows, :] = ~saturated
        negative += _count(stored < NEGATIVE)
        stored = stored.clamp(min=0.0)
        light = srgb_to_linear(stored) if space.transfer == "srgb" else stored**space.transfer
        if matrix is not None:
            light = torch.einsum("ij,bjhw->bihw", matrix, light)
            outside += _count(light < NEGATIVE)
            light = light.clamp(min=0.0)
        linear[..., rows, :] = light.clamp(max=BRIGHTEST)
    if illegal:
        raise UserError(f"{source} holds NaN or infinity in {illegal} of its pixels; repair or re-export it.")
    for count, what in ((negative, "negative values"), (outside, "colours outside Rec. 709")):
        if count:
            notes.append(f"{what} in {count / (height * width):.1%} of the pixels clamped to 0")
    return Photo(linear, unsaturated, tuple(notes), source)


def _count(flags: Bool[Tensor, "1 3 rows w"]) -> int:
    """Pixels with a flag in any channel."""
    return int(flags.any(dim=1).sum())


def _height_width_channels(array: np.ndarray | Tensor) -> tuple[np.ndarray, str]:
    """View an array as [h, w, channels]; also return, in words, the layout it should have had."""
    if isinstance(array, Tensor):
        layout = "a tensor of (batch of one,) 1 to 4 channels, height, width"
        tensor = array.detach().cpu()
        tensor = tensor.float() if tensor.is_floating_point() else tensor
        if tensor.ndim == 4 and tensor.shape[0] == 1:
            tensor = tensor[0]
        pixels = tensor.numpy()
        pixels = pixels[..., None] if pixels.ndim == 2 else np.moveaxis(pixels, 0, -1)
    else:
        layout = "an array of height, width (, 1 to 4 channels)"
        pixels = array[..., None] if array.ndim == 2 else array
    if pixels.ndim != 3:
        raise UserError(f"The array has shape {tuple(array.shape)}; expected {layout}.")
    return pixels, layout
