"""Several photos of one surface give their lights away, and what is known of them is kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from nets.color import linear_to_srgb, srgb_to_linear
from nets.data.pool_format import from_planes
from nets.data.procedural import generate
from nets.render import Camera, PointLight, render, surface_points
from nets.svbrdf import SVBRDF
from refine.calibration import SelfCalibration, calibrate, moving_highlights
from refine.capture import Capture

SIZE = 64
COLLOCATED = Camera("collocated")
POSITIONS = ((0.0, 0.1, 4.0), (0.9, 0.1, 3.8), (-0.8, -0.2, 4.1), (0.1, 0.9, 4.0), (-0.1, -1.0, 3.9))
EXPOSURES = (1.0, 1.1, 0.9, 1.05, 0.95)
ALLOWED = 0.05
QUICK = SelfCalibration(blocks=8, distances=(2.5, 5.0), steps=15)


@cache
def leather() -> SVBRDF:
    return from_planes(generate("leather", SIZE, 3)).validate()


def true_lights() -> PointLight:
    position = torch.tensor(POSITIONS)
    intensity = torch.tensor(EXPOSURES) * 16.0 / position.square().sum(dim=1)
    return PointLight(position, intensity[:, None].expand(-1, 3), "inverse_square")


def photographed(material: SVBRDF, lights: PointLight, camera: Camera = COLLOCATED) -> list[Capture]:
    """Take 8-bit photos whose highlights are saturated."""
    linear = 2.2 * render(material, lights, camera)
    assert float(linear.max()) > 1.0
    rounded = srgb_to_linear((linear_to_srgb(linear.clamp(max=1.0)) * 255.0).round() / 255.0)
    unsaturated = (rounded < 1.0).all(dim=1, keepdim=True)
    return [Capture(rounded[n : n + 1], unsaturated[n : n + 1], camera) for n in range(len(rounded))]


def guess() -> SVBRDF:
    """A material as a network might see it: a little of everything wrong."""
    truth = leather()
    wrong = replace(truth, roughness=truth.roughness * 1.2, diffuse=truth.diffuse * 0.8)
    return SVBRDF(wrong.normal, wrong.diffuse, wrong.roughness.clamp(max=1.0), wrong.specular).validate()


def errors(found: PointLight, positions: Sequence[Sequence[float]] = POSITIONS) -> Tensor:
    truth = torch.tensor(positions)
    return (found.position - truth).norm(dim=1) / truth.norm(dim=1)


def test_lights_and_exposures_are_found() -> None:
    found = calibrate(guess(), photographed(leather(), true_lights()), "inverse_square", QUICK).lights
    assert float(errors(found).max()) < ALLOWED
    truth = true_lights().intensity
    relative = found.intensity / truth
    assert float((relative / relative.mean()).log().abs().max()) < 0.05
    assert found.falloff == "inverse_square"
    assert float(found.intensity.log().mean().abs()) < 1e-5
    assert found.position.dtype == found.intensity.dtype == torch.float32


def test_known_positions_are_kept_and_exposures_found() -> None:
    truth = true_lights()
    known = PointLight(truth.position, torch.ones(len(POSITIONS), 3), "inverse_square")
    captures = photographed(leather(), truth)
    found = calibrate(guess(), captures, "inverse_square", QUICK, known=known).lights
    assert torch.equal(found.position, truth.position)
    relative = found.intensity / truth.intensity
    assert float((relative / relative.mean()).log().abs().max()) < 0.03


@pytest.mark.parametrize("camera", [COLLOCATED, Camera("orthographic")])
def test_highlights_are_found_under_the_lights(camera: Camera) -> None:
    material = SVBRDF.constant(SIZE, SIZE, diffuse=0.2, roughness=0.35, specular=0.04)
    colours = torch.rand(1, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(1))
    photos = render(replace(material, diffuse=0.1 + 0.3 * colours), true_lights(), camera)
    found = moving_highlights(photos.double(), surface_points(SIZE, SIZE, dtype=torch.float64))
    towards = torch.tensor(POSITIONS)[:, :2].double()
    # Not at the mirror, which may be outside of the photo, but on that side of the others.
    for axis in (0, 1):
        assert torch.equal(found[:, axis].argmin(), towards[:, axis].argmin())
        assert torch.equal(found[:, axis].argmax(), towards[:, axis].argmax())


def test_a_saturated_photo_does_not_mislead() -> None:
    captures = photographed(leather(), true_lights())
    burnt = replace(
        captures[1],
        photo=torch.ones_like(captures[1].photo),
        unsaturated=torch.zeros_like(captures[1].unsaturated),
    )
    found = calibrate(
        guess(), [captures[0], burnt, *captures[2:]], "inverse_square", QUICK, known=true_lights()
    ).lights
    others = [0, 2, 3, 4]
    relative = (found.intensity / true_lights().intensity)[others]
    assert float((relative / relative.mean()).log().abs().max()) < 0.05
    assert bool(torch.isfinite(found.intensity).all())
