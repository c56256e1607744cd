"""Augmentation keeps materials legal, and turns normals with the picture."""

import math
import time
from dataclasses import replace

import pytest
import torch

from nets.data.augment import (
    METAL_DIFFUSE,
    Augmentation,
    Pose,
    augment,
    draw_pose,
    jitter,
    mix,
    plate,
    view_tile,
)
from nets.data.images import unit_normal
from nets.render import Camera, PointLight, render
from nets.svbrdf import SVBRDF
from tests.helpers import random_svbrdf, seeded

ORTHOGRAPHIC = Camera("orthographic")
QUARTERS = [0.0, 0.5 * math.pi, math.pi, 1.5 * math.pi]


def smooth_material(size: int, batch: int = 1, seed: int = 0, cycles: int = 2) -> SVBRDF:
    """A material of a few low waves per map, the same at every resolution."""
    generator = torch.Generator().manual_seed(seed)
    axis = (torch.arange(size) + 0.5) / size * 2 - 1
    y, x = torch.meshgrid(-axis, axis, indexing="ij")
    frequency = (torch.rand(batch, 10, 2, generator=generator) * 2 - 1) * cycles
    phase = torch.rand(batch, 10, generator=generator) * 6.3
    argument = frequency[..., :1, None] * x + frequency[..., 1:, None] * y + phase[..., None, None]
    waves = torch.sin(argument)
    normal = unit_normal(torch.cat([waves[:, :2] * 0.4, torch.ones_like(waves[:, :1])], dim=1))
    return SVBRDF(normal, waves[:, 2:5] * 0.2 + 0.4, waves[:, 5:6] * 0.15 + 0.5, waves[:, 6:9] * 0.1 + 0.2)


def pose(
    angle: float = 0.0, flip: bool = False, scale: float = 1.0, centre: tuple[float, float] = (0, 0)
) -> Pose:
    return Pose(
        torch.tensor([angle]), torch.tensor([flip]), torch.tensor([scale]), torch.tensor([centre]).float()
    )


def turned_light(light: PointLight, pose: Pose) -> PointLight:
    x, y = (pose.matrix()[0] @ light.position[0, :2]).tolist()
    return PointLight.at((x, y, float(light.position[0, 2])))


def turned_picture(picture: torch.Tensor, angle: float, flip: bool) -> torch.Tensor:
    """Turn pixels as a person would: mirror left and right, then by quarters counter-clockwise."""
    mirrored = picture.flip(-1) if flip else picture
    return torch.rot90(mirrored, round(angle / (math.pi / 2)), dims=(-2, -1))


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("angle", QUARTERS)
@pytest.mark.parametrize("camera", [ORTHOGRAPHIC, Camera()], ids=["orthographic", "centred"])
def test_turned_material_under_turned_light_is_the_turned_picture(
    angle: float, flip: bool, camera: Camera
) -> None:
    material, light = smooth_material(32), PointLight.at((0.5, 0.9, 1.6))
    turn = pose(angle, flip)
    turned = render(view_tile(material, turn, 32), turned_light(light, turn), camera)
    expected = turned_picture(render(material, light, camera), angle, flip)
    torch.testing.assert_close(turned, expected, atol=2e-5, rtol=1e-4)
    if flip or angle:  # the light's direction matters: the test can fail
        still = render(view_tile(material, turn, 32), light, camera)
        assert float((still - expected).abs().mean()) > 0.01


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("angle", [0.4, 2.0, -1.1])
def test_any_angle_is_close_inside(angle: float, flip: bool) -> None:
    material, light = smooth_material(128), PointLight.at((0.5, 0.9, 1.6))
    turn = pose(angle, flip)
    turned = render(view_tile(material, turn, 128), turned_light(light, turn), ORTHOGRAPHIC)
    # The picture, turned as three plain channels (the diffuse map of a carrier) by the same resampling.
    picture = render(material, light, ORTHOGRAPHIC)
    carrier = SVBRDF.constant(128, 128)
    carrier = SVBRDF(carrier.normal, picture, carrier.roughness, carrier.specular)
    expected = view_tile(carrier, turn, 128).diffuse
    inside = slice(32, 96)
    difference = (turned - expected)[..., inside, inside].abs()
    assert float(picture.max()) < 1.0
    assert float(difference.max()) < 5e-3


def test_counter_clockwise_quarter_takes_the_top_to_the_left() -> None:
    material = SVBRDF.constant(8, 8, diffuse=0.0)
    material.diffuse[..., 0, :] = 1.0
    turned = view_tile(material, pose(math.pi / 2), 8)
    assert float(turned.diffuse[..., :, 0].min()) == 1.0
    assert float(turned.diffuse[..., :, 1:].max()) == 0.0


def test_crop_is_where_the_pose_says_and_keeps_slopes() -> None:
    material = smooth_material(64)
    seen = view_tile(material, pose(scale=0.5, centre=(0.5, 0.5)), 32)  # upper right quarter, native pixels
    for name in ("normal", "diffuse", "roughness", "specular"):
        expected = getattr(material, name)[..., :32, 32:]
        torch.testing.assert_close(getattr(seen, name), expected, atol=1e-5, rtol=1e-4)


def test_downsampling_averages_instead_of_skipping() -> None:
    material = SVBRDF.constant(128, 128)
    checks = (torch.arange(128)[:, None] + torch.arange(128)) % 2
    material.diffuse[:] = checks.float()
    # A point of a bilinear lookup may lie on one pixel; averaged, the checks are grey.
    seen = view_tile(material, pose(scale=0.93), 32).diffuse
    assert float((seen - 0.5).abs().max()) < 0.1


def test_drawn_views_lie_inside_the_tile() -> None:
    drawn = draw_pose(500, torch.Generator().manual_seed(3), Augmentation(any_angle=1.0))
    corners = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    inverse = drawn.matrix().transpose(1, 2)
    places = drawn.scale[:, None, None] * (corners @ inverse.transpose(1, 2)) + drawn.centre[:, None]
    assert float(places.abs().max()) < 1.0 + 1e-5
    assert bool(drawn.flip.any())
    assert not bool(drawn.flip.all())
    assert float(drawn.scale.min()) >= 0.55
    identity = inverse @ drawn.matrix() - torch.eye(2)
    assert float(identity.abs().max()) < 1e-5


@pytest.mark.parametrize("size", [16, 32, 48, 128])
def test_results_are_legal_and_of_the_size_asked(size: int) -> None:
    wild = Augmentation(mix_probability=1.0, hue=2.0, gain=1.0, exposure=1.0, saturation=1.0, relief=2.0)
    for seed in range(3):
        result = augment(
            smooth_material(64, 4, seed, 20), torch.Generator().manual_seed(seed), size=size, settings=wild
        )
        assert result.validate().size == (size, size)


def test_same_generator_state_same_result_and_input_untouched() -> None:
    material = smooth_material(48, 4)
    before = material.channels().clone()
    first, again, other = (
        augment(material, torch.Generator().manual_seed(seed), size=32).channels() for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.allclose(first, other)
    assert torch.equal(material.channels(), before)


def test_none_only_resizes() -> None:
    material = smooth_material(32, 2)
    result = augment(material, torch.Generator().manual_seed(0), size=32, settings=Augmentation.none())
    torch.testing.assert_close(result.channels(), material.channels(), atol=1e-5, rtol=1e-4)


def test_jitter_keeps_grey_reflectance_grey_and_whites_unclipped() -> None:
    material = SVBRDF.constant(4, 4, diffuse=1.0, specular=0.04, batch=16)
    ramp = torch.linspace(0.0, 1.0, 4)
    material.diffuse[:] = ramp
    result = jitter(material, torch.Generator().manual_seed(0), Augmentation(specular_hue=1.0, specular=0.5))
    assert float((result.specular - result.specular[:, :1]).abs().max()) < 1e-6
    assert float(result.specular.std()) > 0.005
    assert bool((result.diffuse.diff(dim=-1) > 0.0).all())  # nothing saturates: ramps stay ramps


def test_relief_scales_slopes() -> None:
    material = smooth_material(16, 8)
    settings = Augmentation(relief=0.5)
    result = jitter(material, torch.Generator().manual_seed(0), settings)
    ratio = (result.normal[:, :2] / result.normal[:, 2:]) / (material.normal[:, :2] / material.normal[:, 2:])
    factor = ratio.flatten(1).median(dim=1).values
    torch.testing.assert_close(ratio, factor[:, None, None, None].expand_as(ratio), rtol=1e-3, atol=1e-3)
    assert float(factor.log().std()) > 0.2
    steeper = jitter(material, torch.Generator().manual_seed(0), replace(settings, relief_factor=1.6))
    slopes = [m.normal[:, :2] / m.normal[:, 2:] for m in (steeper, result)]
    torch.testing.assert_close(slopes[0], 1.6 * slopes[1], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("smooth", [0.0, 1.0])
def test_mixed_maps_lie_between_the_two_materials(smooth: float) -> None:
    material = SVBRDF.cat([SVBRDF.constant(32, 32, diffuse=0.2), SVBRDF.constant(32, 32, diffuse=0.8)])
    settings = Augmentation(mix_probability=1.0, smooth_masks=smooth)
    mixed = mix(material, torch.Generator().manual_seed(0), settings).validate().diffuse
    assert float(mixed.min()) > 0.26 - 1e-6
    assert float(mixed.max()) < 0.74 + 1e-6
    varies = float(mixed.std(dim=(2, 3)).min()) > 1e-3
    assert varies == bool(smooth)
    untouched = mix(material, torch.Generator().manual_seed(0), Augmentation(mix_probability=0.0))
    assert torch.equal(untouched.diffuse, material.diffuse)


def test_tiles_must_be_square() -> None:
    with pytest.raises(ValueError, match="64 x 32"):
        augment(SVBRDF.constant(32, 64), torch.Generator(), size=16)


def test_a_training_batch_takes_little_processor_time() -> None:
    material, generator = smooth_material(384, 8), torch.Generator().manual_seed(0)
    augment(material, generator, size=128)
    started = time.process_time()
    for _ in range(3):
        augment(material, generator, size=128)
    # About 70 ms of one core; the bound is loose, for shared machines, and catches only other algorithms.
    assert (time.process_time() - started) / 3 < 0.5


# Metal


def test_metal_keeps_relief_and_turns_the_pattern_into_reflectance() -> None:
    svbrdf = random_svbrdf(64, 6, 6, seed=2)
    plated = plate(svbrdf, seeded(0), Augmentation(metal=1.0))
    plated.validate()
    assert torch.equal(plated.normal, svbrdf.normal)
    assert bool((plated.diffuse <= METAL_DIFFUSE * svbrdf.diffuse + 1e-7).all())
    assert bool((plated.roughness <= svbrdf.roughness + 1e-7).all())
    grey, pattern = plated.specular.mean(dim=1), svbrdf.diffuse.mean(dim=1)
    correlation = [
        float(torch.corrcoef(torch.stack([a.flatten(), b.flatten()]))[0, 1])
        for a, b in zip(grey, pattern, strict=True)
    ]
    assert sum(correlation) / len(correlation) > 0.5
    levels = plated.specular.mean(dim=(1, 2, 3))
    assert float(levels.min()) < 0.35
    assert float(levels.max()) > 0.6


def test_about_the_asked_share_becomes_metal_and_the_rest_stays() -> None:
    svbrdf = random_svbrdf(400, 2, 2, seed=3)
    plated = plate(svbrdf, seeded(1), Augmentation(metal=0.25))
    changed = (plated.specular != svbrdf.specular).flatten(1).any(dim=1)
    assert 0.18 < float(changed.float().mean()) < 0.32
    for before, after in zip(svbrdf.channels()[~changed], plated.channels()[~changed], strict=True):
        assert torch.equal(before, after)


def test_without_metal_no_random_number_is_drawn() -> None:
    svbrdf, generator = random_svbrdf(2, 4, 4), seeded(5)
    state = generator.get_state()
    assert plate(svbrdf, generator, Augmentation()) is svbrdf
    assert torch.equal(generator.get_state(), state)
