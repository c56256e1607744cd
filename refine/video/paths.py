"""Closed paths of a light over a material: after the last frame comes the first one again."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

Point = tuple[float, float, float]


def _circle(turn: float) -> tuple[float, float]:
    return math.cos(turn), math.sin(turn)


def _sweep(turn: float) -> tuple[float, float]:
    return -math.cos(turn), 0.0


def _figure_eight(turn: float) -> tuple[float, float]:
    return math.sin(turn), 0.5 * math.sin(2.0 * turn)


PATHS: dict[str, Callable[[float], tuple[float, float]]] = {
    "circle": _circle,
    "sweep": _sweep,
    "figure-eight": _figure_eight,
}
"""x and y at an angle from 0 to 2 pi, by name: counter-clockwise; left to right and back; a lying eight."""


def light_positions(path: str, count: int, radius: float, height: float) -> Iterator[Point]:
    """Yield positions along a path, equally far apart in time.

    Args:
        path: a name in `PATHS`.
        count: how many.
        radius: how far from the middle the light gets, surface units.
        height: above the surface, surface units.
    """
    for frame in range(count):
        x, y = PATHS[path](2.0 * math.pi * frame / count)
        yield radius * x, radius * y, height
