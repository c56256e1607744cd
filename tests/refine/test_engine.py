"""The reference engine against gradients computed apart from it, in float64, pixel by pixel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from losses.refinement import photo_distance
from nets.render import Camera, Geometry, PointLight, render, shade, shading_geometry, surface_points
from nets.svbrdf import MAPS
from refine.capture import Capture
from refine.engine import reference
from refine.engine.reference import ADAM_EPSILON, FINAL_RATE, descend
from refine.parametrization import Parameters
from refine.stages import GlobalStage, PixelStage, Rates
from tests.helpers import assert_close, random_svbrdf

HEIGHT, WIDTH = 5, 7
LIGHT = PointLight.at((0.3, -0.2, 1.6), dtype=torch.float64)
EVERY_MAP = Rates(normal=0.02, diffuse=0.03, roughness=0.01, specular=0.01)
LOG_OFFSET = 0.01


class Case:
    """A photo of one material, to be explained starting from another; everything in float64."""

    def __init__(self, seed: int = 0, saturated: tuple[int, int] | None = None) -> None:
        truth = random_svbrdf(1, HEIGHT, WIDTH, seed=seed, tilt=0.3, dtype=torch.float64)
        wrong = random_svbrdf(1, HEIGHT, WIDTH, seed=seed + 1, tilt=0.3, dtype=torch.float64)
        photo = render(truth, LIGHT).clamp(0.0, 0.95)
        unsaturated = torch.ones(1, 1, HEIGHT, WIDTH, dtype=torch.bool)
        if saturated is not None:
            photo[..., *saturated] = 1.0
            unsaturated[..., *saturated] = False
        self.capture = Capture(photo, unsaturated, Camera(), LIGHT)
        self.start = Parameters.from_svbrdf(wrong)
        points = surface_points(HEIGHT, WIDTH, dtype=torch.float64)
        self.geometry: Geometry = shading_geometry(points, LIGHT, Camera())

    def descend(self, stage: GlobalStage | PixelStage) -> tuple[Parameters, list[float]]:
        offsets = {name: zero.double() for name, zero in stage.offsets(HEIGHT, WIDTH).items()}
        rates = stage.rates.moving()
        return descend(
            self.start, offsets, self.capture, self.geometry, iterations=stage.iterations, rates=rates
        )

    def loss(self, parameters: Parameters) -> float:
        rendering = shade(parameters.svbrdf(), self.geometry)
        return float(photo_distance(rendering, self.capture.photo, self.capture.unsaturated))

    def pixel_gradients(self) -> dict[str, Tensor]:
        """Differentiate every pixel's own distance with respect to that pixel's parameters, one by one."""
        gradients = {name: torch.zeros_like(getattr(self.start, name)) for name in MAPS}
        for row, column in pixels():
            leaves = Parameters(*(getattr(self.start, name).clone().requires_grad_(True) for name in MAPS))
            rendering = shade(leaves.svbrdf(), self.geometry)[..., row, column]
            if not self.capture.unsaturated[..., row, column]:
                rendering = rendering.clamp(max=1.0)
            target = self.capture.photo[..., row, column]
            difference = torch.log(rendering + LOG_OFFSET) - torch.log(target + LOG_OFFSET)
            difference.abs().mean().backward()
            for name in MAPS:
                gradients[name] += getattr(leaves, name).grad
        return gradients


def pixels() -> Iterator[tuple[int, int]]:
    return ((row, column) for row in range(HEIGHT) for column in range(WIDTH))


def moved(case: Case, result: Parameters, name: str) -> Tensor:
    offset: Tensor = getattr(result, name) - getattr(case.start, name)
    return offset


def first_step(gradient: Tensor, rate: float) -> Tensor:
    """Return Adam's first step: both moments, bias-corrected, are those of one gradient."""
    return -rate * gradient / (gradient.abs() + ADAM_EPSILON)


@pytest.fixture
def best_is_last(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make every distance seen look lower than the one before, so that the last step is returned."""
    fall = iter(range(0, -(10**6), -1))

    def lower(*arguments: Tensor) -> Tensor:
        distance = photo_distance(*arguments)
        return distance + (next(fall) - distance.detach())

    monkeypatch.setattr(reference, "photo_distance", lower)


@pytest.mark.usefixtures("best_is_last")
@pytest.mark.parametrize("seed", range(3))
def test_the_global_step_follows_the_average_of_the_pixels_gradients(seed: int) -> None:
    case = Case(seed, saturated=(2, 3))
    result, _ = case.descend(GlobalStage(1, Rates(roughness=0.02, specular=0.03)))
    gradients = case.pixel_gradients()
    for name, rate in (("roughness", 0.02), ("specular", 0.03)):
        average = gradients[name].mean(dim=(2, 3), keepdim=True)
        offset = moved(case, result, name)
        assert_close(offset, first_step(average, rate).expand_as(offset))
        assert float(offset.abs().min()) > 1e-5


@pytest.mark.parametrize("iterations", [1, 12])
def test_the_global_stage_moves_every_pixel_alike_and_nothing_else(iterations: int) -> None:
    case = Case()
    result, history = case.descend(GlobalStage(iterations))
    for name in ("roughness", "specular"):
        offset = moved(case, result, name)
        assert_close(offset, offset[..., :1, :1].expand_as(offset))
        assert bool(offset.any())
    for name in ("normal", "diffuse"):
        assert torch.equal(getattr(result, name), getattr(case.start, name))
    assert history[-1] < history[0]


@pytest.mark.usefixtures("best_is_last")
def test_the_first_step_per_pixel_follows_each_pixels_own_gradient() -> None:
    case = Case(3, saturated=(0, 0))
    result, _ = case.descend(PixelStage(1, EVERY_MAP))
    gradients = case.pixel_gradients()
    for name, rate in EVERY_MAP.moving().items():
        gradients[name][..., 0, 0] = 0.0  # a clipped pixel keeps what it has
        assert_close(moved(case, result, name), first_step(gradients[name], rate))


@pytest.mark.parametrize("pixel", [(0, 0), (2, 4), (HEIGHT - 1, WIDTH - 1)])
def test_a_pixel_of_the_photo_moves_that_pixel_alone(pixel: tuple[int, int]) -> None:
    case, other = Case(), Case()
    other.capture.photo[..., *pixel] = 1.5 * shade(other.start.svbrdf(), other.geometry)[..., *pixel]
    case.capture.photo[..., *pixel] = 0.5 * shade(other.start.svbrdf(), other.geometry)[..., *pixel]
    (result, history), (changed, falling) = (c.descend(PixelStage(15, EVERY_MAP)) for c in (case, other))
    assert min(history) == history[-1]  # so that both return their last step
    assert min(falling) == falling[-1]
    elsewhere = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    elsewhere[pixel] = False
    for name in MAPS:
        before, after = getattr(result, name), getattr(changed, name)
        assert torch.equal(before[..., elsewhere], after[..., elsewhere])
        assert not torch.equal(before[..., *pixel], after[..., *pixel])


@pytest.mark.parametrize(
    ("stage", "rate", "overshoots"),
    [
        (GlobalStage, 0.01, False),
        (GlobalStage, 3.0, True),
        (PixelStage, 0.01, False),
        (PixelStage, 100.0, True),
    ],
)
def test_what_is_returned_has_the_lowest_loss_seen(
    stage: type[GlobalStage | PixelStage], rate: float, overshoots: bool
) -> None:
    case = Case(2)
    result, history = case.descend(stage(9, Rates(diffuse=rate, roughness=rate, specular=rate)))
    assert len(history) == 10
    assert history[0] == pytest.approx(case.loss(case.start), rel=1e-12)
    assert case.loss(result) == pytest.approx(min(history), rel=1e-12)
    assert (min(history) < history[-1]) == overshoots


def test_no_iterations_return_the_start() -> None:
    case = Case()
    result, history = case.descend(PixelStage(0))
    assert history == [pytest.approx(case.loss(case.start))]
    for name in MAPS:
        assert torch.equal(getattr(result, name), getattr(case.start, name))


@pytest.mark.parametrize("exposure", [30.0, 0.05])
def test_a_saturated_pixel_keeps_its_own_maps(exposure: float) -> None:
    case = Case(saturated=(1, 1))
    case.geometry = replace(case.geometry, irradiance=case.geometry.irradiance * exposure)
    result, _ = case.descend(PixelStage(5, EVERY_MAP))
    for name in MAPS:
        assert bool((moved(case, result, name)[..., 1, 1] == 0.0).all())
    assert bool((moved(case, result, "diffuse")[..., 1, 2] != 0.0).all())


def test_clipped_photos_pull_all_pixels_up_together_and_never_down() -> None:
    for exposure, pulls in ((1000.0, False), (0.05, True)):
        case = Case()
        clipped = torch.zeros_like(case.capture.unsaturated)
        case.capture = replace(case.capture, photo=torch.ones_like(case.capture.photo), unsaturated=clipped)
        case.geometry = replace(case.geometry, irradiance=case.geometry.irradiance * exposure)
        assert bool((shade(case.start.svbrdf(), case.geometry) > 1.0).all()) != pulls
        result, _ = case.descend(GlobalStage(5, Rates(diffuse=0.02)))
        diffuse = moved(case, result, "diffuse")
        assert bool((diffuse > 0.0).all()) == pulls
        assert bool((diffuse == 0.0).all()) != pulls


def test_progress_is_told_of_every_iteration_and_rates_fall(monkeypatch: pytest.MonkeyPatch) -> None:
    case, told, rates = Case(), [], []
    step = torch.optim.Adam.step

    def watched(self: torch.optim.Adam, *arguments: object, **more: object) -> object:
        rates.append(self.param_groups[0]["lr"])
        return step(self, *arguments, **more)

    monkeypatch.setattr(torch.optim.Adam, "step", watched)
    offsets = {name: zero.double() for name, zero in PixelStage().offsets(HEIGHT, WIDTH).items()}
    _, history = descend(
        case.start,
        offsets,
        case.capture,
        case.geometry,
        iterations=8,
        rates=PixelStage().rates.moving(),
        progress=lambda iteration, loss: told.append((iteration, loss)),
    )
    assert told == list(enumerate(history[:-1], start=1))
    assert rates[0] == PixelStage().rates.normal
    assert rates == sorted(rates, reverse=True)
    assert FINAL_RATE * rates[0] < rates[-1] < 0.4 * rates[0]


def test_the_given_tensors_stay_as_they_are() -> None:
    case = Case()
    offsets = {name: zero.double() for name, zero in PixelStage().offsets(HEIGHT, WIDTH).items()}
    before = {name: getattr(case.start, name).clone() for name in MAPS}
    result, _ = descend(
        case.start,
        offsets,
        case.capture,
        case.geometry,
        iterations=3,
        rates=PixelStage().rates.moving(),
    )
    for name in MAPS:
        assert not offsets[name].any()
        assert torch.equal(getattr(case.start, name), before[name])
        assert not getattr(result, name).requires_grad
