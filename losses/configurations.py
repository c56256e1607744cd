"""Des18's pairs of light and view that renderings are compared under: any, and those that meet in a mirror.

Of random pairs few see a highlight. So most of them are made to: light and camera mirror each other at a
random point of the surface, where a smooth material shows its highlight (Deschaintre et al. 2018, Sec. 4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nets.render import Geometry, schlick_weight, surface_points
from nets.sampling import cosine_weighted


@dataclass(frozen=True)
class LightViewPairs:
    """How many pairs of a kind there are for each material, and where they are.

    Attributes:
        diffuse: directions to light and camera drawn independently, both far away.
        mirror: light and camera at mirrored directions from a random point of the surface.
        distance_mean: mean of the logarithm of their distances from it, surface units.
        distance_deviation: standard deviation of that logarithm.
    """

    diffuse: int = 3
    mirror: int = 6
    distance_mean: float = 0.5
    distance_deviation: float = 0.75

    @property
    def count(self) -> int:
        """Pairs for each material."""
        return self.diffuse + self.mirror

    def sample(self, batch: int, size: tuple[int, int], generator: torch.Generator) -> Geometry:
        """Draw geometries of white unit lights for surfaces of a size, `count` for each of a batch.

        Geometry i is of material i mod batch.
        """
        far, near = batch * self.diffuse, batch * self.mirror
        points = surface_points(*size)
        directions = cosine_weighted(2 * far + near, generator)
        light, view, reflected = directions.split([far, far, near])
        place = torch.cat([2.0 * torch.rand(near, 2, generator=generator) - 1.0, torch.zeros(near, 1)], dim=1)
        distance = torch.exp(
            self.distance_mean + self.distance_deviation * torch.randn(2, near, 1, generator=generator)
        )
        lamp = place + distance[0] * reflected
        eye = place + distance[1] * reflected * torch.tensor([-1.0, -1.0, 1.0])
        return _geometry(
            torch.cat([_everywhere(light, size), _toward(lamp, points)]),
            torch.cat([_everywhere(view, size), _toward(eye, points)]),
        )


DES18_PAIRS = LightViewPairs()
"""Three and six, as Des18 and Des19 have them."""


def _everywhere(direction: Float[Tensor, "n 3"], size: tuple[int, int]) -> Float[Tensor, "n 3 h w"]:
    return direction[:, :, None, None].expand(-1, -1, *size)


def _toward(position: Float[Tensor, "n 3"], points: Float[Tensor, "3 h w"]) -> Float[Tensor, "n 3 h w"]:
    return functional.normalize(position[:, :, None, None] - points, dim=1)


def _geometry(light: Float[Tensor, "n 3 h w"], view: Float[Tensor, "n 3 h w"]) -> Geometry:
    half_vector = functional.normalize(light + view, dim=1)
    v_dot_h = (view * half_vector).sum(dim=1, keepdim=True)
    irradiance = torch.full((len(light), 3, 1, 1), math.pi)
    return Geometry(light, view, half_vector, schlick_weight(v_dot_h), irradiance)
