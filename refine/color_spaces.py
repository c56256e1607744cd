"""What colours mean: transfer curves, primaries, and what a file says of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64

from nets.text import printable
from refine.files import DecodedImage

LARGEST_COEFFICIENT = 1e3
"""Of a conversion of colours: primaries that need more are no primaries."""


@dataclass(frozen=True)
class ColorSpace:
    """How RGB values mean light.

    Attributes:
        name: for people.
        transfer: "srgb" for the piecewise curve, or the exponent of a power law.
        primaries: chromaticities x, y of red, green, blue and white.
    """

    name: str
    transfer: Literal["srgb"] | float
    primaries: tuple[float, ...]

    @property
    def rec709(self) -> bool:
        """Whether its primaries are those of Rec. 709 already."""
        return self.primaries == _PRIMARIES["rec709"]


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
SRGB = ColorSpace("sRGB", "srgb", _PRIMARIES["rec709"])
LINEAR = ColorSpace("linear Rec. 709", 1.0, _PRIMARIES["rec709"])
_DISPLAY_P3 = ColorSpace("Display P3", "srgb", _PRIMARIES["p3d65"])
_ADOBE_RGB = ColorSpace("Adobe RGB (1998)", 563.0 / 256.0, _PRIMARIES["adobergb"])
CHOICES = {
    "srgb": SRGB,
    "linear": LINEAR,
    "gamma22": ColorSpace("gamma 2.2", 2.2, _PRIMARIES["rec709"]),
    "display-p3": _DISPLAY_P3,
    "adobe-rgb": _ADOBE_RGB,
}
"""By the names a caller may give."""

_PROFILES = {  # what an ICC profile's description contains, in lower case -> what the profile means
    "display p3": _DISPLAY_P3,
    "adobe rgb": _ADOBE_RGB,
    "prophoto": ColorSpace("ProPhoto RGB", 1.8, _PRIMARIES["romm"]),
    "srgb": SRGB,
    "urgb": SRGB,
    "gray gamma 2.2": CHOICES["gamma22"],
}
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def embedded_space(decoded: DecodedImage, notes: list[str]) -> ColorSpace:
    """What the file says about its colours: ICC profile, EXR chromaticities, tags, then habit."""
    told = decoded.file.attributes
    fallback = SRGB if decoded.integer else LINEAR
    description = told["ICCProfile:profile_description"]
    if description or decoded.file.profile:
        name = printable(str(description)) if description else ""
        lowered = name.lower()
        for key, space in _PROFILES.items():
            if key in lowered:
                return replace(space, name=name, transfer=1.0) if "linear" in lowered else space
        notes.append(f"colour profile {name or 'without a name'!r} not understood, ignored")
        return fallback
    chromaticities = told["chromaticities"]
    if isinstance(chromaticities, list) and len(chromaticities) == 8:
        own = ColorSpace("linear light with the file's own chromaticities", 1.0, tuple(chromaticities))
        if _plausible(own.primaries):
            return own
        notes.append("the file's chromaticities are of no colours there can be, ignored")
        return fallback
    tag = str(told["oiio:ColorSpace"] or "")
    transfer, _, rest = tag.partition("_")
    primaries = rest.partition("_")[0]
    if transfer in _TRANSFERS and primaries in _PRIMARIES:
        exif = told["Exif:ColorSpace"]
        if (transfer, primaries, exif) == ("srgb", "rec709", 2):
            return _ADOBE_RGB
        if exif == 65535:
            notes.append("the camera calls the colours uncalibrated but embeds no profile")
        tagged = ColorSpace(tag, _TRANSFERS[transfer], _PRIMARIES[primaries])
        return next((known for known in (SRGB, LINEAR) if known == replace(tagged, name=known.name)), tagged)
    if tag:
        notes.append(f"colour space {printable(tag)!r} not understood, ignored")
    return fallback


def _plausible(chromaticities: Sequence[float]) -> bool:
    """Whether colours can be converted from some primaries: finite, a triangle, a white point."""
    values = np.array(chromaticities, dtype=np.float64)
    if not np.isfinite(values).all() or (values[1::2] == 0.0).any():
        return False
    try:
        with np.errstate(all="ignore"):
            matrix = to_rec709(chromaticities)
    except np.linalg.LinAlgError:
        return False
    return bool(np.isfinite(matrix).all() and np.abs(matrix).max() < LARGEST_COEFFICIENT)


def to_rec709(primaries: Sequence[float]) -> Float64[np.ndarray, "3 3"]:
    """Return the matrix from linear RGB of some chromaticities to Rec. 709, Bradford-adapted to its white."""

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
