"""What the baselines are trained on: pairs of light and view, and terms against their definitions."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from losses.baselines import DES18, DES19, GAO19, RenderingObjective
from losses.configurations import DES18_PAIRS, LightViewPairs
from nets.generator import svbrdf_to_maps
from nets.render import Geometry, render, shade, surface_points
from nets.svbrdf import MAPS, SVBRDF
from nets.training import Losses, TrainingBatch
from tests.helpers import assert_close, random_light, random_svbrdf, seeded

NOTHING = nn.ModuleDict()


class Constant(nn.Module):
    """Answers the same whatever it sees, and remembers what that was."""

    def __init__(self, maps: Tensor) -> None:
        super().__init__()
        self.maps = maps

    def forward(self, seen: Tensor) -> Tensor:
        self.seen = seen
        return self.maps


@pytest.fixture
def batch() -> TrainingBatch:
    truth, light = random_svbrdf(2, 12, 16, roughness=(0.3, 1.0)), random_light(2)
    return TrainingBatch(render(truth, light), truth, light)


def ask(objective: RenderingObjective, estimate: SVBRDF, batch: TrainingBatch, seed: int = 0) -> Losses:
    return objective(Constant(svbrdf_to_maps(estimate)), NOTHING, batch, seeded(seed))


# Light and view


def test_half_of_mirrors_is_up_where_they_meet() -> None:
    pairs = LightViewPairs(diffuse=0, mirror=5)
    geometry = pairs.sample(4, (64, 64), seeded(0))
    assert geometry.view.shape == (20, 3, 64, 64)
    up = geometry.half_vector[:, 2].flatten(1).amax(dim=1)
    assert float(up.min()) > math.cos(math.radians(2.0))  # within a pixel or so of the meeting point
    # And nowhere near it for lights and views that do not know of each other.
    strangers = LightViewPairs(diffuse=20, mirror=0).sample(1, (4, 4), seeded(0)).half_vector[:, 2]
    assert float(strangers.flatten(1).amax(dim=1).min()) < 0.9


def test_mirrors_meet_anywhere_on_the_surface() -> None:
    geometry = LightViewPairs(diffuse=0, mirror=200).sample(1, (32, 32), seeded(1))
    best = geometry.half_vector[:, 2].flatten(1).argmax(dim=1)
    places = surface_points(32, 32)[:2].flatten(1)[:, best]
    assert float(places.mean(dim=1).abs().max()) < 0.15
    assert float(places.std(dim=1).min()) == pytest.approx(math.sqrt(1 / 3), abs=0.1)


def test_geometries_are_of_unit_vectors_above_the_surface() -> None:
    geometry = DES18_PAIRS.sample(2, (5, 7), seeded(2))
    assert DES18_PAIRS.count == 9
    for vectors in (geometry.light_direction, geometry.view, geometry.half_vector):
        assert vectors.shape == (18, 3, 5, 7)
        assert_close(vectors.norm(dim=1), torch.ones(18, 5, 7))
        assert float(vectors[:, 2].min()) > 0.0
    far = geometry.light_direction[:6]
    assert_close(far, far[..., :1, :1].expand_as(far))
    light, half = geometry.light_direction, geometry.half_vector
    assert_close((light * half).sum(dim=1), (geometry.view * half).sum(dim=1), atol=1e-5)


# Terms


@pytest.mark.parametrize("objective", [DES18, DES19, GAO19], ids=["des18", "des19", "gao19"])
def test_the_answer_costs_nothing(objective: RenderingObjective, batch: TrainingBatch) -> None:
    losses = ask(objective, batch.truth, batch)
    assert float(losses.generator) == pytest.approx(0.0, abs=1e-4)
    assert losses.critics is None
    assert objective.judged == {}
    other = ask(objective, random_svbrdf(2, 12, 16, seed=5), batch)
    assert float(other.generator) > 0.1


def test_networks_of_photos_see_photos_and_the_auto_encoder_materials(batch: TrainingBatch) -> None:
    network = Constant(svbrdf_to_maps(batch.truth))
    for objective in (DES18, DES19):
        objective(network, NOTHING, batch, seeded(0))
        assert torch.equal(network.seen, batch.network_input)
    GAO19(network, NOTHING, batch, seeded(0))
    assert torch.equal(network.seen, svbrdf_to_maps(batch.truth))


def test_terms_and_weights_are_what_they_are_said_to_be(batch: TrainingBatch) -> None:
    estimate = random_svbrdf(2, 12, 16, seed=5, roughness=(0.3, 1.0))
    truth = batch.truth
    plain = {
        "normal": (estimate.normal - truth.normal).abs().mean(),
        **{name: 2 * (getattr(estimate, name) - getattr(truth, name)).abs().mean() for name in MAPS[1:]},
    }
    found = ask(GAO19, estimate, batch)
    for name in MAPS:
        assert_close(found.terms[name], plain[name])
    assert_close(found.generator, torch.stack([found.terms[name] for name in (*MAPS, "rendering")]).sum())

    found = ask(DES19, estimate, batch)
    for name in ("diffuse", "specular"):
        ratio = (getattr(estimate, name) + 0.01) / (getattr(truth, name) + 0.01)
        assert_close(found.terms[name], ratio.log().abs().mean(), rtol=1e-3)
    for name in ("normal", "roughness"):
        assert_close(found.terms[name], plain[name])
    assert_close(found.generator, found.terms["rendering"] + 0.1 * sum(found.terms[name] for name in MAPS))
    assert set(ask(DES18, estimate, batch).terms) == {"rendering"}


def test_every_geometry_lights_its_own_material(batch: TrainingBatch) -> None:
    """Against one rendering after the other, of every pixel."""
    objective = replace(DES18, stride=1)
    estimate = random_svbrdf(2, 12, 16, seed=5, roughness=(0.3, 1.0))
    stream = seeded(3)
    torch.randint(1, (2,), generator=stream)
    geometry = objective.pairs.sample(2, (12, 16), stream)
    distances = []
    for number in range(18):
        one = Geometry(
            *(getattr(geometry, name)[number : number + 1] for name in geometry.__dataclass_fields__)
        )
        pictures = [shade(material[number % 2], one) for material in (estimate, batch.truth)]
        distances.append(((pictures[0] + 0.1) / (pictures[1] + 0.1)).log().abs().mean())
    assert_close(
        ask(objective, estimate, batch, 3).terms["rendering"], torch.stack(distances).mean(), rtol=1e-3
    )


def test_strides_see_some_pixels_of_every_place(batch: TrainingBatch) -> None:
    material = SVBRDF.constant(12, 16, batch=2)
    marked = material.diffuse.clone().requires_grad_(True)
    estimate = SVBRDF(material.normal, marked, material.roughness, material.specular)
    seen = torch.zeros(12, 16)
    for seed in range(120):
        maps = svbrdf_to_maps(estimate)
        losses = replace(DES18, stride=4)(Constant(maps), NOTHING, batch, seeded(seed))
        (gradient,) = torch.autograd.grad(losses.generator, marked)
        touched = gradient.abs().sum(dim=(0, 1)) > 0.0
        assert int(touched.sum()) == 3 * 4
        seen += touched
    assert float(seen.min()) > 0.0
