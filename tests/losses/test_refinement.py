"""The data term of refinement: a log distance that knows what a clipped pixel does not say."""

from __future__ import annotations

import math

import pytest
import torch

from losses.refinement import photo_distance
from losses.reflectance import log_l1
from tests.helpers import gradcheck, seeded


def images() -> tuple[torch.Tensor, torch.Tensor]:
    rendering, photo = torch.rand(2, 1, 3, 4, 5, generator=seeded(0), dtype=torch.float64)
    return 2.0 * rendering + 0.01, photo


def test_unclipped_it_is_the_log_distance() -> None:
    rendering, photo = images()
    seen = torch.ones(1, 1, 4, 5, dtype=torch.bool)
    assert float(photo_distance(rendering, photo, seen)) == float(log_l1(rendering, photo))
    assert float(photo_distance(photo, photo, seen)) == 0.0


@pytest.mark.parametrize(
    ("radiance", "unsaturated", "expected"),
    [
        (5.0, False, 0.0),  # brighter than clipped: explained
        (1.0, False, 0.0),
        (0.495, False, math.log(2.0)),  # darker than clipped: not explained
        (5.0, True, math.log(5.01 / 1.01)),
        (0.495, True, math.log(2.0)),
    ],
)
def test_a_clipped_pixel_says_at_least_one(radiance: float, unsaturated: bool, expected: float) -> None:
    rendering, photo = torch.full((1, 3, 2, 2), radiance), torch.ones(1, 3, 2, 2)
    seen = torch.full((1, 1, 2, 2), unsaturated)
    assert float(photo_distance(rendering, photo, seen)) == pytest.approx(expected, abs=1e-5)


def test_only_the_masked_pixels_are_forgiven() -> None:
    seen = torch.tensor([[[[True, False]]]])
    distance = photo_distance(torch.full((1, 3, 1, 2), 2.01), torch.ones(1, 3, 1, 2), seen, offset=0.01)
    assert float(distance) == pytest.approx(math.log(2.02 / 1.01) / 2)


def test_forgiven_pixels_have_no_gradient_and_others_do() -> None:
    rendering = torch.tensor([2.0, 2.0, 0.5]).expand(1, 3, 1, 3).clone().requires_grad_(True)
    photo_distance(rendering, torch.ones(1, 3, 1, 3), torch.tensor([[[[True, False, False]]]])).backward()
    assert rendering.grad is not None
    brighter, forgiven, darker = rendering.grad[0, 0, 0].tolist()
    assert brighter > 0.0
    assert forgiven == 0.0
    assert darker < 0.0


def test_black_is_finite() -> None:
    black = torch.zeros(1, 3, 2, 2, requires_grad=True)
    seen = torch.ones(1, 1, 2, 2, dtype=torch.bool)
    distance = photo_distance(black, torch.full((1, 3, 2, 2), 0.5), seen)
    distance.backward()
    assert float(distance.detach()) == pytest.approx(math.log(51.0), rel=1e-5)
    assert black.grad is not None
    assert bool(torch.isfinite(black.grad).all())


@pytest.mark.parametrize("offset", [0.01, 0.1])
def test_gradients(offset: float) -> None:
    rendering, photo = images()
    seen = photo[:, :1] < 0.7
    gradcheck(lambda image: photo_distance(image, photo, seen, offset), rendering)
