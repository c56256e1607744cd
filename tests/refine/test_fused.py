"""The fused engine against the reference: distances, gradients and whole descents agree."""

from __future__ import annotations

import logging
import re
from dataclasses import fields, replace
from pathlib import Path

import numba
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from losses.refinement import photo_distance
from nets.render import (
    PAPER,
    PRESETS,
    Camera,
    Conventions,
    Geometry,
    render,
    shade,
    shading_geometry,
    surface_points,
)
from nets.svbrdf import MAPS
from refine.capture import Capture
from refine.engine import compilation, find_descend, fused, kernel, simd
from refine.engine.fused_gradients import gradients
from refine.parametrization import Parameters
from refine.run import run_stages
from refine.stages import GlobalStage, PixelStage, Rates, Recipe
from tests.helpers import random_light, random_svbrdf, seeded

CAMERAS = {kind: Camera(kind) for kind in ("orthographic", "perspective", "collocated")}
EVERY_MAP = Rates(normal=0.02, diffuse=0.03, roughness=0.01, specular=0.01)
PAIR = ("fused", "reference")
AGREEMENT = {torch.float32: 1e-5, torch.float64: 1e-9}
"""Of gradients and distances, relative to their own size and to that of their map."""


class Case:
    """Photos of one material, to be explained starting from another."""

    def __init__(
        self,
        size: tuple[int, int] = (13, 11),
        *,
        seed: int = 0,
        photos: int = 1,
        camera: Camera = CAMERAS["perspective"],
        falloff: str = "none",
        conventions: Conventions = PAPER,
        saturated: float = 0.2,
        exposure: float = 1.0,
        roughness: tuple[float, float] = (0.1, 1.0),
        dtype: torch.dtype = torch.float64,
    ) -> None:
        truth, wrong = (
            random_svbrdf(1, *size, seed=seed + n, tilt=0.5, roughness=roughness, dtype=torch.float64)
            for n in (0, 1)
        )
        start = Parameters.from_svbrdf(wrong)
        self.start = Parameters(*(getattr(start, name).to(dtype) for name in MAPS))
        self.conventions, self.captures, self.geometries = conventions, [], []
        for n in range(photos):
            light = random_light(seed=seed + n, falloff=falloff, dtype=torch.float64)  # type: ignore[arg-type]
            unsaturated = torch.rand(1, 1, *size, generator=seeded(seed + n)) >= saturated
            photo = (exposure * render(truth, light, camera, conventions)).clamp(0.0, 0.95)
            photo = torch.where(unsaturated, photo, torch.ones_like(photo)).to(dtype)
            points = surface_points(*size, grid=conventions.grid, dtype=torch.float64)
            geometry = shading_geometry(points, light, camera, conventions)
            self.captures.append(Capture(photo, unsaturated, camera, light))
            self.geometries.append(as_type(geometry, dtype))

    def gradients(self, dtype: torch.dtype = torch.float64) -> tuple[float, dict[str, Tensor]]:
        """Differentiate with autograd in float64: the distances, and each pixel's own one."""
        leaves = Parameters(
            *(getattr(self.start, name).to(dtype).clone().requires_grad_(True) for name in MAPS)
        )
        total = torch.zeros((), dtype=dtype)
        for capture, geometry in zip(self.captures, self.geometries, strict=True):
            rendering = shade(leaves.svbrdf(), as_type(geometry, dtype), self.conventions)
            total = total + photo_distance(rendering, capture.photo.to(dtype), capture.unsaturated)
        (total * leaves.normal[0, 0].numel()).backward()  # type: ignore[no-untyped-call]
        return float(total.detach()), {name: getattr(leaves, name).grad for name in MAPS}

    def descend(self, engine: str, stage: GlobalStage | PixelStage) -> tuple[Parameters, list[float]]:
        dtype = self.start.normal.dtype
        zeros = stage.offsets(*self.start.normal.shape[-2:])
        result: tuple[Parameters, list[float]] = find_descend(engine)(
            self.start,
            {name: zero.to(dtype) for name, zero in zeros.items()},
            self.captures,
            self.geometries,
            iterations=stage.iterations,
            rates=stage.rates.moving(),
            conventions=self.conventions,
        )
        return result

    def assert_gradients_agree(self) -> None:
        tolerance = AGREEMENT[self.start.normal.dtype]
        distance, found = gradients(self.start, self.captures, self.geometries, self.conventions)(self.start)
        expected_distance, expected = self.gradients()
        assert distance == pytest.approx(expected_distance, rel=tolerance)
        for name in MAPS:
            size = float(expected[name].square().mean().sqrt())
            torch.testing.assert_close(
                found[name].double(), expected[name], rtol=tolerance, atol=tolerance * size
            )


def as_type(geometry: Geometry, dtype: torch.dtype) -> Geometry:
    return Geometry(*(getattr(geometry, field.name).to(dtype) for field in fields(geometry)))


def assert_same_descent(
    case: Case, stage: GlobalStage | PixelStage, tolerance: float, engine: str = "fused"
) -> None:
    (found, history), (expected, expected_history) = (
        case.descend(name, stage) for name in (engine, "reference")
    )
    assert history == pytest.approx(expected_history, rel=tolerance)
    for name in MAPS:
        torch.testing.assert_close(
            getattr(found, name), getattr(expected, name), rtol=tolerance, atol=tolerance
        )


@pytest.mark.parametrize("dtype", AGREEMENT, ids=str)
@pytest.mark.parametrize("photos", [1, 3])
@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize(
    ("preset", "falloff"), [("paper", "none"), ("des19", "inverse_square"), ("gao19", "none")]
)
def test_gradients_agree_with_autograd(
    preset: str, falloff: str, camera: str, photos: int, dtype: torch.dtype
) -> None:
    case = Case(
        (31, 27),
        seed=photos,
        photos=photos,
        camera=CAMERAS[camera],
        falloff=falloff,
        conventions=PRESETS[preset],
        dtype=dtype,
    )
    case.assert_gradients_agree()


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10**6),
    size=st.tuples(st.integers(1, 12), st.integers(1, 12)),
    photos=st.integers(1, 3),
    camera=st.sampled_from(sorted(CAMERAS)),
    falloff=st.sampled_from(["none", "inverse_square"]),
    saturated=st.sampled_from([0.0, 0.3, 1.0]),
    exposure=st.sampled_from([0.02, 1.0, 3.0]),
    lowest=st.sampled_from([0.03, 0.2]),
)
def test_gradients_agree_to_rounding_in_float64(
    seed: int,
    size: tuple[int, int],
    photos: int,
    camera: str,
    falloff: str,
    saturated: float,
    exposure: float,
    lowest: float,
) -> None:
    case = Case(
        size,
        seed=seed,
        photos=photos,
        camera=CAMERAS[camera],
        falloff=falloff,
        saturated=saturated,
        exposure=exposure,
        roughness=(lowest, 1.0),
    )
    case.assert_gradients_agree()


@pytest.mark.parametrize("size", [(1, 1), (7, 9), (8, 16), (65, 3)])
@pytest.mark.parametrize("photos", [1, 2])
@pytest.mark.parametrize(
    "stage",
    [PixelStage(25, EVERY_MAP), PixelStage(5, Rates(roughness=0.02)), GlobalStage(25), GlobalStage(0)],
    ids=["pixel", "roughness", "global", "none"],
)
def test_descents_agree(size: tuple[int, int], photos: int, stage: GlobalStage | PixelStage) -> None:
    assert_same_descent(Case(size, seed=3, photos=photos), stage, 1e-9)


def test_the_best_is_returned_where_steps_overshoot() -> None:
    case, stage = Case(seed=2), PixelStage(9, Rates(diffuse=100.0))
    _, history = case.descend("fused", stage)
    assert min(history) < history[-1]
    assert_same_descent(case, stage, 1e-9)


def test_descents_agree_in_float32() -> None:
    # A difference that changes its sign a step earlier sends a pixel elsewhere: most, not all, stay close.
    case = Case((40, 50), dtype=torch.float32)
    (found, history), (expected, expected_history) = (case.descend(n, PixelStage(60)) for n in PAIR)
    assert history == pytest.approx(expected_history, rel=1e-5)
    for name in MAPS:
        difference = (getattr(found, name) - getattr(expected, name)).abs()
        assert float(difference.quantile(0.99)) < 1e-4
        assert float((getattr(expected, name) - getattr(case.start, name)).abs().max()) > 1e-2


def test_neither_threads_nor_repetition_change_a_byte(monkeypatch: pytest.MonkeyPatch) -> None:
    case, threads = Case((50, 41), dtype=torch.float32), torch.get_num_threads()
    for stage in (PixelStage(8), GlobalStage(8)):
        runs = []
        for count in (1, 2, 2, 5):
            monkeypatch.setattr(torch, "get_num_threads", lambda count=count: count)
            runs.append(case.descend("fused", stage))
        for result, history in runs[1:]:
            assert history == runs[0][1]
            assert all(torch.equal(getattr(result, name), getattr(runs[0][0], name)) for name in MAPS)
    assert threads > 0


def test_spans_change_nothing_but_when_progress_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    case, stage = Case((20, 23)), PixelStage(7)
    whole, history = case.descend("fused", stage)
    monkeypatch.setattr(fused, "SPAN_BLOCKS", 1)
    told: list[tuple[int, float]] = []
    parts, again = fused.descend(
        case.start,
        {name: zero.double() for name, zero in stage.offsets(20, 23).items()},
        case.captures[0],
        case.geometries[0],
        iterations=7,
        rates=stage.rates.moving(),
        progress=lambda iteration, loss: told.append((iteration, loss)),
    )
    assert again == pytest.approx(history, rel=1e-14)
    assert all(torch.equal(getattr(whole, name), getattr(parts, name)) for name in MAPS)
    assert [iteration for iteration, _ in told] == list(range(1, 8))
    assert told[-1][1] == again[6]


def test_what_cannot_be_done_is_refused() -> None:
    case = Case((2, 3), dtype=torch.float32)
    offsets = {**PixelStage(1).offsets(2, 3), **GlobalStage(1).offsets(2, 3)}
    for start, zeros, geometries, message in (
        (case.start, offsets, case.geometries, "all per pixel or all shared"),
        (case.start, offsets, [], "do not make pairs"),
        (Parameters(*(getattr(case.start, n).half() for n in MAPS)), offsets, case.geometries, "float16"),
    ):
        with pytest.raises(ValueError, match=message):
            fused.descend(start, zeros, case.captures, geometries, iterations=1, rates={})


def test_loops_are_vector_instructions() -> None:
    row = numba.float32[::1]
    loops = ((kernel._material, 4, 50), (kernel._add_photo, 3, 200), (kernel._adam, 4, 20))
    for function, rows, least in loops:
        function.compile((row,) * rows)
        code = "".join(function.inspect_llvm().values())
        assert len(re.findall(r"<\d+ x float>", code)) > least
        assert not re.findall(r"call float @(expf|logf|sqrtf)", code)


def test_recipes_run_alike_on_both_engines() -> None:
    case = Case((16, 16), dtype=torch.float32, saturated=0.0)
    capture = replace(case.captures[0], light=random_light(seed=0))
    recipe = Recipe("short", None, (GlobalStage(4), PixelStage(6)))
    results = [run_stages(case.start.svbrdf(), capture, recipe, {}, None, e) for e in PAIR]
    for stage, losses in results[0][1].items():
        assert losses == pytest.approx(results[1][1][stage], rel=1e-5)
    for name in MAPS:
        found, expected = (getattr(svbrdf, name) for svbrdf, _ in results)
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Put a loop that compiles at once in place of a slow one, with a cache of its own."""
    source = tmp_path / "small.py"
    source.write_text("def small(x):\n    return x + 1.0\n")
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(kernel, "small", kept_anew(source), raising=False)
    return str(source)


def kept_anew(source: str | Path) -> object:
    names: dict[str, object] = {"__name__": "small"}
    exec(compile(Path(source).read_text(), str(source), "exec"), names)
    return simd.kept(names["small"])  # type: ignore[arg-type]


def compile_small(caplog: pytest.LogCaptureFixture) -> list[str]:
    caplog.clear()
    with numba.core.event.install_listener("numba:compile", compilation._Announcement()):
        compilation._compile(kernel, "small", (numba.float64,))
    assert kernel.small(1.0) == 2.0  # type: ignore[attr-defined]
    return [record.message for record in caplog.records if record.levelno >= logging.WARNING]


def test_compiling_is_announced_and_its_result_kept(
    small: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert compile_small(caplog) == [compilation.COMPILING]
    monkeypatch.setattr(kernel, "small", kept_anew(small))
    assert compile_small(caplog) == []
    for file in Path(numba.config.CACHE_DIR).rglob("*.nb?"):
        file.write_bytes(b"damaged")
    monkeypatch.setattr(kernel, "small", kept_anew(small))
    damaged, again = compile_small(caplog)
    assert "cannot be used" in damaged
    assert again == compilation.COMPILING


def test_without_any_place_for_a_cache_it_still_compiles(
    small: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nowhere(self: object) -> None:
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(numba.core.dispatcher.Dispatcher, "enable_caching", nowhere)
    monkeypatch.setattr(kernel, "small", kept_anew(small))
    assert compile_small(caplog) == [compilation.COMPILING]
