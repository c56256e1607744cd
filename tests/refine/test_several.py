"""Several photos of one surface say more than one: through the library."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from nets.data.pool_format import from_planes
from nets.data.procedural import generate
from nets.render import Camera, PointLight, render
from nets.svbrdf import SVBRDF
from refine import Refined, Refiner
from refine.calibration import SelfCalibration
from refine.capture import Capture
from refine.errors import UserError
from refine.several import complete, initialize_together

SIZE = 64
POSITIONS = ((0.0, 0.1, 3.0), (0.9, 0.1, 2.9), (-0.8, -0.2, 3.1), (0.1, 0.9, 3.0))
QUICK = SelfCalibration(blocks=8, distances=(3.2,), steps=10)


@cache
def truth() -> SVBRDF:
    return from_planes(generate("leather", SIZE, 3)).validate()


def lights() -> PointLight:
    position = torch.tensor(POSITIONS)
    return PointLight(position, (9.0 / position.square().sum(dim=1))[:, None].expand(-1, 3), "inverse_square")


def photos() -> list[Tensor]:
    linear = render(truth(), lights(), Camera("collocated")).clamp(max=1.0)
    return list(linear.split(1))


def model(photo: Tensor) -> tuple[SVBRDF, PointLight]:
    """Know the colours, more or less, and nothing of the relief."""
    size = photo.shape[-2:]
    colours = torch.nn.functional.interpolate(truth().diffuse, size) * 0.9
    return replace(SVBRDF.constant(*size, roughness=0.5, specular=0.05), diffuse=colours), PointLight.at(
        (0, 0, 2)
    )


def fit(given: list[Tensor], **more: object) -> Refined:
    refiner = Refiner(model, resolution=None)
    return refiner.fit_many(given, color_space="linear", calibration=QUICK, **more)  # type: ignore[arg-type]


def normal_error(svbrdf: SVBRDF) -> float:
    return float((svbrdf.normal - truth().normal).square().mean().sqrt())


def test_photos_of_known_lights_show_the_relief() -> None:
    found = fit(photos(), lights=lights(), iters=40)
    assert normal_error(found.svbrdf) < 0.8 * normal_error(found.initial)
    assert torch.equal(found.light.position, torch.tensor([POSITIONS[0]]))
    assert [other.light.position.tolist() for other in found.others if other.light] == [
        lights().position[n : n + 1].tolist() for n in range(1, 4)
    ]
    assert found.camera.kind == "collocated"
    assert "the first of 4 photos of one surface" in found.notes
    assert set(found.seconds) >= {"initialization", "lights"}
    found.svbrdf.validate()
    alone = Refiner(model, resolution=None, camera=Camera("collocated")).fit(
        photos()[0], light=found.light, color_space="linear", iters=40
    )
    assert normal_error(found.svbrdf) < normal_error(alone.svbrdf)


def test_lights_that_are_not_known_are_found() -> None:
    found = fit(photos(), iters=0)
    position = torch.cat([found.light.position, *(o.light.position for o in found.others if o.light)])
    assert float((position - lights().position).norm(dim=1).max()) < 0.5
    assert found.light.falloff == "inverse_square"
    assert torch.equal(found.svbrdf.channels(), found.initial.channels())


def test_the_median_forgets_what_one_photo_says() -> None:
    captures = [Capture(torch.full((1, 3, SIZE, SIZE), value), torch.ones(1, 1, SIZE, SIZE, dtype=torch.bool))
                for value in (0.2, 0.3, 0.9)]  # fmt: skip
    everywhere = [capture.unsaturated for capture in captures]

    def brightness(photo: Tensor) -> tuple[SVBRDF, PointLight]:
        return SVBRDF.constant(*photo.shape[-2:], diffuse=float(photo.mean())), PointLight.at((0, 0, 2))

    assert float(initialize_together(brightness, captures, everywhere).diffuse.mean()) == pytest.approx(
        0.3, abs=1e-4
    )
    # The last photo shows nothing of its own: the model sees the first instead.
    hidden = [*everywhere[:2], torch.zeros_like(everywhere[2])]
    assert float(initialize_together(brightness, captures, hidden).diffuse.mean()) == pytest.approx(
        0.2, abs=1e-4
    )


def test_what_is_not_seen_says_nothing_against_the_initialization() -> None:
    visible = torch.ones(1, 1, SIZE, SIZE, dtype=torch.bool)
    visible[..., :10] = False
    capture = Capture(photos()[0] * visible, visible, Camera("collocated"), PointLight.at((0, 0, 2)))
    initial = model(photos()[0])[0]
    found = complete(capture, visible, initial)
    expected = render(initial, PointLight.at((0, 0, 2)), Camera("collocated")).clamp(max=1.0)
    assert torch.equal(found.photo[..., :10], expected[..., :10])
    assert torch.equal(found.photo[..., 10:], capture.photo[..., 10:])
    assert complete(capture, torch.ones_like(visible), initial) is capture


def test_mistakes() -> None:
    with pytest.raises(UserError, match="needs two or more"):
        fit(photos()[:1])
    with pytest.raises(ValueError, match="4 lights are given for 2 photos"):
        fit(photos()[:2], lights=lights())
    with pytest.raises(UserError, match="must be in register"):
        fit([photos()[0], photos()[1][..., 1:]])
