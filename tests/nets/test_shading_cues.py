"""Shading cues: coordinates, local contrast, and that they point where slopes do."""

from __future__ import annotations

import pytest
import torch

from nets.color import to_network_input
from nets.render import PointLight, render, surface_points
from nets.shading_cues import CUES, LARGEST_CONTRAST, NEIGHBOURHOOD, local_contrast, shading_cues
from nets.svbrdf import SVBRDF
from tests.helpers import assert_close, seeded


def bumpy(size: int, deviation: float) -> SVBRDF:
    """Grey plaster with independent slopes at every fourth pixel."""
    coarse = deviation * torch.randn(1, 2, size // 4, size // 4, generator=seeded(3))
    slopes = coarse.repeat_interleave(4, dim=-1).repeat_interleave(4, dim=-2)
    normal = torch.nn.functional.normalize(torch.cat([slopes, torch.ones(1, 1, size, size)], dim=1), dim=1)
    grey = torch.full((1, 3, size, size), 0.4)
    return SVBRDF(normal, grey, torch.full((1, 1, size, size), 0.9), torch.full_like(grey, 0.02))


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (32, 32), (64, 20)])
def test_the_first_two_are_coordinates(size: tuple[int, int]) -> None:
    cues = shading_cues(torch.rand(2, 3, *size, generator=seeded(0)) * 2 - 1)
    assert cues.shape == (2, CUES, *size)
    assert_close(cues[:, :2], surface_points(*size)[:2].expand(2, -1, -1, -1))
    assert bool(torch.isfinite(cues).all())


def test_a_plain_photo_has_no_contrast() -> None:
    for level in (-1.0, 0.0, 1.0):
        assert_close(local_contrast(torch.full((1, 3, 40, 40), level)), torch.zeros(1, 1, 40, 40), atol=1e-6)


def test_contrast_is_relative_to_the_neighbourhood_and_bounded() -> None:
    photo = torch.full((1, 3, 64, 64), -1.0)
    photo[..., 32, 32] = 1.0
    contrast = local_contrast(photo)
    assert float(contrast[0, 0, 32, 32]) == LARGEST_CONTRAST
    assert float(contrast[0, 0, 0, 0]) == 0.0
    side = 2 * round(NEIGHBOURHOOD * 64 / 2) + 1
    mean = 1.0 / side**2
    assert float(contrast[0, 0, 31, 32]) == pytest.approx(-mean / (mean + 0.05), rel=1e-5)
    assert int((contrast != 0).sum()) == side**2


def test_the_neighbourhood_is_a_plain_mean_also_at_the_border() -> None:
    photo = torch.rand(1, 3, 16, 16, generator=seeded(1), dtype=torch.float64) * 2 - 1
    brightness = (photo.mean(dim=1)[0] + 1) / 2
    mean = brightness[0:2, 0:2].mean()  # radius 1 around the corner pixel
    expected = (brightness[0, 0] - mean) / (mean + 0.05)
    assert float(local_contrast(photo)[0, 0, 0, 0]) == pytest.approx(float(expected), rel=1e-12)


def test_cues_turn_and_mirror_with_the_photo() -> None:
    photo = torch.rand(1, 3, 24, 24, generator=seeded(2)) * 2 - 1
    cues, mirrored = shading_cues(photo), shading_cues(photo.flip(-1)).flip(-1)
    assert_close(mirrored * torch.tensor([-1.0, 1.0, -1.0, 1.0])[:, None, None], cues, atol=1e-6)


def test_under_a_flash_the_cues_point_along_the_slopes() -> None:
    material = bumpy(128, 0.15)
    photo = render(material, PointLight.at((0.0, 0.0, 2.0)))
    cues = shading_cues(to_network_input(photo))[:, 2:]
    points = surface_points(128, 128)[:2]
    radial = (material.normal[:, :2] * points).sum(dim=1)
    found = (cues * points).sum(dim=1)
    outside = points.norm(dim=0)[None] > 0.5
    correlation = torch.corrcoef(torch.stack([radial[outside], found[outside]]))[0, 1]
    assert float(correlation) > 0.8
