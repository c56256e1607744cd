"""From fields to a material: colours, slopes, cavities, and the four maps they end in.

Colours are linear RGB; they are written as sRGB hex because that is how one picks them from photographs.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from nets.data.procedural.noise import Field, Real

Colour = NDArray[np.float32]  # [3] or [H, W, 3], linear RGB

DIELECTRIC_F0 = 0.04
# Linear F0 of bare metals (measured; after the tables of Lagarde and of Hoffman).
METALS: dict[str, tuple[float, float, float]] = {
    "gold": (1.000, 0.766, 0.336),
    "silver": (0.972, 0.960, 0.915),
    "copper": (0.955, 0.638, 0.538),
    "aluminium": (0.913, 0.922, 0.924),
    "iron": (0.562, 0.565, 0.578),
    "titanium": (0.542, 0.497, 0.449),
    "chromium": (0.549, 0.556, 0.554),
    "nickel": (0.660, 0.609, 0.526),
    "brass": (0.887, 0.789, 0.434),
    "bronze": (0.714, 0.500, 0.280),
    "zinc": (0.664, 0.680, 0.690),
}


@dataclass(frozen=True)
class MaterialMaps:
    """One material: a height field over [-1, 1]^2 and its reflectance, row 0 at the top."""

    height: NDArray[np.float32]  # [H, W] surface units (the image is 2 wide)
    diffuse: NDArray[np.float32]  # [H, W, 3] linear albedo in [0, 1]
    roughness: NDArray[np.float32]  # [H, W] in (0, 1]; GGX alpha is its square
    specular: NDArray[np.float32]  # [H, W, 3] linear F0 in [0, 1]

    @property
    def normal(self) -> NDArray[np.float32]:
        """Unit normals of the height field, `[H, W, 3]`: x right, y up, z towards the viewer."""
        return normal_from_height(self.height)


def slopes(height: Real) -> tuple[Field, Field]:
    """Derivatives of `height` along x (right) and y (up), central differences; a pixel is 2 / W wide."""
    spacing = 2 / height.shape[1]
    down, right = (np.asarray(d, dtype=np.float32) for d in np.gradient(height, spacing))
    return right, -down


def normal_from_height(height: Real) -> NDArray[np.float32]:
    """Unit normals `[H, W, 3]` of a height field in surface units."""
    along_x, along_y = slopes(height)
    normal = np.stack([-along_x, -along_y, np.ones_like(height)], axis=-1)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True), dtype=np.float32)


def tilted(field: Real, degrees: float) -> Field:
    """The field as a relief whose root-mean-square slope is `degrees`: looks alike at every resolution."""
    along_x, along_y = slopes(field)
    rms = float(np.sqrt(np.mean(along_x**2 + along_y**2)))
    return np.asarray(field * (np.tan(np.radians(degrees)) / max(rms, 1e-9)), dtype=np.float32)


def cavity(height: Real, radius: float) -> Field:
    """Signed depth below the surroundings within `radius` surface units, in deviations: > 0 in pits."""
    below = ndimage.gaussian_filter(height, max(radius * height.shape[0] / 2, 0.8)) - height
    return np.asarray(below / max(float(below.std()), 1e-9), dtype=np.float32)


def lerp(a: ArrayLike, b: ArrayLike, mask: Real) -> Field:
    """`a` where the mask is 0, `b` where it is 1; numbers or fields."""
    start = np.asarray(a, dtype=np.float32)
    return np.asarray(start + (np.asarray(b, dtype=np.float32) - start) * mask, dtype=np.float32)


def blend(a: Real, b: Real, mask: Real) -> Colour:
    """Colour `a` where the mask is 0, `b` where it is 1; `[3]` or `[H, W, 3]`."""
    return np.asarray(a + (b - a) * mask[..., None], dtype=np.float32)


def shade(colour: Real, factor: Real) -> Colour:
    """A colour darkened or lightened by a field of factors around 1."""
    return np.asarray(colour * np.maximum(factor, 0)[..., None], dtype=np.float32)


def srgb(code: str) -> Colour:
    """Linear RGB `[3]` of an sRGB hex code such as `"#8a4b32"`."""
    encoded = np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return linear.astype(np.float32)


def rgb(red: float, green: float, blue: float) -> Colour:
    """A linear colour `[3]` from its three numbers."""
    return np.array([red, green, blue], dtype=np.float32)


def choose(rng: np.random.Generator, codes: Sequence[str], spread: float = 0.12) -> Colour:
    """A colour between two of the given ones, then varied in lightness and a little in hue, `[3]`."""
    first, second = rng.integers(0, len(codes), 2)
    colour = srgb(codes[first]) + (srgb(codes[second]) - srgb(codes[first])) * rng.uniform(0, 0.5)
    factor = np.exp(rng.normal(0, 2 * spread) + rng.normal(0, spread / 4, 3))
    return np.clip(colour * factor, 0.004, 0.9).astype(np.float32)


def dye(rng: np.random.Generator, saturation: tuple[float, float] = (0, 0.9), value: float = 0.95) -> Colour:
    """Any colour that man puts on things, `[3]`: hue free, dark to light, grey to saturated, mostly muted."""
    hue = rng.random()
    strength = saturation[0] + (saturation[1] - saturation[0]) * rng.beta(1.2, 2)
    level = rng.uniform(0.15, value)
    encoded = np.array(colorsys.hsv_to_rgb(hue, strength, level))
    return np.clip(encoded**2.2, 0.004, 0.9).astype(np.float32)


def shades(rng: np.random.Generator, colour: Real, tone: Real, spread: float = 0.3) -> Colour:
    """A colour per pixel: `tone` in [0, 1] runs from a darker, to a lighter and differently hued sibling."""
    drift = rng.normal(0, 0.12 * spread, 3)
    dark = colour * np.exp(-spread + drift)
    light = np.clip(colour * np.exp(spread - drift), 0, 0.95)
    return blend(dark.astype(np.float32), light.astype(np.float32), tone)


def metal(rng: np.random.Generator, names: Sequence[str] | None = None) -> Colour:
    """F0 `[3]` of a measured metal, slightly varied as alloys are."""
    table = tuple(names or METALS)
    f0 = np.array(METALS[table[int(rng.integers(len(table)))]])
    return np.clip(f0 * np.exp(rng.normal(0, 0.02, 3)), 0.02, 1).astype(np.float32)


def finish(
    rng: np.random.Generator,
    height: Real,
    diffuse: Real,
    roughness: ArrayLike,
    specular: ArrayLike = DIELECTRIC_F0,
    grain: float = 1.0,
) -> MaterialMaps:
    """The maps, after the finest detail of all: grain of a pixel or two, shared by height, colour, roughness.

    `specular` may be a number, `[H, W]`, `[3]` or `[H, W, 3]`; `grain` 1 is a matt mineral, 0.2 is glass.
    """
    size = height.shape[0]
    white = rng.standard_normal((size, size), dtype=np.float32)
    fine = ndimage.gaussian_filter(white, 0.55)
    fine /= fine.std()
    own = rng.standard_normal((size, size), dtype=np.float32)
    height = height + tilted(fine, 2.5 * grain)
    colour = np.asarray(diffuse) * np.exp(grain * (0.05 * fine + 0.03 * own))[..., None]
    colour = colour * (1 - 0.12 * np.clip(cavity(height, 0.03), -0.5, 1.5))[..., None]
    rough = np.asarray(roughness, dtype=np.float32) + grain * (0.015 * own - 0.015 * fine)
    f0 = np.asarray(specular, dtype=np.float32)
    f0 = f0[..., None] if f0.ndim in (0, 2) else f0
    f0 = np.broadcast_to(f0, (size, size, 3)) * np.exp(0.02 * grain * fine)[..., None]
    return MaterialMaps(
        height.astype(np.float32),
        np.clip(colour, 0, 1).astype(np.float32),
        np.clip(rough, 0.05, 1).astype(np.float32),
        np.clip(f0, 0.015, 1).astype(np.float32),
    )
