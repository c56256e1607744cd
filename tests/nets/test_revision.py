"""The second look: what it is told, that it begins as nothing, and that it can use what it is told."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nets.color import ENCODING_FLOOR, to_network_input
from nets.generator import Generator, GeneratorConfig, maps_to_svbrdf
from nets.light_head import light_from_output
from nets.render import Camera, PointLight, render, shade, shading_geometry, surface_points
from nets.revision import (
    FEEDBACK,
    LARGEST_FEEDBACK,
    RESIDUAL_SCALE,
    Revision,
    explaining_step,
    feedback,
)
from nets.svbrdf import SVBRDF
from tests.helpers import assert_close, random_light, random_svbrdf, seeded

WIDTHS = torch.tensor([0.14] * 3 + [0.12] * 3 + [0.16] + [0.11] * 3, dtype=torch.float64)


def told(estimate: SVBRDF, light: PointLight, photo: torch.Tensor) -> dict[str, torch.Tensor]:
    parts = feedback(estimate, light, photo).split([3, 3, 2, 10, 2], dim=1)
    return dict(zip(("rendering", "residual", "place", "step", "half_vector"), parts, strict=True))


def test_a_material_that_explains_its_photo_leaves_nothing() -> None:
    truth, light = random_svbrdf(2, 12, 20, seed=1), random_light(2, seed=1)
    radiance = render(truth, light)
    photo = to_network_input(radiance)
    found = told(truth, light, photo)
    seen = radiance > ENCODING_FLOOR  # darker is black
    assert sum(part.shape[1] for part in found.values()) == FEEDBACK
    assert bool(seen.float().mean() > 0.9)
    assert_close(found["rendering"][seen], photo[seen], atol=1e-5)  # white where the photo is white, too
    assert_close(found["residual"][seen], torch.zeros_like(photo)[seen], atol=1e-4)
    assert float((found["step"] * seen.all(dim=1, keepdim=True)).abs().max()) < 1e-2
    geometry = shading_geometry(surface_points(12, 20), light, Camera())
    assert_close(found["half_vector"], geometry.half_vector[:, :2].expand(2, -1, -1, -1))


@pytest.mark.parametrize("darker", [True, False])
def test_the_residual_is_how_much_brighter_the_photo_is(darker: bool) -> None:
    estimate = SVBRDF.constant(4, 4, diffuse=0.5)
    light = PointLight.at((0.0, 0.0, 2.0))
    step = -0.1 if darker else 0.1
    photo = to_network_input(render(estimate, light)) + 2.0 * step  # [-1, 1] has twice the range of [0, 1]
    residual = told(estimate, light, photo)["residual"]
    assert_close(residual, torch.full_like(residual, RESIDUAL_SCALE * step), atol=1e-4)


def test_a_mirrors_pixels_are_in_the_middle_of_their_lobes() -> None:
    light = PointLight.at((0.4, -0.3, 1.5))
    half_vector = shading_geometry(surface_points(8, 8), light, Camera()).half_vector
    flat = SVBRDF.constant(8, 8, roughness=0.7)
    facing = SVBRDF(half_vector, flat.diffuse, flat.roughness, flat.specular)
    photo = torch.zeros(1, 3, 8, 8)
    assert_close(told(facing, light, photo)["place"], torch.zeros(1, 2, 8, 8), atol=1e-5)
    slopes = half_vector[:, :2] / half_vector[:, 2:]
    expected = (slopes / 0.7**2).clamp(-LARGEST_FEEDBACK, LARGEST_FEEDBACK)
    assert_close(told(flat, light, photo)["place"], expected, atol=1e-5)


def test_extremes_stay_bounded_and_carry_no_gradient() -> None:
    estimate = SVBRDF.constant(8, 8, roughness=1e-3, specular=1.0).map(lambda t: t.requires_grad_())
    light = PointLight.at((3.0, 3.0, 0.2))
    found = feedback(estimate, light, torch.rand(1, 3, 8, 8, generator=seeded(0)) * 2 - 1)
    assert bool(torch.isfinite(found).all())
    assert float(found.abs().max()) <= LARGEST_FEEDBACK
    assert not found.requires_grad


def test_half_precision_around_it_changes_nothing() -> None:
    estimate, light = random_svbrdf(1, 8, 8, seed=3), random_light(1, seed=3)
    photo = torch.rand(1, 3, 8, 8, generator=seeded(1)) * 2 - 1
    with torch.autocast("cpu", dtype=torch.bfloat16):
        inside = feedback(estimate, light, photo)
    assert torch.equal(inside, feedback(estimate, light, photo))


def step_by_definition(estimate: SVBRDF, light: PointLight, target: torch.Tensor) -> torch.Tensor:
    """Solve every pixel's problem by itself with a dense Jacobian, in units of the widths."""
    geometry = shading_geometry(surface_points(*estimate.size, dtype=torch.float64), light, Camera())

    def shown(maps: torch.Tensor) -> torch.Tensor:
        material = SVBRDF.from_channels(maps)
        unit = material.normal / material.normal.norm(dim=1, keepdim=True)
        radiance = shade(SVBRDF(unit, material.diffuse, material.roughness, material.specular), geometry)
        picture = radiance.clamp(min=1e-3) ** (1 / 2.2)
        return torch.where((target == 1.0) & (picture > 1.0), 1.0, picture)

    maps = estimate.channels()
    dense = torch.autograd.functional.jacobian(shown, maps)  # [1, 3, h, w, 1, 10, h, w]
    step = torch.zeros_like(maps)
    for row in range(maps.shape[-2]):
        for column in range(maps.shape[-1]):
            jacobian = dense[0, :, row, column, 0, :, row, column] * WIDTHS
            residual = (target - shown(maps))[0, :, row, column]
            matrix = jacobian @ jacobian.T + 0.02**2 * torch.eye(3, dtype=torch.float64)
            step[0, :, row, column] = jacobian.T @ torch.linalg.solve(matrix, residual)
    return step


def test_the_step_solves_every_pixels_problem() -> None:
    truth, estimate = (random_svbrdf(1, 4, 5, seed=seed, dtype=torch.float64) for seed in (5, 6))
    light = random_light(1, seed=5, dtype=torch.float64)
    points = surface_points(4, 5, dtype=torch.float64)
    geometry = shading_geometry(points, light, Camera())
    target = (shade(truth, geometry) ** (1 / 2.2)).clamp(max=1.0)
    target[..., 0, 0] = 1.0  # saturated
    rendering, residual, step = explaining_step(estimate, geometry, target)
    assert_close(step, step_by_definition(estimate, light, target), rtol=1e-9, atol=1e-9)
    assert_close(rendering, shade(estimate, geometry).clamp(min=1e-3) ** (1 / 2.2))
    assert_close(residual[..., 1:], (target - rendering)[..., 1:])


def test_a_small_error_is_explained_by_the_step() -> None:
    truth = random_svbrdf(1, 6, 6, seed=7, dtype=torch.float64)
    geometry = shading_geometry(
        surface_points(6, 6, dtype=torch.float64),
        PointLight.at((0.2, 0.1, 2.0), dtype=torch.float64),
        Camera(),
    )
    estimate = SVBRDF(truth.normal, (truth.diffuse + 0.01).clamp(max=1.0), truth.roughness, truth.specular)
    target = shade(truth, geometry).clamp(min=1e-3) ** (1 / 2.2)
    _, before, step = explaining_step(estimate, geometry, target)
    moved = (
        estimate.channels()
        + step * torch.tensor([0.14] * 3 + [0.12] * 3 + [0.16] + [0.11] * 3)[:, None, None]
    )
    material = SVBRDF.from_channels(moved)
    unit = material.normal / material.normal.norm(dim=1, keepdim=True)
    stepped = SVBRDF(unit, material.diffuse, material.roughness.clamp(min=0.03), material.specular)
    _, after, _ = explaining_step(stepped, geometry, target)
    assert float(after.abs().median()) < 0.1 * float(before.abs().median())


def test_inference_mode_around_it_changes_nothing() -> None:
    estimate, light = random_svbrdf(1, 8, 8, seed=3), random_light(1, seed=3)
    photo = torch.rand(1, 3, 8, 8, generator=seeded(1)) * 2 - 1
    expected = feedback(estimate, light, photo)
    with torch.inference_mode():
        inside = feedback(estimate.map(torch.clone), light, photo.clone())
    assert torch.equal(inside.clone(), expected)


def revised(channels: int = 4) -> Generator:
    torch.manual_seed(0)
    return Generator(
        GeneratorConfig(2, 4, 2, shading_cues=True, detail_channels=4, revision_channels=channels)
    )


@torch.no_grad()
def test_it_begins_as_no_correction() -> None:
    network = revised().eval()
    plain = Generator(GeneratorConfig(2, 4, 2, shading_cues=True, detail_channels=4)).eval()
    plain.load_state_dict({k: v for k, v in network.state_dict().items() if not k.startswith("revision.")})
    photo = torch.rand(2, 3, 32, 16, generator=seeded(2)) * 2 - 1
    for ours, theirs in zip(network(photo), plain(photo), strict=True):
        assert_close(ours, theirs)


def stirred() -> Generator:
    """A network whose revision does something."""
    network = revised().eval()
    assert network.revision is not None
    torch.nn.init.normal_(network.revision.last.weight, std=0.05, generator=seeded(8))
    return network


@torch.no_grad()
def test_it_looks_as_often_as_it_is_told_to() -> None:
    once = stirred()
    twice = Generator(replace(once.config, revision_passes=2)).eval()
    twice.load_state_dict(once.state_dict())
    assert once.revision is not None
    photo = torch.rand(1, 3, 32, 16, generator=seeded(2)) * 2 - 1
    maps, light = once(photo)
    assert torch.equal(twice(photo)[1], light)
    found = feedback(maps_to_svbrdf(maps), light_from_output(light), photo)
    expected = torch.tanh(torch.atanh(maps) + once.revision(once.see(photo), maps, found))
    assert_close(twice(photo)[0], expected, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(expected, maps, atol=1e-3)


@torch.no_grad()
def test_a_light_that_is_known_is_looked_under_and_not_repeated() -> None:
    network = stirred()
    photo = torch.rand(2, 3, 32, 16, generator=seeded(2))
    maps, guess = network.predict(photo)
    under_guess, _ = network.predict_under(photo, guess)
    assert_close(under_guess.channels(), maps.channels(), rtol=1e-4, atol=1e-5)
    known = PointLight.at((0.5, -0.4, 1.4)).expand(2)
    under_known, still = network.predict_under(photo, known)
    assert not torch.allclose(under_known.channels(), maps.channels(), atol=1e-3)
    assert torch.equal(still.position, guess.position)
    elsewhere, _ = network.predict_under(photo, known, Camera("collocated"))
    assert not torch.allclose(elsewhere.channels(), under_known.channels(), atol=1e-3)


def test_every_weight_is_trained_once_the_last_is_not_zero() -> None:
    network = revised()
    assert network.revision is not None
    torch.nn.init.normal_(network.revision.last.weight)
    maps, light = network(torch.rand(2, 3, 32, 16, generator=seeded(3)) * 2 - 1)
    assert maps.shape == (2, 10, 32, 16)
    assert float(maps.detach().abs().max()) <= 1.0
    (maps.sum() + light.sum()).backward()
    assert all(bool(parameter.grad.abs().max() > 0) for parameter in network.revision.parameters())
    assert all(parameter.grad is not None for parameter in network.parameters())


def test_it_learns_to_take_from_the_residual_what_the_maps_lack() -> None:
    """Diffuse albedo is off by an unknown share of its own for each pixel: only the residual knows it."""
    torch.manual_seed(1)
    revision = Revision(8, 3)
    optimizer = torch.optim.Adam(revision.parameters(), 3e-3)
    light = PointLight.at((0.0, 0.0, 2.14)).expand(4)

    def example(seed: int) -> tuple[torch.Tensor, ...]:
        generator = seeded(seed)
        true, wrong = (0.2 + 0.6 * torch.rand(4, 1, 16, 16, generator=generator) for _ in range(2))
        flat = SVBRDF.constant(16, 16, roughness=0.9, specular=0.0, batch=4)
        truth, estimate = (
            SVBRDF(flat.normal, d.expand(-1, 3, -1, -1), flat.roughness, flat.specular) for d in (true, wrong)
        )
        photo = to_network_input(render(truth, light))
        maps = estimate.channels() * 2 - 1
        found = feedback(estimate, light, photo)
        correction = revision(torch.zeros(4, 3, 16, 16), maps, found)  # without the photo itself
        target = torch.atanh(true * 2 - 1) - torch.atanh(wrong * 2 - 1)
        return (correction[:, 3:6] - target).square().mean(), target.square().mean()

    for step in range(150):
        optimizer.zero_grad()
        loss, _ = example(step)
        loss.backward()
        optimizer.step()
    after, before = example(1000)
    assert float(after.detach()) < 0.2 * float(before)


@pytest.mark.parametrize(
    "wrong", [{"revision_channels": -1}, {"levels": 2, "revision_channels": 4}, {"revision_passes": 0}]
)
def test_impossible_shapes_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="not a generator"):
        GeneratorConfig(**{"width": 2, "levels": 4, **wrong})
