"""Test-time flips: one network, four mirrored views of the photo, one averaged material and light.

Convolutions with zero padding are not exactly symmetric, and neither is what was learned; the average of four
guesses has less error than one, in every map and in the light, for four times a fraction of a second.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nets.render import PointLight
from nets.svbrdf import SVBRDF

FLIPS = ((), (-1,), (-2,), (-2, -1))
"""Image axes to mirror: none, x, y, both."""


@runtime_checkable
class Predictor(Protocol):
    """A model with a `predict` method, as `nets.generator.Generator` has."""

    def predict(self, photo: Tensor) -> tuple[SVBRDF, PointLight]:
        """Estimate material and light of linear photos."""
        ...


class FlipAverage:
    """A network whose `predict` averages over mirrored photos."""

    def __init__(self, network: Predictor) -> None:
        """Wrap a network; it is not copied."""
        self.network = network

    @torch.no_grad()
    def predict(self, photo: Float[Tensor, "b 3 h w"]) -> tuple[SVBRDF, PointLight]:
        """Estimate material and light of linear photos, as `Generator.predict` does, from four views."""
        maps: list[Tensor] = []
        positions: list[Tensor] = []
        for axes in FLIPS:
            svbrdf, light = self.network.predict(photo.flip(axes))
            maps.append(mirror(svbrdf, axes).channels())
            positions.append(light.position * light.position.new_tensor(_signs(axes)))
        mean = SVBRDF.from_channels(torch.stack(maps).mean(dim=0))
        normal = functional.normalize(mean.normal, dim=1)
        position = torch.stack(positions).mean(dim=0)
        return (
            SVBRDF(normal, mean.diffuse, mean.roughness, mean.specular),
            PointLight(position, light.intensity, light.falloff),
        )


def mirror(svbrdf: SVBRDF, axes: tuple[int, ...]) -> SVBRDF:
    """Mirror a material along image axes (-1: x, -2: y), its normals with it."""
    flipped = svbrdf.map(lambda tensor: tensor.flip(axes))
    signs = flipped.normal.new_tensor(_signs(axes))[:, None, None]
    return SVBRDF(flipped.normal * signs, flipped.diffuse, flipped.roughness, flipped.specular)


def _signs(axes: tuple[int, ...]) -> tuple[float, float, float]:
    return (-1.0 if -1 in axes else 1.0, -1.0 if -2 in axes else 1.0, 1.0)
