"""Map, rendering and light terms on cases small enough to compute by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from losses.reflectance import LOG_OFFSET, light_l1, log_l1, map_l1, rendering_log_l1
from nets.render import Camera, PointLight, render
from nets.svbrdf import MAPS, SVBRDF
from tests.helpers import assert_close, gradcheck, random_light, random_svbrdf, seeded


@pytest.mark.parametrize("name", ["diffuse", "roughness", "specular"])
def test_map_l1_is_the_mean_in_the_networks_range(name: str) -> None:
    truth = SVBRDF.constant(3, 4, diffuse=0.5, roughness=0.5, specular=0.5)
    estimate = SVBRDF.constant(3, 4, **{"diffuse": 0.5, "roughness": 0.5, "specular": 0.5, name: 0.6})
    terms = map_l1(estimate, truth)
    assert list(terms) == list(MAPS)
    expected = {other: 0.2 if other == name else 0.0 for other in MAPS}  # [0, 1] to [-1, 1] doubles
    assert {key: float(value) for key, value in terms.items()} == pytest.approx(expected, abs=1e-6)


def test_map_l1_of_normals_is_of_their_coordinates() -> None:
    flat = SVBRDF.constant(2, 2)
    tilted = replace(flat, normal=torch.tensor([0.6, 0.0, 0.8])[:, None, None].expand_as(flat.normal))
    assert float(map_l1(tilted, flat)["normal"]) == pytest.approx((0.6 + 0.0 + 0.2) / 3)


def test_map_l1_counts_one_wrong_pixel_by_its_share() -> None:
    truth = SVBRDF.constant(2, 5, roughness=0.5)
    roughness = truth.roughness.clone()
    roughness[0, 0, 1, 3] = 1.0
    assert float(map_l1(replace(truth, roughness=roughness), truth)["roughness"]) == pytest.approx(1.0 / 10)


def test_log_l1_by_hand() -> None:
    image, reference = torch.tensor([0.99, 0.0]), torch.tensor([0.09, 0.0])
    assert LOG_OFFSET == 0.01
    assert float(log_l1(image, reference)) == pytest.approx(math.log(10.0) / 2)
    assert float(log_l1(image, reference, offset=0.81)) == pytest.approx(math.log(2.0) / 2)


def test_log_l1_weighs_ratios_not_differences() -> None:
    dark, bright = torch.tensor([0.1]), torch.tensor([10.0])
    assert float(log_l1(dark, 2 * dark)) == pytest.approx(float(log_l1(bright, 2 * bright)), rel=0.1)


def test_light_l1_by_hand() -> None:
    estimate = torch.tensor([[0.0, 1.0, 2.0], [0.0, 0.0, 0.0]])
    assert float(light_l1(estimate, torch.zeros(2, 3))) == pytest.approx(0.5)


@pytest.mark.parametrize("distance", [log_l1, light_l1])
def test_identity_and_symmetry(distance) -> None:  # type: ignore[no-untyped-def]
    a, b = torch.rand(2, 4, 3, generator=seeded(0))
    assert float(distance(a, a)) == 0.0
    assert float(distance(a, b)) == float(distance(b, a)) > 0.0


def test_rendering_distance_is_zero_only_for_what_looks_alike() -> None:
    material, lights = random_svbrdf(2), random_light(4)
    assert float(rendering_log_l1(material, material, lights)) == 0.0
    assert float(rendering_log_l1(material, random_svbrdf(2, seed=1), lights)) > 0.0
    # A black metal shows nothing of its diffuse albedo.
    metal = replace(material, specular=torch.ones_like(material.specular))
    painted = replace(metal, diffuse=torch.zeros_like(metal.diffuse))
    assert float(rendering_log_l1(painted, metal, lights)) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("kind", ["perspective", "orthographic", "collocated"])
def test_light_i_lights_material_i_modulo_the_batch(kind) -> None:  # type: ignore[no-untyped-def]
    estimate, truth, lights = random_svbrdf(2, seed=1), random_svbrdf(2, seed=2), random_light(6)
    camera = Camera(kind)
    parts = []
    for i in range(6):
        rendering = render(estimate[i % 2], lights[i : i + 1], camera)
        reference = render(truth[i % 2], lights[i : i + 1], camera)
        rendering[(reference >= 1.0) & (rendering > 1.0)] = 1.0
        parts.append(log_l1(rendering, reference.clamp(max=1.0), 0.1))
    found = rendering_log_l1(estimate, truth, lights, camera, offset=0.1)
    assert_close(found, torch.stack(parts).mean())


def test_white_is_white_but_too_dark_and_too_bright_count() -> None:
    light = PointLight.at((0.0, 0.0, 2.0), intensity=2.0)
    bright, brighter, dark = (SVBRDF.constant(2, 2, diffuse=d, specular=0.0) for d in (0.8, 0.9, 0.2))
    assert float(rendering_log_l1(brighter, bright, light)) == 0.0
    assert float(rendering_log_l1(dark, bright, light)) > 0.5
    assert float(rendering_log_l1(bright, dark, light)) > 0.5
    unclipped = log_l1(render(bright, light), render(dark, light))
    assert_close(rendering_log_l1(bright, dark, light), unclipped)


def test_the_truth_is_not_trained() -> None:
    estimate, truth = (random_svbrdf(1, seed=s).map(lambda t: t.requires_grad_(True)) for s in (0, 1))
    rendering_log_l1(estimate, truth, random_light()).backward()
    assert all(getattr(estimate, name).grad is not None for name in MAPS)
    assert all(getattr(truth, name).grad is None for name in MAPS)


def test_gradients() -> None:
    a, b = torch.rand(2, 2, 3, 2, 2, generator=seeded(3), dtype=torch.float64)
    gradcheck(lambda image: log_l1(image, b), a)
    gradcheck(light_l1, a[0, :, :, 0].T, b[0, :, :, 0].T)


def test_gradients_through_the_renderer() -> None:
    truth = random_svbrdf(1, 2, 2, seed=5, dtype=torch.float64)
    start = random_svbrdf(1, 2, 2, seed=6, dtype=torch.float64)
    lights = random_light(2, dtype=torch.float64)

    def distance(diffuse: Tensor, roughness: Tensor, specular: Tensor) -> Tensor:
        return rendering_log_l1(SVBRDF(start.normal, diffuse, roughness, specular), truth, lights)

    gradcheck(distance, start.diffuse, start.roughness, start.specular)
