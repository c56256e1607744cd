"""Test-time flips against what mirrors do: rendering commutes with them, and symmetric guesses stay."""

import pytest
import torch

from nets.ensemble import FLIPS, FlipAverage, mirror
from nets.generator import Generator, GeneratorConfig
from nets.render import Camera, PointLight, render
from nets.svbrdf import SVBRDF
from tests.helpers import random_svbrdf, seeded


@pytest.mark.parametrize("axes", FLIPS)
def test_a_mirrored_material_under_a_mirrored_light_is_the_mirrored_picture(axes: tuple[int, ...]) -> None:
    material, light = (
        random_svbrdf(1).map(torch.Tensor.double),
        PointLight.at((0.4, -0.3, 1.7)).to(torch.float64),
    )
    signs = [(-1.0 if -1 in axes else 1.0), (-1.0 if -2 in axes else 1.0), 1.0]
    mirrored = PointLight(light.position * torch.tensor(signs, dtype=torch.float64), light.intensity)
    picture = render(mirror(material, axes), mirrored, Camera())
    assert torch.allclose(picture, render(material, light, Camera()).flip(axes), atol=1e-12)


def test_an_exact_model_is_not_changed() -> None:
    truth, position = random_svbrdf(1), torch.tensor([[0.4, -0.3, 1.7]])
    photo = render(truth, PointLight(position, torch.ones(1, 3)))

    class Exact:
        def predict(self, seen: torch.Tensor) -> tuple[SVBRDF, PointLight]:
            for axes in FLIPS:
                if torch.equal(seen, photo.flip(axes)):
                    signs = torch.tensor([-1.0 if -1 in axes else 1.0, -1.0 if -2 in axes else 1.0, 1.0])
                    return mirror(truth, axes), PointLight(position * signs, torch.ones(1, 3))
            raise AssertionError("a view that is no mirror image")

    svbrdf, light = FlipAverage(Exact()).predict(photo)
    assert torch.allclose(svbrdf.channels(), truth.channels(), atol=1e-6)
    assert torch.allclose(light.position, position)


def test_the_average_is_symmetric_and_legal() -> None:
    torch.manual_seed(0)
    network = FlipAverage(Generator(GeneratorConfig(width=2, levels=4, deep_multiplier=2)))
    photo = torch.rand(2, 3, 32, 32, generator=seeded(1))
    svbrdf, light = network.predict(photo)
    svbrdf.validate()
    turned, turned_light = network.predict(photo.flip(-1))
    assert torch.allclose(mirror(turned, (-1,)).channels(), svbrdf.channels(), atol=1e-5)
    assert torch.allclose(turned_light.position[:, 0], -light.position[:, 0], atol=1e-5)
    alone = network.network.predict(photo)[0]
    assert not torch.allclose(alone.channels(), svbrdf.channels(), atol=1e-3)


def test_a_known_light_is_mirrored_with_the_photo() -> None:
    asked: list[tuple[torch.Tensor, PointLight | None, Camera | None]] = []

    class Listens:
        def predict(self, photo: torch.Tensor) -> tuple[SVBRDF, PointLight]:
            raise AssertionError("what is known is to be told")

        def predict_under(
            self, photo: torch.Tensor, known: PointLight | None = None, camera: Camera | None = None
        ) -> tuple[SVBRDF, PointLight]:
            asked.append((photo, known, camera))
            return SVBRDF.constant(8, 8), PointLight.at((0.0, 0.0, 2.0))

    truth, known = random_svbrdf(1, 8, 8), PointLight.at((0.4, -0.3, 1.7), 0.9, falloff="inverse_square")
    camera = Camera(position=(0.2, 0.1, 2.5))
    photo = render(truth, known, camera)
    FlipAverage(Listens()).predict_under(photo, known, camera)
    assert len(asked) == len(FLIPS)
    for axes, (seen, light, eye) in zip(FLIPS, asked, strict=True):
        assert light is not None
        assert torch.allclose(render(mirror(truth, axes), light, eye), seen, atol=1e-5)


def test_who_makes_no_use_of_lights_is_not_told() -> None:
    class Deaf:
        def predict(self, photo: torch.Tensor) -> tuple[SVBRDF, PointLight]:
            return SVBRDF.constant(8, 8), PointLight.at((0.0, 0.0, 2.0))

    known = PointLight.at((0.4, -0.3, 1.7))
    _, light = FlipAverage(Deaf()).predict_under(torch.rand(1, 3, 8, 8), known)
    assert light.position.tolist() == [[0.0, 0.0, 2.0]]
