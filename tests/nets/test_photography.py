"""Simulated flash photos: where the flash is, what a file keeps, only the render if all is off."""

from __future__ import annotations

import math

import pytest
import torch

from nets.color import gamma_encode
from nets.data.photography import FlashPhotography
from nets.render import Camera, PointLight, render
from nets.sampling import LightDistribution
from nets.svbrdf import SVBRDF
from tests.helpers import assert_close, random_svbrdf, seeded

PERFECT = FlashPhotography(exposure_share=0.0, falloff_share=0.0, noise_range=(0.0, 0.0))
HALF_STEP = 0.5 / 255 + 1e-5
COUNT = 4000


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 1.0])
def test_shares_of_centred_flashes(share: float) -> None:
    far = LightDistribution(max_angle=60.0, distance_range=(10.0, 12.0))
    photography = FlashPhotography(centred_share=share, centred_distance=(1.6, 4.0), lights=far)
    position = photography.sample_lights(COUNT, seeded(0)).position
    centred = torch.linalg.vector_norm(position, dim=1) < 9.0
    found = float(centred.float().mean())
    assert found == pytest.approx(share, abs=4.0 * math.sqrt(share * (1 - share) / COUNT))
    if bool(centred.any()):
        x, y, z = position[centred].unbind(dim=1)
        assert float(x.std()) == pytest.approx(0.25, rel=0.1)
        assert float(y.std()) == pytest.approx(0.25, rel=0.1)
        assert abs(float(x.mean())) < 0.03
        assert 1.6 - 1e-4 <= float(z.min()) < 1.65
        assert 3.9 < float(z.max()) <= 4.0 + 1e-4
        assert float(z.log().mean()) == pytest.approx((math.log(1.6) + math.log(4.0)) / 2, abs=0.05)


def test_the_other_flashes_are_the_distributions() -> None:
    light = FlashPhotography(centred_share=0.0).sample_lights(COUNT, seeded(1))
    distance = torch.linalg.vector_norm(light.position, dim=1)
    assert float(distance.min()) >= 1.0 - 1e-5
    assert float(distance.max()) <= 8.0 + 1e-4
    assert float((light.position[:, 2] / distance).min()) >= 0.5 - 1e-5
    assert torch.equal(light.intensity, torch.ones(COUNT, 3))


@pytest.mark.parametrize("kind", ["perspective", "orthographic", "collocated"])
def test_without_imperfections_a_photo_is_the_clipped_render(kind) -> None:  # type: ignore[no-untyped-def]
    photography = FlashPhotography(
        exposure_share=0.0, falloff_share=0.0, noise_range=(0.0, 0.0), camera=Camera(kind)
    )
    truth = random_svbrdf(3, 12, 9, seed=2)
    photo, light = photography.take(truth, seeded(0))
    expected = gamma_encode(render(truth, light, Camera(kind)))
    assert_close(gamma_encode(photo), expected, atol=HALF_STEP, rtol=0)
    assert float(expected.std()) > 0.05


def test_a_photo_is_a_file_of_eight_bits() -> None:
    photo, _ = FlashPhotography().take(random_svbrdf(4, 16, 16), seeded(0))
    assert photo.shape == (4, 3, 16, 16)
    assert float(photo.min()) >= 0.0
    assert float(photo.max()) <= 1.0
    levels = photo ** (1 / 2.2) * 255.0
    assert_close(levels, levels.round(), atol=1e-3, rtol=0)


def test_falloff_share() -> None:
    truth = random_svbrdf(3, 8, 8, seed=1)
    always = FlashPhotography(exposure_share=0.0, falloff_share=1.0, noise_range=(0.0, 0.0))
    photo, light = always.take(truth, seeded(0))
    falling = PointLight(light.position, light.intensity, falloff="inverse_square")
    assert_close(gamma_encode(photo), gamma_encode(render(truth, falling)), atol=HALF_STEP, rtol=0)
    assert light.falloff == "none"


def test_exposure_and_balance_are_one_factor_per_channel() -> None:
    matte = SVBRDF.constant(8, 8, diffuse=0.3, roughness=1.0, specular=0.0, batch=400)
    off = FlashPhotography(exposure_share=1.0, falloff_share=0.0, noise_range=(0.0, 0.0))
    photo, light = off.take(matte, seeded(0))
    ratio = (photo / render(matte, light)).mean(dim=(2, 3)).log()
    exposure = ratio.mean(dim=1)
    assert float(exposure.std()) == pytest.approx(math.hypot(0.15, 0.05 / math.sqrt(3)), rel=0.15)
    assert float((ratio - exposure[:, None]).std()) == pytest.approx(0.05 * math.sqrt(2 / 3), rel=0.15)
    never, light = PERFECT.take(matte, seeded(0))
    assert float((never / render(matte, light)).mean(dim=(2, 3)).log().abs().max()) < 0.03  # rounding alone


@pytest.mark.parametrize("sigma", [0.01, 0.03])
def test_noise_has_its_deviation(sigma: float) -> None:
    matte = SVBRDF.constant(48, 48, diffuse=0.3, roughness=1.0, specular=0.0)
    noisy = FlashPhotography(exposure_share=0.0, falloff_share=0.0, noise_range=(sigma, sigma))
    photo, light = noisy.take(matte, seeded(0))
    difference = gamma_encode(photo) - gamma_encode(render(matte, light))
    assert float(difference.std()) == pytest.approx(math.hypot(sigma, 1 / 255 / math.sqrt(12)), rel=0.05)


def test_one_seed_one_photo() -> None:
    truth = random_svbrdf(3, 8, 8)
    (first, light), (again, same), (other, _) = (
        FlashPhotography().take(truth, seeded(seed)) for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert torch.equal(light.position, same.position)
    assert not torch.equal(first, other)


def test_photos_carry_no_gradient_of_their_own() -> None:
    photo, light = FlashPhotography().take(random_svbrdf(), seeded(0))
    assert not photo.requires_grad
    assert not light.position.requires_grad
