"""Height from normals: Frankot and Chellappa 1988, the least-squares surface of given slopes, by FFT."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from jaxtyping import Float
from torch import Tensor

from refine.parametrization import MAX_SLOPE

Field = Float[np.ndarray, "height width"]


def height_from_normals(normal: Float[Tensor, "1 3 height width"], *, repeats: bool = False) -> Field:
    """Return the surface whose slopes are nearest to those of the normals, in surface units, mean 0.

    The slopes' spectra are projected to those of an integrable surface (R. T. Frankot and R. Chellappa, "A
    method for enforcing integrability in shape from shading algorithms", PAMI 10(4), 1988, Eq. 21). A surface
    that does not repeat is continued by mirroring, which makes the transforms cosine and sine transforms.

    Args:
        normal: unit vectors, y up; slopes beyond `MAX_SLOPE` are clipped.
        repeats: whether opposite borders match.
    """
    x, y, z = normal[0].double().cpu().numpy()
    steepest = np.maximum(z, 1e-9)
    slope_x = np.clip(-x / steepest, -MAX_SLOPE, MAX_SLOPE)
    slope_down = np.clip(y / steepest, -MAX_SLOPE, MAX_SLOPE)  # rows go down, y goes up
    spacing = 2.0 / max(z.shape)
    solve = _periodic if repeats else _mirrored
    return solve(slope_x * spacing, slope_down * spacing)


def _periodic(across: Field, down: Field) -> Field:
    """Integrate differences per pixel, of a surface that repeats."""
    height, width = across.shape
    u = 2.0 * np.pi * scipy.fft.rfftfreq(width)[None, :]
    v = 2.0 * np.pi * scipy.fft.fftfreq(height)[:, None]
    spectrum = -1j * (u * scipy.fft.rfft2(across) + v * scipy.fft.rfft2(down)) / _power(u, v)
    surface: Field = scipy.fft.irfft2(spectrum, s=across.shape)
    return surface


def _mirrored(across: Field, down: Field) -> Field:
    """Integrate differences per pixel, of a surface that is mirrored at its borders."""
    height, width = across.shape
    u = np.pi * np.arange(width)[None, :] / width
    v = np.pi * np.arange(height)[:, None] / height
    gradient = u * _cosines(_sines(across, 1), 0) + v * _cosines(_sines(down, 0), 1)
    surface: Field = scipy.fft.idctn(-gradient / _power(u, v), type=2, norm="ortho")
    return surface


def _power(
    u: Float[np.ndarray, "1 width"], v: Float[np.ndarray, "rows 1"]
) -> Float[np.ndarray, "rows width"]:
    power: Field = u**2 + v**2
    power[0, 0] = np.inf  # the mean height is not in the slopes
    return power


def _cosines(values: Field, axis: int) -> Field:
    spectrum: Field = scipy.fft.dct(values, type=2, norm="ortho", axis=axis)
    return spectrum


def _sines(values: Field, axis: int) -> Field:
    """Sine transform, shifted so that index k is the frequency of index k of the cosine transform."""
    spectrum: Field = np.roll(scipy.fft.dst(values, type=2, norm="ortho", axis=axis), 1, axis=axis)
    spectrum[(slice(None),) * axis + (0,)] = 0.0
    return spectrum


@dataclass(frozen=True)
class Relief:
    """A height map as a picture, and what its values mean: height = low + value (high - low).

    Attributes:
        picture: in [0, 1].
        low: height of 0, in surface units (the longer side is 2).
        high: height of 1.
    """

    picture: Field
    low: float
    high: float


def relief(height: Field) -> Relief:
    """Scale heights to [0, 1]; a flat surface is 0.5 everywhere, and its range is empty."""
    low, high = float(height.min()), float(height.max())
    if high - low < np.finfo(np.float32).eps:
        return Relief(np.full_like(height, 0.5), 0.0, 0.0)
    return Relief((height - low) / (high - low), low, high)
