"""Random fields that families are composed from: spectral noise, cells, strokes.

Everything is a float32 `[H, W]` array over the surface [-1, 1]^2 (x right, y up, row 0 at the top).
Nothing here knows what a material is; see `compose.py` for colours, heights and the finished maps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

Field = NDArray[np.float32]  # [H, W], what is returned
Real = NDArray[np.floating]  # what is accepted: any precision
Index = NDArray[np.intp]  # [H, W], which cell or block a pixel belongs to


def grid(size: int) -> tuple[Field, Field]:
    """Surface coordinates x (right) and y (up) of the pixel centres, each `[size, size]`."""
    t = ((2 * np.arange(size) + 1) / size - 1).astype(np.float32)
    x, y = np.meshgrid(t, -t)
    return x, y


def rotated(x: Real, y: Real, angle: float) -> tuple[Field, Field]:
    """The coordinates in a frame turned counter-clockwise by `angle` radians."""
    c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    return c * x + s * y, c * y - s * x


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A positive number whose logarithm is uniform: the fair way to vary a scale."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def spectral(
    rng: np.random.Generator,
    size: int,
    low: float = 2.0,
    high: float = np.inf,
    slope: float = 1.5,
    stretch: float = 1.0,
    angle: float = 0.0,
) -> Field:
    """Gaussian noise of zero mean and unit deviation, shaped in the Fourier domain; it tiles.

    Its amplitude is flat up to `low` cycles per image, falls as `f^-slope` and is cut smoothly at `high`.
    `stretch` > 1 elongates it along the direction `angle` (radians, counter-clockwise from x).
    """
    fx = fft.rfftfreq(size, 1 / size).astype(np.float32)[None, :]
    fy = -fft.fftfreq(size, 1 / size).astype(np.float32)[:, None]  # rows run downwards, y upwards
    c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    square = (stretch * (c * fx + s * fy)) ** 2 + (c * fy - s * fx) ** 2
    amplitude = (square + low**2) ** (-slope / 2)
    if np.isfinite(high):
        amplitude = amplitude * np.exp(-square / high**2)
    amplitude[0, 0] = 0
    white = fft.rfft2(rng.standard_normal((size, size), dtype=np.float32))
    field = fft.irfft2(white * amplitude.astype(np.float32), s=(size, size))
    return np.asarray(field / max(float(field.std()), 1e-12), dtype=np.float32)


def smoothstep(low: float, high: float, value: Real) -> Field:
    """0 below `low`, 1 above `high`, a smooth cubic between."""
    t = np.clip((value - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t), dtype=np.float32)


def unit(noise: Real) -> Field:
    """Noise of unit deviation mapped to [0, 1]: two deviations fill the range, the rest saturates."""
    return np.clip(0.5 + 0.25 * noise, 0, 1).astype(np.float32)


def patches(noise: Real, coverage: float, softness: float = 0.15) -> Field:
    """A mask in [0, 1] that is 1 where `noise` is highest, over about `coverage` of the surface."""
    threshold = float(np.quantile(noise[::2, ::2], 1 - np.clip(coverage, 0, 1)))
    return smoothstep(threshold - softness, threshold + softness, noise)


def veins(noise: Real, width: float) -> Field:
    """1 along the zero contours of `noise`, falling to 0 within `width` deviations: cracks and veins."""
    return 1 - smoothstep(0, width, np.abs(noise))


def bent(
    rng: np.random.Generator, x: Real, y: Real, amount: float, low: float = 3, slope: float = 2.5
) -> tuple[Field, Field]:
    """Coordinates displaced by smooth noise of deviation `amount`: nothing is quite straight."""
    size = x.shape[0]
    return (
        x + np.float32(amount) * spectral(rng, size, low, slope=slope),
        y + np.float32(amount) * spectral(rng, size, low, slope=slope),
    )


def pick(rng: np.random.Generator, index: Index, low: float = 0, high: float = 1) -> Field:
    """One uniform random number per cell or block, spread over its pixels."""
    values = rng.uniform(low, high, int(index.max()) + 1).astype(np.float32)
    return values[index]


def lean(rng: np.random.Generator, index: Index, u: Real, v: Real, slope: float) -> Field:
    """Every piece sits a little askew: a plane per piece in its own coordinates, of up to `slope`."""
    plane = u * pick(rng, index, -slope, slope) + v * pick(rng, index, -slope, slope)
    return np.asarray(plane, dtype=np.float32)


def scattered(
    rng: np.random.Generator, field: Real, index: Index, turned: NDArray[Any] | None = None
) -> Field:
    """Each block cut from its own random place of a tiling `field`; a quarter turned where `turned`."""
    size = field.shape[0]
    rows, columns = np.arange(size)[:, None], np.arange(size)[None, :]
    offsets = rng.integers(0, size, (2, int(index.max()) + 1))
    down, right = offsets[0][index], offsets[1][index]
    cut = field[(rows + down) % size, (columns + right) % size]
    if turned is not None:
        cut = np.where(turned, field[(columns + right) % size, (rows + down) % size], cut)
    return cut


@dataclass(frozen=True)
class Cells:
    """A Worley (Voronoi) partition: distances in surface units, `[H, W]` each."""

    near: Field  # to the cell's own point
    edge: Field  # to the border with the next cell
    index: Index
    dx: Field  # from the cell's point
    dy: Field


def cells(
    rng: np.random.Generator,
    x: Real,
    y: Real,
    count: float,
    aspect: float = 1.0,
    jitter: float = 1.0,
) -> Cells:
    """Voronoi cells, about `count` over the width and `count * aspect` over the height.

    Points sit one per square of a grid, displaced by `jitter` (0 a lattice, 1 anywhere in its square),
    so that the nine squares around a pixel hold its nearest points: no tree is needed.
    """
    step_x, step_y = np.float32(2 / count), np.float32(2 / (count * aspect))
    column, row = np.floor(x / step_x).astype(np.intp), np.floor(y / step_y).astype(np.intp)
    left, bottom = int(column.min()) - 1, int(row.min()) - 1
    across, up = int(column.max()) - left + 2, int(row.max()) - bottom + 2
    place = (0.5 + jitter * (rng.random((2, up * across), dtype=np.float32) - 0.5)).astype(np.float32)
    i, j = np.meshgrid(np.arange(across) + left, np.arange(up) + bottom)
    px = ((i.ravel() + place[0]) * step_x).astype(np.float32)
    py = ((j.ravel() + place[1]) * step_y).astype(np.float32)

    home = (row - bottom) * across + (column - left)
    first = np.full(x.shape, np.inf, dtype=np.float32)
    second, owner, other = first.copy(), home.copy(), home.copy()
    for shift in (dj * across + di for dj in (-1, 0, 1) for di in (-1, 0, 1)):
        candidate = home + shift
        distance = (x - px[candidate]) ** 2 + (y - py[candidate]) ** 2
        closer = distance < first
        runner_up = ~closer & (distance < second)
        second = np.where(closer, first, np.where(runner_up, distance, second))
        other = np.where(closer, owner, np.where(runner_up, candidate, other))
        first, owner = np.where(closer, distance, first), np.where(closer, candidate, owner)
    apart = np.hypot(px[owner] - px[other], py[owner] - py[other])
    edge = (second - first) / (2 * np.maximum(apart, 1e-6))  # distance to the bisector of the two points
    return Cells(np.sqrt(first), edge, owner, x - px[owner], y - py[owner])


def strokes(
    rng: np.random.Generator,
    size: int,
    count: int,
    length: float,
    angle: float = 0.0,
    spread: float = np.pi,
    curl: float = 0.0,
    width: float = 0.5,
) -> Field:
    """Thin tapered lines of random strength, 0 where there are none and about 1 on a strong one.

    `length` is in surface units, `width` the Gaussian deviation in pixels, directions are uniform within
    `angle` +- `spread` and turn by up to `curl` radians over the length. Scratches, fibres, hairs.
    """
    pixels = length * size / 2
    steps = max(int(1.5 * pixels), 4)
    t = np.linspace(0, 1, steps, dtype=np.float32)[None, :]
    direction = rng.uniform(angle - spread, angle + spread, (count, 1)) + t * rng.uniform(
        -curl, curl, (count, 1)
    )
    extent = pixels * rng.uniform(0.3, 1.0, (count, 1)) / steps
    start = rng.uniform(-0.1, 1.1, (2, count, 1)) * size
    column = np.rint(start[0] + np.cumsum(np.cos(direction) * extent, axis=1)).astype(np.intp)
    row = np.rint(start[1] - np.cumsum(np.sin(direction) * extent, axis=1)).astype(np.intp)
    weight = rng.uniform(0.2, 1.0, (count, 1)) * np.sqrt(4 * t * (1 - t))
    inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    canvas = np.zeros(size * size, dtype=np.float32)
    np.maximum.at(canvas, (row * size + column)[inside], weight[inside].astype(np.float32))
    field = canvas.reshape(size, size)
    return np.asarray(ndimage.gaussian_filter(field, width) * (1 + 2 * width), dtype=np.float32)
