"""Regular partitions of the surface: courses of bricks, herringbone, basket weave, and woven threads.

All lengths are surface units (the image is 2 wide).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nets.data.procedural.noise import Field, Index, Real, smoothstep


@dataclass(frozen=True)
class Blocks:
    """Rectangular pieces: where in its piece every pixel is, `[H, W]` each."""

    along: Field  # from the centre, along the longer side
    across: Field  # from the centre, along the shorter side
    edge: Field  # distance to the piece's border
    index: Index
    turned: NDArray[np.bool_]  # whether the longer side is vertical


def _blocks(
    along: NDArray[np.floating],
    across: NDArray[np.floating],
    length: float,
    width: float,
    column: NDArray[np.floating],
    row: NDArray[np.floating],
    turned: NDArray[np.bool_] | None = None,
) -> Blocks:
    """Blocks from centred coordinates and the integer place of each piece."""
    edge = np.minimum(length / 2 - np.abs(along), width / 2 - np.abs(across))
    column, row = column - column.min(), row - row.min()
    _, index = np.unique((row * (column.max() + 1) + column).astype(np.intp), return_inverse=True)
    turned = np.zeros(edge.shape, dtype=bool) if turned is None else turned
    f32 = np.float32
    return Blocks(along.astype(f32), across.astype(f32), edge.astype(f32), index.reshape(edge.shape), turned)


def courses(x: Real, y: Real, length: float, width: float, shift: NDArray[np.floating]) -> Blocks:
    """Rows of pieces; row `i` is displaced by `shift[i % n]` of a length (0: stack; 0, 1/2: running)."""
    row = np.floor(y / width)
    position = x / length + shift[row.astype(np.intp) % len(shift)]
    column = np.floor(position)
    return _blocks((position - column - 0.5) * length, y - (row + 0.5) * width, length, width, column, row)


def herringbone(x: Real, y: Real, width: float, ratio: int = 2) -> Blocks:
    """Pieces `ratio` times as long as wide, alternately lying and standing along the diagonals.

    On a grid of squares, square (i, j) is of a lying piece if (i - j) mod 2n < n, else of a standing one.
    """
    i, j = np.floor(x / width), np.floor(y / width)
    phase = np.mod(i - j, 2 * ratio)
    turned = phase >= ratio
    left = np.where(turned, i, i - phase)
    bottom = np.where(turned, j - (2 * ratio - 1 - phase), j)
    length = ratio * width
    from_left, from_bottom = x - left * width, y - bottom * width
    along = np.where(turned, from_bottom, from_left) - length / 2
    across = np.where(turned, from_left, from_bottom) - width / 2
    return _blocks(along, across, length, width, left, bottom, turned)


def basket(x: Real, y: Real, width: float, ratio: int = 4) -> Blocks:
    """Squares of `ratio` parallel strips, each square turned against its neighbours."""
    length = ratio * width
    i, j = np.floor(x / length), np.floor(y / length)
    turned = np.mod(i + j, 2) > 0
    u, v = x - i * length, y - j * length
    along, over = np.where(turned, v, u) - length / 2, np.where(turned, u, v)
    strip = np.floor(over / width)
    across = over - (strip + 0.5) * width
    return _blocks(along, across, length, width, i * ratio + strip, j, turned)


@dataclass(frozen=True)
class Weave:
    """Two sets of threads over and under each other, `[H, W]` each."""

    height: Field  # in thread half-widths, about -1..2
    warp_on_top: Field  # 1 where the vertical threads show, else 0
    thread: Index  # number of the visible thread in its set
    along: Field  # along the visible thread, in thread widths
    across: Field  # across it, -1..1


def weave(x: Real, y: Real, threads: float, pattern: NDArray[np.bool_], tightness: float = 0.95) -> Weave:
    """Threads (`threads` over the width) woven by `pattern[row, column]`: True where the warp is on top.

    A thread's middle line rises and falls between its crossings; what is higher at a pixel is visible.
    """
    u, v = x * (threads / 2), y * (threads / 2)
    sign = np.where(pattern, 1.0, -1.0).astype(np.float32)
    column, row = np.floor(u).astype(np.intp), np.floor(v).astype(np.intp)

    def crossing(i: Index, j: Index) -> Field:
        return sign[j % sign.shape[0], i % sign.shape[1]]

    def profile(t: Real) -> Real:  # a round thread, and nothing in the gap beside it
        return np.sqrt(np.maximum(1 - (t / tightness) ** 2, 0)) - 2 * (np.abs(t) > tightness)

    def between(t: Real) -> tuple[Index, Field]:
        start = np.floor(t - 0.5)
        return start.astype(np.intp), smoothstep(0, 1, t - 0.5 - start)

    start, part = between(v)
    warp_middle = crossing(column, start) * (1 - part) + crossing(column, start + 1) * part
    start, part = between(u)
    weft_middle = -(crossing(start, row) * (1 - part) + crossing(start + 1, row) * part)
    warp_across, weft_across = 2 * (u - column) - 1, 2 * (v - row) - 1
    warp = profile(warp_across) + 0.8 * warp_middle
    weft = profile(weft_across) + 0.8 * weft_middle
    top = warp >= weft
    return Weave(
        np.maximum(np.maximum(warp, weft), -1.2).astype(np.float32),
        top.astype(np.float32),
        np.where(top, column - column.min(), row - row.min()).astype(np.intp),
        np.where(top, v, u).astype(np.float32),
        np.where(top, warp_across, weft_across).astype(np.float32),
    )
