"""Photos in: read any image file or array and make it linear Rec. 709 light, noting what was done.

Nothing here crops, guesses exposure or knows about lights; `files.py` does the decoding.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor
from torch.nn.functional import interpolate

from nets.color import srgb_to_linear
from refine.errors import UserError
from refine.files import DecodedImage, decode_image

MINIMUM_SIDE = 16
"""Shortest side of a photo, in pixels."""

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


@dataclass(frozen=True)
class _ColorSpace:
    """A transfer curve ("srgb" or the exponent of a power law) and RGB chromaticities."""

    name: str
    transfer: Literal["srgb"] | float
    primaries: tuple[float, ...]  # x, y of red, green, blue and white


_PRIMARIES = {  # in the spelling of the colour interop identifiers that OpenImageIO reports
    "rec709": (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290),
    "p3d65": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290),
    "adobergb": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290),
    "rec2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290),
    "romm": (0.734699, 0.265301, 0.159597, 0.840403, 0.036598, 0.000105, 0.345704, 0.358540),
    "ap1": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
    "ap0": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, 0.32168, 0.33767),
}
_TRANSFERS: dict[str, Literal["srgb"] | float] = {
    "srgb": "srgb",
    "lin": 1.0,
    "g18": 1.8,
    "g22": 2.2,
    "g24": 2.4,
}
_SRGB = _ColorSpace("sRGB", "srgb", _PRIMARIES["rec709"])
_LINEAR = _ColorSpace("linear Rec. 709", 1.0, _PRIMARIES["rec709"])
_DISPLAY_P3 = _ColorSpace("Display P3", "srgb", _PRIMARIES["p3d65"])
_ADOBE_RGB = _ColorSpace("Adobe RGB (1998)", 563.0 / 256.0, _PRIMARIES["adobergb"])
_CHOICES = {
    "srgb": _SRGB,
    "linear": _LINEAR,
    "gamma22": _ColorSpace("gamma 2.2", 2.2, _PRIMARIES["rec709"]),
    "display-p3": _DISPLAY_P3,
    "adobe-rgb": _ADOBE_RGB,
}
_PROFILES = {  # what an ICC profile's description contains, in lower case -> what the profile means
    "display p3": _DISPLAY_P3,
    "adobe rgb": _ADOBE_RGB,
    "prophoto": _ColorSpace("ProPhoto RGB", 1.8, _PRIMARIES["romm"]),
    "srgb": _SRGB,
    "urgb": _SRGB,
    "gray gamma 2.2": _CHOICES["gamma22"],
}
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def read_photo(path: Path | str, *, color_space: ColorSpaceChoice = "auto") -> Photo:
    """Read a photo (JPEG, PNG, TIFF, EXR, HDR, ...) and make it linear.

    The EXIF orientation is applied, alpha is dropped, grey becomes three equal channels and embedded
    colour spaces are converted to Rec. 709; `Photo.notes` lists all of it.

    Args:
        path: an image file; its content decides the format, not its extension.
        color_space: "auto" honours the embedded profile or tag, and without one takes integer files as
            sRGB (the piecewise curve) and float files as linear; any other value overrules the file.

    Raises:
        UserError: the file cannot be decoded (see `decode_image`), has a side below `MINIMUM_SIDE`, or
            holds NaN or infinity; or `color_space` is unknown.
    """
    source = os.fspath(path)
    chosen = _chosen(color_space)
    decoded = decode_image(path)
    notes = list(decoded.notes)
    pixels = _to_rgb(decoded, notes)
    if chosen is None:
        space = _embedded_space(decoded, notes)
        notes.append(f"colours read as {space.name}")
    else:
        space = chosen
        notes.append(f"colours read as {space.name}, as asked, whatever the file says")
    return _linear_photo(pixels, space, decoded.integer, notes, source)


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
    pixels = _drop_alpha(pixels, {2: 1, 4: 3}.get(pixels.shape[-1], -1), notes)
    if pixels.shape[-1] == 1:
        notes.append("grey repeated to three channels")
        pixels = np.repeat(pixels, 3, axis=-1)
    encoded = space is None or space.transfer != 1.0
    if encoded and not integer and np.nanmax(pixels, initial=0.0) > 1.0:
        raise UserError(
            f"The float array reaches {np.nanmax(pixels):.4g} but encoded floats end at 1; "
            'say color_space="linear" for linear light, or divide by its maximum.'
        )
    notes.append(f"{'float' if not integer else 'integer'} array, colours read as {(space or _SRGB).name}")
    return _linear_photo(pixels, space or _SRGB, integer, notes, "array")


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


def _chosen(color_space: str) -> _ColorSpace | None:
    """The colour space a caller insists on; None for "auto"."""
    if color_space not in get_args(ColorSpaceChoice):
        choices = ", ".join(get_args(ColorSpaceChoice))
        raise UserError(f"Colour space {color_space!r} is unknown; choose one of {choices}.")
    return _CHOICES.get(color_space)


def _to_rgb(decoded: DecodedImage, notes: list[str]) -> Float32[np.ndarray, "h w 3"]:
    """Reduce whatever channels a file has to RGB."""
    spec = decoded.spec
    names = list(spec.channelnames)
    alpha = names.index("A") if "A" in names else -1  # the header's own index is wrong for GIF
    if alpha >= 0:
        del names[alpha]
    associated = not spec.get_int_attribute("oiio:UnassociatedAlpha", 0)
    pixels = _drop_alpha(decoded.pixels, alpha, notes, associated=associated)
    kept = 3 if len(names) >= 3 else 1
    if len(names) > kept:
        notes.append(f"channels {', '.join(names[kept:])} ignored, {', '.join(names[:kept])} used")
    if kept == 3:
        return pixels[..., :3]
    notes.append("grey repeated to three channels")
    return np.repeat(pixels[..., :1], 3, axis=-1)


def _drop_alpha(
    pixels: Float32[np.ndarray, "h w channels"], index: int, notes: list[str], *, associated: bool = False
) -> Float32[np.ndarray, "h w fewer"]:
    """Remove the alpha channel, first dividing colours that had been multiplied by it."""
    if index < 0:
        return pixels
    alpha = pixels[..., index : index + 1]
    colors = np.delete(pixels, index, axis=-1)
    transparent = float(np.mean(alpha < 1.0))
    note = "alpha dropped"
    if transparent > 0.0:
        note += f" ({transparent:.1%} of the pixels were not opaque)"
        if associated:
            colors = np.divide(colors, alpha, out=colors, where=(alpha > 0.0) & (alpha < 1.0))
            note += ", colours divided by it"
    notes.append(note)
    return colors


def _embedded_space(decoded: DecodedImage, notes: list[str]) -> _ColorSpace:
    """What the file says about its colours: ICC profile, EXR chromaticities, tags, then habit."""
    spec = decoded.spec
    fallback = _SRGB if decoded.integer else _LINEAR
    description = spec.getattribute("ICCProfile:profile_description")
    if description or spec.getattribute("ICCProfile") is not None:
        lowered = str(description).lower()
        for key, space in _PROFILES.items():
            if key in lowered:
                return replace(space, name=str(description), transfer=1.0) if "linear" in lowered else space
        notes.append(f"colour profile {description or 'without a name'!r} not understood, ignored")
        return fallback
    chromaticities = spec.getattribute("chromaticities")
    if chromaticities is not None and len(chromaticities) == 8:
        return _ColorSpace("linear light with the file's own chromaticities", 1.0, tuple(chromaticities))
    tag = str(spec.getattribute("oiio:ColorSpace") or "")
    transfer, _, rest = tag.partition("_")
    primaries = rest.partition("_")[0]
    if transfer in _TRANSFERS and primaries in _PRIMARIES:
        exif = spec.get_int_attribute("Exif:ColorSpace", 1)
        if (transfer, primaries, exif) == ("srgb", "rec709", 2):
            return _ADOBE_RGB
        if exif == 65535:
            notes.append("the camera calls the colours uncalibrated but embeds no profile")
        tagged = _ColorSpace(tag, _TRANSFERS[transfer], _PRIMARIES[primaries])
        return next(
            (known for known in (_SRGB, _LINEAR) if known == replace(tagged, name=known.name)), tagged
        )
    if tag:
        notes.append(f"colour space {tag!r} not understood, ignored")
    return fallback


def _linear_photo(
    pixels: Float32[np.ndarray, "h w 3"], space: _ColorSpace, integer: bool, notes: list[str], source: str
) -> Photo:
    """Check the pixels, mark the clipped ones and take them from `space` to linear Rec. 709."""
    height, width = pixels.shape[:2]
    if min(height, width) < MINIMUM_SIDE:
        raise UserError(f"{source} has {width} x {height} pixels; both sides need at least {MINIMUM_SIDE}.")
    bad = int(np.count_nonzero(~np.isfinite(pixels).all(axis=-1)))
    if bad:
        raise UserError(f"{source} holds NaN or infinity in {bad} of its pixels; repair or re-export it.")
    stored = torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)))[None]
    can_clip = integer or space.transfer != 1.0
    saturated = (stored >= CLIPPED).any(dim=1, keepdim=True) & can_clip
    stored = _without_negatives(stored, "negative values", notes)
    linear = srgb_to_linear(stored) if space.transfer == "srgb" else stored**space.transfer
    if space.primaries != _PRIMARIES["rec709"]:
        matrix = torch.from_numpy(_to_rec709(space.primaries)).to(linear)
        linear = torch.einsum("ij,bjhw->bihw", matrix, linear)
        linear = _without_negatives(linear, "colours outside Rec. 709", notes)
    return Photo(linear, ~saturated, tuple(notes), source)


def _without_negatives(
    image: Float[Tensor, "1 3 h w"], what: str, notes: list[str]
) -> Float[Tensor, "1 3 h w"]:
    """Clamp at 0 and note it when that changes more than rounding."""
    share = float((image < -1e-4).any(dim=1).float().mean())
    if share > 0.0:
        notes.append(f"{what} in {share:.1%} of the pixels clamped to 0")
    return image.clamp(min=0.0)


def _to_rec709(primaries: Sequence[float]) -> np.ndarray:  # [3, 3]
    """Matrix from linear RGB of some chromaticities to Rec. 709, Bradford-adapted to its white."""

    def to_xyz(chromaticities: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        x, y = np.array(chromaticities, dtype=np.float64).reshape(4, 2).T
        columns = np.stack([x / y, np.ones(4), (1.0 - x - y) / y])
        white = columns[:, 3]
        return columns[:, :3] * np.linalg.solve(columns[:, :3], white), white

    source, source_white = to_xyz(primaries)
    target, target_white = to_xyz(_PRIMARIES["rec709"])
    gain = (_BRADFORD @ target_white) / (_BRADFORD @ source_white)
    adapt = np.linalg.solve(_BRADFORD, gain[:, None] * _BRADFORD)
    return np.linalg.solve(target, adapt @ source)


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
