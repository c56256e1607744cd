"""Distributions of lights: moments, caps and clips, and one seed, one draw."""

from __future__ import annotations

import math

import pytest
import torch

from nets.sampling import PAPER_LIGHTS, YARDSTICK_LIGHTS, LightDistribution, cosine_weighted
from tests.helpers import assert_close, seeded

COUNT = 40_000


@pytest.mark.parametrize("max_angle", [20.0, 45.0, 60.0, 90.0])
def test_directions_are_cosine_weighted_on_the_cap(max_angle: float) -> None:
    direction = cosine_weighted(COUNT, seeded(0), max_angle=max_angle).double()
    assert_close(torch.linalg.vector_norm(direction, dim=1), torch.ones(COUNT), atol=1e-6)
    cosine, limit = direction[:, 2], math.cos(math.radians(max_angle))
    assert float(cosine.min()) >= limit - 1e-6
    assert float(cosine.min()) < limit + 0.05 * (1.0 - limit) + 0.02, "the cap is reached"
    # Density cos / pi: E[cos] = 2 (1 - c^3) / (3 (1 - c^2)) and E[cos^2] = (1 + c^2) / 2.
    for moment, expected in (
        (cosine, 2.0 * (1.0 - limit**3) / (3.0 * (1.0 - limit**2))),
        (cosine**2, (1.0 + limit**2) / 2.0),
        (direction[:, 0], 0.0),
        (direction[:, 1], 0.0),
        (direction[:, 0] * direction[:, 1], 0.0),
    ):
        error = float(moment.std()) / math.sqrt(COUNT)
        assert float(moment.mean()) == pytest.approx(expected, abs=4.0 * error)


def test_on_the_hemisphere_the_mean_cosine_is_two_thirds() -> None:
    assert float(cosine_weighted(COUNT, seeded(3))[:, 2].mean()) == pytest.approx(2.0 / 3.0, abs=5e-3)


def test_the_papers_distances_are_log_normal() -> None:
    light = PAPER_LIGHTS.sample(COUNT, seeded(1))
    logarithm = torch.linalg.vector_norm(light.position, dim=1).log()
    assert float(logarithm.mean()) == pytest.approx(1.0, abs=4.0 * 0.75 / math.sqrt(COUNT))
    assert float(logarithm.std()) == pytest.approx(0.75, rel=0.02)
    assert float(light.position[:, 2].min()) >= 0.0
    assert light.falloff == "none"
    assert torch.equal(light.intensity, torch.ones(COUNT, 3))


def test_yardstick_lights_respect_cap_and_clip() -> None:
    position = YARDSTICK_LIGHTS.sample(5_000, seeded(2)).position
    distance = torch.linalg.vector_norm(position, dim=1)
    assert float(distance.min()) == pytest.approx(1.5, abs=1e-4)
    assert float(distance.max()) == pytest.approx(8.0, abs=1e-4)
    assert float((position[:, 2] / distance).min()) >= math.cos(math.radians(45.0)) - 1e-5


def test_one_seed_one_draw() -> None:
    lights = LightDistribution()
    first, again, other = (lights.sample(7, seeded(seed)).position for seed in (5, 5, 6))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    torch.manual_seed(99)  # the global stream has no say
    assert torch.equal(lights.sample(7, seeded(5)).position, first)
