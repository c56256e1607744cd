"""Shapes that stand up from a surface: lattices of places, distances into outlines, and their shoulders.

All lengths are surface units (the image is 2 wide). Distances are positive inside an outline.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from nets.data.procedural.noise import Field, Index, Real, smoothstep


@dataclass(frozen=True)
class Lattice:
    """A regular arrangement of places: where from its place's centre every pixel is, `[H, W]` each."""

    u: Field  # to the right of the centre
    v: Field  # above it
    parity: Field  # 0 and 1 like a chessboard
    index: Index

    def turned(self, angle: Real) -> tuple[Field, Field]:
        """Coordinates along and across a direction of `angle` radians, one per place or pixel."""
        c, s = np.cos(angle), np.sin(angle)
        f32 = np.float32
        return (self.u * c + self.v * s).astype(f32), (self.v * c - self.u * s).astype(f32)


def lattice(x: Real, y: Real, pitch: float, rise: float | None = None, stagger: float = 0.0) -> Lattice:
    """Places `pitch` apart in rows `rise` apart (`pitch` if None); odd rows shifted by `stagger` pitches."""
    rise = pitch if rise is None else rise
    row = np.floor(y / rise)
    position = x / pitch + stagger * np.mod(row, 2)
    column = np.floor(position)
    parity = np.mod(row + column, 2)
    number = (row - row.min()) * (column.max() - column.min() + 1) + column - column.min()
    _, index = np.unique(number.astype(np.intp), return_inverse=True)
    u, v = (position - column - 0.5) * pitch, y - (row + 0.5) * rise
    f32 = np.float32
    return Lattice(u.astype(f32), v.astype(f32), parity.astype(f32), index.reshape(x.shape))


def hexagons(x: Real, y: Real, width: float) -> tuple[Lattice, Field]:
    """Hexagonal places, `width` between opposite sides; and the distance to their borders."""
    rise = width * np.sqrt(3)
    whole = lattice(x, y, width, rise)
    between = lattice(x + width / 2, y + rise / 2, width, rise)
    nearer = np.hypot(whole.u, whole.v) <= np.hypot(between.u, between.v)
    u, v = np.where(nearer, whole.u, between.u), np.where(nearer, whole.v, between.v)
    index = np.where(nearer, whole.index, between.index + whole.index.max() + 1)
    slanted = 0.5 * np.abs(u) + np.sqrt(0.75) * np.abs(v)
    edge = width / 2 - np.maximum(np.abs(u), slanted)
    return Lattice(u, v, np.where(nearer, whole.parity, 1 - between.parity), index), edge.astype(np.float32)


def scales(x: Real, y: Real, width: float) -> tuple[Lattice, Field]:
    """Fish scales: discs `width` across in staggered rows, each over the row above; distance to borders."""
    radius = width / 2
    row = np.ceil(y / radius - 1)  # the lowest one that may reach up here

    def place(row: Real) -> tuple[Real, Real, Real]:
        position = x / width + 0.5 * np.mod(row, 2)
        column = np.round(position)
        return column, (position - column) * width, y - row * radius

    below, above = place(row), place(row + 1)
    into = radius - np.hypot(below[1], below[2])
    lower = into >= 0
    column, u, v = (np.where(lower, a, b) for a, b in zip(below, above, strict=True))
    edge = np.where(lower, into, np.minimum(radius - np.hypot(above[1], above[2]), -into))
    row = np.where(lower, row, row + 1)
    number = (row - row.min()) * (column.max() - column.min() + 1) + column - column.min()
    _, index = np.unique(number.astype(np.intp), return_inverse=True)
    f32 = np.float32
    parity = np.mod(row + column, 2).astype(f32)
    places = Lattice(u.astype(f32), v.astype(f32), parity, index.reshape(x.shape))
    return places, edge.astype(f32)


def disc(u: Real, v: Real, radius: float) -> Field:
    """Distance into a disc."""
    return np.asarray(radius - np.hypot(u, v), dtype=np.float32)


def lens(along: Real, across: Real, length: float, width: float) -> Field:
    """Distance into what two circles share: pointed, half as long as `length`, half as wide as `width`."""
    radius = (length**2 + width**2) / (2 * width)
    return np.asarray(radius - np.hypot(along, np.abs(across) + radius - width), dtype=np.float32)


def bar(along: Real, across: Real, length: float, width: float) -> Field:
    """Distance into a bar with round ends; half length and half width."""
    beyond = np.maximum(np.abs(along) - (length - width), 0)
    return np.asarray(width - np.hypot(beyond, across), dtype=np.float32)


def rhombus(along: Real, across: Real, length: float, width: float) -> Field:
    """Distance into a rhombus; half diagonals."""
    inside = 1 - np.abs(along) / length - np.abs(across) / width
    return np.asarray(inside * (length * width / np.hypot(length, width)), dtype=np.float32)


def box(along: Real, across: Real, length: Real | float, width: Real | float, radius: float) -> Field:
    """Distance into a rectangle with corners of `radius`; half length and half width."""
    over_x, over_y = np.abs(along) - (length - radius), np.abs(across) - (width - radius)
    outside = np.hypot(np.maximum(over_x, 0), np.maximum(over_y, 0))
    return np.asarray(radius - outside - np.minimum(np.maximum(over_x, over_y), 0), dtype=np.float32)


def shoulder(distance: Real, width: float, degrees: float, power: float = 2.0) -> Field:
    """Height that rises at `degrees` from an outline and levels off `width` inside it.

    Power 1 is a chamfer, 2 a round edge, more a cushion. It levels off at `width * tan(degrees) / power`.
    """
    t = np.clip(distance / width, 0, 1)
    rise = width * np.tan(np.radians(degrees)) / power
    return np.asarray(rise * (1 - (1 - t) ** power), dtype=np.float32)


def swell(distance: Real, width: float, degrees: float) -> Field:
    """As `shoulder`, but with a hollow foot as pressed sheet has: `degrees` only half way up."""
    t = np.clip(distance / width, 0, 1)
    return np.asarray(width * np.tan(np.radians(degrees)) / 1.5 * t * t * (3 - 2 * t), dtype=np.float32)


def zigzag(t: Real) -> Field:
    """A triangle wave of period 1, from 0 at whole numbers to 1 half way: slope 2."""
    return np.asarray(1 - np.abs(2 * (t - np.floor(t)) - 1), dtype=np.float32)


def rubbed(height: Real, level: Real | float, softness: float) -> Field:
    """The height worn down to `level`, with an edge rounded over `softness`."""
    over = (height - level) / softness
    return np.asarray(height - softness * np.logaddexp(0, np.clip(over, -40, 40)), dtype=np.float32)


def softened(height: Real, width: float) -> Field:
    """The height with its sharp corners rounded over `width` surface units."""
    return np.asarray(ndimage.gaussian_filter(height, width * height.shape[0] / 2), dtype=np.float32)


def padded(height: Real, distance: Real, width: float) -> Field:
    """The height with mitred ridges rounded over `width`, but only that far inside the outline or further."""
    soft = softened(height, width)
    return np.asarray(
        height + (soft - height) * smoothstep(0.3 * width, 2 * width, distance), dtype=np.float32
    )


def runs(source: Real, length: float) -> Field:
    """What trickles down from a mask, fading over `length` surface units: stains below rivets."""
    stain, pixels = np.asarray(source, dtype=np.float32), length * source.shape[0] / 2
    keep = np.float32(np.exp(-1 / max(pixels, 1.0)))
    rows = [stain[0]]
    for row in stain[1:]:
        rows.append(np.maximum(row, rows[-1] * keep))
    return np.asarray(ndimage.gaussian_filter1d(np.stack(rows), 0.7, axis=1), dtype=np.float32)
