"""Random inputs of refinement: any legal material, light and camera, photos of it or of nothing at all.

A case is drawn through `Chance`, so that a soak draws it from a seed and a property-based test from its own
source, which can shrink it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nets.render import Camera, PointLight, render
from nets.svbrdf import SVBRDF
from refine.capture import Capture

Choice = TypeVar("Choice")

ODD_VALUES = (0.0, 1.0, 1e-30, 1e-8, 1e-3, 0.03, 0.5, 0.999, 1.0 - 1e-7)
"""At and near the ends of the range of a map or a photo."""

ODD_COORDINATES = (0.0, -1.0, 1.0, 1e-6, 30.0)
FARTHEST = 20.0
HEIGHTS = (1e-3, 0.3, 2.0, 50.0, 1e4)
INTENSITIES = (1e-4, 1.0, 100.0)
TILTS = (0.0, 0.3, 3.0, 1e4)
"""Largest slopes: from flat to the horizon."""

FALLOFFS: tuple[Literal["none", "inverse_square"], ...] = ("none", "inverse_square")
CAMERAS: tuple[Literal["perspective", "orthographic", "collocated"], ...] = (
    "perspective",
    "orthographic",
    "collocated",
)


@runtime_checkable
class Chance(Protocol):
    """Where random decisions come from."""

    def one_of(self, options: Sequence[Choice]) -> Choice:
        """Return one of some options."""

    def integer(self, low: int, high: int) -> int:
        """Return an integer from `low` to `high`, both included."""

    def number(self, low: float, high: float) -> float:
        """Return a number from `low` to `high`."""


class Seeded:
    """Chance from a seed: the same seed draws the same case on every machine."""

    def __init__(self, *seed: int) -> None:
        """Start the stream that belongs to some integers of 0 and more."""
        self._numbers = np.random.default_rng(seed)

    def one_of(self, options: Sequence[Choice]) -> Choice:
        """Return one of some options, each as likely as the others."""
        return options[int(self._numbers.integers(len(options)))]

    def integer(self, low: int, high: int) -> int:
        """Return an integer from `low` to `high`, both included."""
        return int(self._numbers.integers(low, high + 1))

    def number(self, low: float, high: float) -> float:
        """Return a number from `low` to `high`."""
        return float(self._numbers.uniform(low, high))


@dataclass(frozen=True)
class Case:
    """A material to start from, photos that may or may not be of it, and how many steps to take."""

    initial: SVBRDF
    captures: tuple[Capture, ...]
    iterations: int


def draw_case(chance: Chance, *, sides: tuple[int, int] = (1, 9), most_iterations: int = 24) -> Case:
    """Draw a case.

    Args:
        chance: source of randomness.
        sides: smallest and largest side in pixels.
        most_iterations: of all stages together.
    """
    size = chance.integer(*sides), chance.integer(*sides)
    captures = tuple(_draw_capture(chance, size) for _ in range(chance.one_of((1, 1, 1, 3))))
    return Case(draw_material(chance, size), captures, chance.integer(0, most_iterations))


def draw_material(chance: Chance, size: tuple[int, int]) -> SVBRDF:
    """Draw any legal material of a size: normals down to the horizon, mirrors, black and white."""
    slope = (2.0 * _draw_plane(chance, 2, size) - 1.0) * chance.one_of(TILTS)
    normal = torch.cat([slope, torch.ones_like(slope[:, :1])], dim=1)
    return SVBRDF(
        torch.nn.functional.normalize(normal, dim=1),
        _draw_plane(chance, 3, size),
        _draw_plane(chance, 1, size).clamp(min=1e-3),
        _draw_plane(chance, 3, size),
    )


def _draw_capture(chance: Chance, size: tuple[int, int]) -> Capture:
    x, y = _draw_coordinate(chance), _draw_coordinate(chance)
    position = torch.tensor([[x, y, chance.one_of(HEIGHTS)]])
    intensity = torch.full((1, 3), chance.one_of(INTENSITIES))
    light, camera = PointLight(position, intensity, chance.one_of(FALLOFFS)), Camera(chance.one_of(CAMERAS))
    if chance.one_of((True, False)):
        photo = render(draw_material(chance, size), light, camera).clamp(0.0, 1.0)
    else:
        photo = _draw_plane(chance, 3, size)
    return Capture(photo, (photo < 1.0).all(dim=1, keepdim=True), camera, light)


def _draw_coordinate(chance: Chance) -> float:
    return (
        chance.number(-FARTHEST, FARTHEST) if chance.one_of((True, False)) else chance.one_of(ODD_COORDINATES)
    )


def _draw_plane(chance: Chance, channels: int, size: tuple[int, int]) -> Float[Tensor, "1 channels h w"]:
    """Noise in [0, 1], a constant at or near an end of the range, or noise with such pixels in it."""
    generator = torch.Generator().manual_seed(chance.integer(0, 2**31))
    noise = torch.rand(1, channels, *size, generator=generator)
    odd = torch.full_like(noise, chance.one_of(ODD_VALUES))
    share = chance.one_of((0.0, 0.3, 1.0))
    return torch.where(torch.rand(noise.shape, generator=generator) < share, odd, noise)
