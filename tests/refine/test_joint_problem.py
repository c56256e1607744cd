"""Lights and material together: derivatives, descent, and what saturated pixels may say."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Literal

import pytest
import torch
from torch import Tensor

from nets.color import GAMMA
from nets.render import Camera, PointLight, render, surface_points
from nets.svbrdf import MAPS
from refine.joint_problem import EXPOSURE, LOG_Z, Estimate, JointProblem, MaterialPrior, X, Y
from refine.parametrization import Parameters
from tests.helpers import assert_close, random_svbrdf, seeded

PHOTOS, SIDE = 2, 4
ALL = (X, Y, LOG_Z, EXPOSURE)


def problem(
    free: tuple[int, ...] = ALL,
    falloff: Literal["none", "inverse_square"] = "inverse_square",
    camera: Camera | None = None,
) -> tuple[JointProblem, Estimate]:
    """Return random photos of nothing in particular, and a place to look at the problem from."""
    generator = seeded(3)
    pixels = SIDE * SIDE

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    lights = torch.zeros(PHOTOS, 4, dtype=torch.float64)
    lights[:, LOG_Z] = 0.9
    material = 0.5 * normal(9, pixels)
    root = normal(PHOTOS * len(free), PHOTOS * len(free))
    unsaturated = torch.rand(PHOTOS, 1, pixels, generator=generator) < 0.8
    there = JointProblem(
        encoded=torch.rand(PHOTOS, 3, pixels, generator=generator, dtype=torch.float64),
        unsaturated=unsaturated,
        points=surface_points(SIDE, SIDE, dtype=torch.float64).flatten(1)[:, None],
        material=material,
        prior=MaterialPrior(),
        lights=lights,
        light_weights=root @ root.T,
        free=free,
        camera=camera or Camera("collocated"),
        falloff=falloff,
        scale=0.05,
    )
    start = Estimate(material + 0.1 * normal(9, pixels), lights + 0.2 * normal(PHOTOS, 4), 0.1 * normal(3))
    return there, start


def flat(estimate: Estimate, free: tuple[int, ...]) -> list[Tensor]:
    return [estimate.material, estimate.lights[:, free], estimate.shift]


@pytest.mark.parametrize("free", [ALL, (EXPOSURE,)])
@pytest.mark.parametrize("camera", [Camera("collocated"), Camera()])
def test_derivatives_are_those_of_autograd(free: tuple[int, ...], camera: Camera) -> None:
    there, now = problem(free, camera=camera)
    by_material, by_light = there._jacobian(now)
    expected = torch.autograd.functional.jacobian(there.residuals, (now.material, now.lights))
    # Autograd's has a pixel (a photo) more, along which it is diagonal.
    assert_close(by_material, torch.einsum("pcnkn->kpcn", expected[0]))
    assert_close(by_light, torch.einsum("pcnpk->kpcn", expected[1])[list(free)])
    for derivatives in (by_material, by_light):
        assert (derivatives.abs().amax(dim=(1, 2, 3)) > 1e-6).all()


@pytest.mark.parametrize("falloff", ["none", "inverse_square"])
@pytest.mark.parametrize("free", [ALL, (EXPOSURE,)])
def test_the_right_side_is_the_gradient_of_the_cost(
    free: tuple[int, ...], falloff: Literal["none", "inverse_square"]
) -> None:
    there, now = problem(free, falloff)

    def cost(material: Tensor, lights: Tensor, shift: Tensor) -> Tensor:
        away = lights - there.lights
        unknown = torch.stack([away[:, number] for number in free], dim=1).flatten()
        return (
            there.cost_by_pixel(Estimate(material, lights, shift)).sum()
            + (there._flatness @ material[:2].flatten()).square().sum()
            + unknown @ there.light_weights @ unknown
            + (shift.square() * torch.tensor(there.prior.shift, dtype=torch.float64) ** -2).sum()
        )

    assert float(cost(now.material, now.lights, now.shift)) == pytest.approx(there.cost(now))
    gradient = torch.autograd.functional.jacobian(cost, (now.material, now.lights, now.shift))
    _, _, _, own_side, shared_side = there._normal_equations(now)
    unknown = PHOTOS * len(free)
    assert_close(own_side, -0.5 * gradient[0].T)
    assert_close(shared_side[:unknown], -0.5 * gradient[1][:, list(free)].flatten())
    assert_close(shared_side[unknown : unknown + 3], -0.5 * gradient[2])


def test_the_cost_never_grows_and_settles() -> None:
    there, now = problem()
    costs = [there.cost(now)]
    for _ in range(8):
        now = there.improve(now, 1, 0.0)
        assert now.cost == pytest.approx(there.cost(now))
        costs.append(now.cost)
    assert all(after <= before for before, after in pairwise(costs))
    assert costs[-1] < 0.8 * costs[0]
    settled = there.improve(now, 25, 1e-6)
    assert 0.98 * settled.cost < there.improve(settled, 3, 0.0).cost <= settled.cost


def test_what_is_not_free_stays() -> None:
    there, now = problem((EXPOSURE,))
    found = there.improve(now, 5, 0.0)
    assert found.cost < there.cost(now)
    assert torch.equal(found.lights[:, :EXPOSURE], now.lights[:, :EXPOSURE])
    assert not torch.equal(found.lights[:, EXPOSURE], now.lights[:, EXPOSURE])


def test_residuals_are_encoded_differences_to_a_rendering() -> None:
    there, now = problem()
    material = random_svbrdf(1, SIDE, SIDE, dtype=torch.float64)
    parameters = Parameters.from_svbrdf(material)
    stacked = torch.cat([getattr(parameters, name) for name in MAPS], dim=1)[0].flatten(1)
    photos = render(material, there.point_light(now.lights), Camera("collocated")).flatten(2)
    assert float(photos.min()) < 0.1 < float(photos.max())
    exact = replace(there, encoded=photos ** (1.0 / GAMMA), unsaturated=torch.ones_like(there.unsaturated))
    assert float(exact.residuals(stacked, now.lights).abs().max()) < 1e-6
    x, y, log_z, exposure = now.lights.T
    light = there.point_light(now.lights)
    assert_close(light.position, torch.stack([x, y, log_z.exp()], dim=1))
    # The flash's power is what the exposure says, so that the surface gets less of it from farther away.
    distance = torch.linalg.vector_norm(light.position, dim=1)
    assert_close(light.intensity, (exposure.exp() / distance**2)[:, None].expand(-1, 3))
    assert isinstance(light, PointLight)


def test_saturated_pixels_only_ask_for_more_light() -> None:
    there, now = problem()
    whole = replace(there, unsaturated=torch.ones_like(there.unsaturated))
    none = replace(there, unsaturated=torch.zeros_like(there.unsaturated))
    both, below = (which.residuals(now.material, now.lights) for which in (whole, none))
    assert bool((both > 0.01).any())
    assert bool((both < -0.01).any())
    assert_close(below, both.clamp(max=0.0))
    mixed = there.residuals(now.material, now.lights)
    assert_close(mixed, torch.where(there.unsaturated, both, below))


def test_a_flat_surface_may_have_relief_but_no_slant() -> None:
    there, now = problem()
    x, y = there.points[0, 0], there.points[1, 0]

    def statements(slope_x: Tensor, slope_y: Tensor) -> Tensor:
        return there._flatness @ torch.cat([slope_x, slope_y])

    none = torch.zeros_like(x)
    tilted = statements(torch.ones_like(x), none)
    dome, twisted = statements(x, y), statements(y, -x)
    relief = statements(torch.where(x.abs() > 0.5, 1.0, -1.0).double(), none)
    assert int((tilted.abs() > 1e-6).sum()) == 1
    assert int((dome.abs() > 1e-6).sum()) == 2
    assert int((twisted.abs() > 1e-6).sum()) == 1
    assert float(twisted.abs().max()) > float(dome.abs().max())
    assert now.cost == float("inf")
    assert float(relief.abs().max()) < 1e-6
