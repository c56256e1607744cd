"""Test-time flips: one network, four mirrored views of the photo, one averaged material and light.

Convolutions with zero padding are not exactly symmetric, and neither is what was learned; the average of four
guesses has less error than one, in every map and in the light, for four times a fraction of a second.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nets.render import Camera, PointLight
from nets.svbrdf import SVBRDF

FLIPS = ((), (-1,), (-2,), (-2, -1))
"""Image axes to mirror: none, x, y, both."""


@runtime_checkable
class Predictor(Protocol):
    """A model with a `predict` method, as `nets.generator.Generator` has."""

    def predict(self, photo: Tensor) -> tuple[SVBRDF, PointLight]:
        """Estimate material and light of linear photos."""
        ...


@runtime_checkable
class PredictorUnderLight(Predictor, Protocol):
    """A model that makes use of a light that is known, as `nets.generator.Generator` does."""

    def predict_under(
        self, photo: Tensor, known: PointLight | None = None, camera: Camera | None = None
    ) -> tuple[SVBRDF, PointLight]:
        """Estimate material and light of linear photos under known lights."""
        ...


class FlipAverage:
    """A network whose `predict` averages over mirrored photos."""

    def __init__(self, network: Predictor) -> None:
        """Wrap a network; it is not copied."""
        self.network = network

    def predict(self, photo: Float[Tensor, "b 3 h w"]) -> tuple[SVBRDF, PointLight]:
        """Estimate material and light of linear photos, as `Generator.predict` does, from four views."""
        return self.predict_under(photo)

    @torch.no_grad()
    def predict_under(
        self,
        photo: Float[Tensor, "b 3 h w"],
        known: PointLight | None = None,
        camera: Camera | None = None,
    ) -> tuple[SVBRDF, PointLight]:
        """Do the same under known lights, if the network makes use of them.

        Args:
            photo: linear photos.
            known: one light per photo.
            camera: of the photos, likewise.
        """
        maps: list[Tensor] = []
        positions: list[Tensor] = []
        for axes in FLIPS:
            told = known and _mirror_light(known, axes)
            eye = camera and _mirror_camera(camera, axes)
            svbrdf, light = predict_under(self.network, photo.flip(axes), told, eye)
            maps.append(mirror(svbrdf, axes).channels())
            positions.append(_mirror_light(light, axes).position)
        mean = SVBRDF.from_channels(torch.stack(maps).mean(dim=0))
        normal = functional.normalize(mean.normal, dim=1)
        position = torch.stack(positions).mean(dim=0)
        return (
            SVBRDF(normal, mean.diffuse, mean.roughness, mean.specular),
            PointLight(position, light.intensity, light.falloff),
        )


def predict_under(
    model: Predictor, photo: Float[Tensor, "b 3 h w"], known: PointLight | None, camera: Camera | None
) -> tuple[SVBRDF, PointLight]:
    """Ask a model, telling it the light and the camera if it makes use of them."""
    if isinstance(model, PredictorUnderLight):
        return model.predict_under(photo, known, camera)
    return model.predict(photo)


def mirror(svbrdf: SVBRDF, axes: tuple[int, ...]) -> SVBRDF:
    """Mirror a material along image axes (-1: x, -2: y), its normals with it."""
    flipped = svbrdf.map(lambda tensor: tensor.flip(axes))
    signs = flipped.normal.new_tensor(_signs(axes))[:, None, None]
    return SVBRDF(flipped.normal * signs, flipped.diffuse, flipped.roughness, flipped.specular)


def _mirror_light(light: PointLight, axes: tuple[int, ...]) -> PointLight:
    return PointLight(
        light.position * light.position.new_tensor(_signs(axes)), light.intensity, light.falloff
    )


def _mirror_camera(camera: Camera, axes: tuple[int, ...]) -> Camera:
    x, y, z = (sign * coordinate for sign, coordinate in zip(_signs(axes), camera.position, strict=True))
    return replace(camera, position=(x, y, z))


def _signs(axes: tuple[int, ...]) -> tuple[float, float, float]:
    return (-1.0 if -1 in axes else 1.0, -1.0 if -2 in axes else 1.0, 1.0)
