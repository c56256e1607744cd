"""Gauss-Newton on the posterior: against closed forms, against itself in another form, and its promises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from eval.benchmarks.cases import Seeded, draw_case
from eval.benchmarks.soak import SIDES, check
from losses.refinement import photo_distance
from nets.render import PAPER, PRESETS, shade
from nets.svbrdf import MAPS
from refine.engine import find_solve
from refine.engine.gauss_newton import Posterior, _gain, stack, unstack
from tests.refine.test_fused import CAMERAS, Case

SOLVERS = ("reference", "fused")
WIDTHS = {"normal": 0.4, "diffuse": 0.5, "roughness": 0.3, "specular": 0.6}
SETTINGS = {"iterations": 6, "widths": WIDTHS, "noise": 0.1, "huber": 3.0}


def posterior(case: Case, solver: str, **changed: object) -> Posterior:
    settings = {**SETTINGS, **changed}
    found: Posterior = find_solve(solver)(
        case.start, case.captures, case.geometries, conventions=case.conventions, **settings
    )
    return found


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(Case(), id="one photo"),
        pytest.param(Case(photos=3, seed=3), id="three"),
        pytest.param(Case(camera=CAMERAS["collocated"], falloff="inverse_square"), id="collocated"),
        pytest.param(Case(conventions=PRESETS["des19"], seed=5), id="des19"),
        pytest.param(Case(saturated=1.0), id="clipped everywhere"),
    ],
)
def test_the_arrow_is_woodbury(case: Case) -> None:
    expected, found = (posterior(case, solver) for solver in SOLVERS)
    assert found.objective == pytest.approx(expected.objective, rel=1e-9)
    assert found.history == pytest.approx(expected.history, rel=1e-7)
    torch.testing.assert_close(stack(found.parameters), stack(expected.parameters), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(stack(found.deviations), stack(expected.deviations), rtol=1e-6, atol=1e-6)


def test_float32_goes_the_same_way() -> None:
    expected = posterior(Case(), "fused")
    found = posterior(Case(dtype=torch.float32), "fused")
    assert found.objective == pytest.approx(expected.objective, rel=1e-4)
    torch.testing.assert_close(
        stack(found.parameters).double(), stack(expected.parameters), rtol=1e-3, atol=1e-3
    )


@pytest.mark.parametrize("solver", SOLVERS)
def test_it_agrees_with_scipy_on_one_pixel(solver: str) -> None:
    case = Case((1, 1), saturated=0.0, seed=2)
    capture, geometry = case.captures[0], case.geometries[0]
    start = stack(case.start)
    width = torch.cat([torch.full((n,), w) for n, w in zip((2, 3, 1, 3), WIDTHS.values(), strict=True)])

    def residuals(offset: np.ndarray) -> np.ndarray:
        moved = torch.from_numpy(offset)[None, :, None, None]
        rendering = shade(unstack(start + moved).svbrdf(), geometry, PAPER)
        data = torch.log(rendering + 0.01) - torch.log(capture.photo + 0.01)
        return torch.cat([data.flatten() / 0.1, moved.flatten() / width.double()]).numpy()

    expected = least_squares(residuals, np.zeros(9), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    found = posterior(case, solver, iterations=60, huber=1e6)
    assert found.objective[-1] == pytest.approx(expected.cost, rel=1e-6)
    offset = (stack(found.parameters) - start).flatten().numpy()
    assert offset == pytest.approx(expected.x, abs=1e-3)
    covariance = np.linalg.inv(expected.jac.T @ expected.jac)
    assert stack(found.deviations).flatten().numpy() == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-3)


@pytest.mark.parametrize("solver", SOLVERS)
def test_no_pixel_gets_worse(solver: str) -> None:
    case = Case((16, 16), seed=7, roughness=(0.03, 0.3))
    objectives = [posterior(case, solver, iterations=n).objective for n in (0, 8)]
    assert len(objectives[0]) == 1
    assert objectives[1][0] == pytest.approx(objectives[0][0])
    assert all(after <= before for before, after in zip(objectives[1], objectives[1][1:], strict=False))
    assert objectives[1][-1] < 0.7 * objectives[1][0]


@pytest.mark.parametrize("solver", SOLVERS)
def test_history_is_the_photo_s_distance(solver: str) -> None:
    case = Case(photos=2)
    found = posterior(case, solver)
    for index, parameters in ((0, case.start), (-1, found.parameters)):
        material = parameters.svbrdf()
        expected = sum(
            float(photo_distance(shade(material, geometry, PAPER), capture.photo, capture.unsaturated))
            for capture, geometry in zip(case.captures, case.geometries, strict=True)
        )
        assert found.history[index] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_map_without_a_width_and_a_clipped_pixel_keep_what_they_have(solver: str) -> None:
    case = Case(saturated=0.4)
    found = posterior(case, solver, widths={"diffuse": 0.5, "specular": 0.5})
    for name in ("normal", "roughness"):
        torch.testing.assert_close(
            getattr(found.parameters, name), getattr(case.start, name), rtol=0.0, atol=1e-12
        )
        assert float(getattr(found.deviations, name).abs().max()) == 0.0
    clipped = ~case.captures[0].unsaturated
    moved = (found.parameters.diffuse - case.start.diffuse).abs().amax(dim=1, keepdim=True)
    assert float(moved[clipped].max()) < 1e-12
    assert float(moved[~clipped].min()) > 0.0


@pytest.mark.parametrize("solver", SOLVERS)
def test_what_the_photo_tells_narrows_the_prior_and_never_widens_it(solver: str) -> None:
    case = Case(saturated=0.0)
    vague = posterior(case, solver, noise=10.0, huber=1e6)
    sharp = posterior(case, solver, noise=0.01, huber=1e6)
    for name in MAPS:
        loose, tight = (getattr(found.deviations, name) for found in (vague, sharp))
        assert float(loose.max()) <= WIDTHS[name] * (1.0 + 1e-9)
        assert float(loose.mean()) == pytest.approx(WIDTHS[name], rel=0.02)
        assert float(tight.mean()) < 0.99 * WIDTHS[name]


@pytest.mark.parametrize("solver", SOLVERS)
def test_more_photos_tell_more(solver: str) -> None:
    three = Case(photos=3, saturated=0.0)
    one = Case(saturated=0.0)
    one.captures, one.geometries = three.captures[:1], three.geometries[:1]
    few, many = (posterior(case, solver, iterations=0) for case in (one, three))
    assert bool((stack(many.deviations) <= stack(few.deviations) * (1.0 + 1e-9)).all())


def test_threads_and_repetition_do_not_matter() -> None:
    case = Case((40, 40), dtype=torch.float32)
    threads = torch.get_num_threads()
    found = []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            found.append(posterior(case, "fused"))
    finally:
        torch.set_num_threads(threads)
    for other in found[1:]:
        assert torch.equal(stack(other.parameters), stack(found[0].parameters))
        assert other.objective == found[0].objective


@pytest.mark.parametrize("solver", SOLVERS)
def test_progress_is_told_of_every_iteration(solver: str) -> None:
    told: list[int] = []
    posterior(Case(), solver, progress=lambda iteration, loss: told.append(iteration))
    assert told == list(range(1, 7))


def test_a_wrong_start_of_extreme_values_stays_finite() -> None:
    case = Case((8, 8), dtype=torch.float32, roughness=(0.03, 0.05))
    extreme = replace(case.start, diffuse=case.start.diffuse * 20.0, normal=case.start.normal * 10.0)
    case.start = extreme
    for solver in SOLVERS:
        found = posterior(case, solver, noise=0.001)
        assert bool(torch.isfinite(stack(found.parameters)).all())
        assert bool(torch.isfinite(stack(found.deviations)).all())
        found.parameters.svbrdf().validate()


def test_residuals_that_say_the_same_beyond_rounding_have_the_limit_of_little_noise() -> None:
    """Then the matrix to solve is singular: equal derivatives beside which the noise is nothing."""
    told = 1e6 * torch.arange(1.0, 10.0)
    jacobian = told.expand(1, 3, 9)[..., None, None]
    gain, _ = _gain(jacobian, torch.zeros(1, 3, 1, 1), torch.ones(1, 9, 1, 1), 0.1, 3.0)
    expected = told / (3.0 * told.square().sum())
    torch.testing.assert_close(gain[0, 0, 0], expected[:, None].expand(9, 3), rtol=1e-5, atol=0.0)


@pytest.mark.parametrize(("number", "recipe"), [(1, "fast"), (51, "default"), (74, "several")])
def test_what_the_soak_found_singular_is_refined(number: int, recipe: str) -> None:
    check(draw_case(Seeded(0, number), sides=SIDES), recipe, "reference")
