"""Distributions of lights for training and evaluation (paper Sec. 5.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nets.render import PointLight


@dataclass(frozen=True)
class LightDistribution:
    """Cosine-weighted direction on a cap, log-normal distance.

    Attributes:
        distance_mean: mean of the logarithm of the distance in surface units.
        distance_deviation: standard deviation of that logarithm.
        max_angle: half angle of the cap around the surface's normal, degrees.
        distance_range: distances are clipped to this, surface units.
    """

    distance_mean: float = 1.0
    distance_deviation: float = 0.75
    max_angle: float = 90.0
    distance_range: tuple[float, float] = (0.0, math.inf)

    def sample(self, count: int, generator: torch.Generator) -> PointLight:
        """Draw `count` white unit lights without falloff."""
        direction = cosine_weighted(count, generator, max_angle=self.max_angle)
        normal = torch.randn(count, 1, generator=generator)
        distance = torch.exp(self.distance_mean + self.distance_deviation * normal)
        return PointLight(direction * distance.clamp(*self.distance_range), torch.ones(count, 3))


PAPER_LIGHTS = LightDistribution()
"""Sec. 5.2 to the letter: upper hemisphere, distance exp(N(1, 0.75))."""

YARDSTICK_LIGHTS = LightDistribution(max_angle=45.0, distance_range=(1.5, 8.0))
"""The twenty novel lights of the evaluation: within 45 degrees, distances clipped to [1.5, 8]."""


def cosine_weighted(
    count: int, generator: torch.Generator, *, max_angle: float = 90.0
) -> Float[Tensor, "count 3"]:
    """Draw unit vectors with density proportional to cos(theta) on a cap of `max_angle` degrees."""
    u, v = torch.rand(2, count, generator=generator)
    # Malley: a uniform point on the disc of radius sin(max_angle), lifted to the sphere.
    radius = torch.sqrt(u) * math.sin(math.radians(max_angle))
    phi = 2.0 * math.pi * v
    return torch.stack([radius * torch.cos(phi), radius * torch.sin(phi), torch.sqrt(1.0 - radius**2)], dim=1)
