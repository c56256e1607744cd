"""Large photos: little is computed at a time, and it does not show."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nets.svbrdf import MAPS
from refine.capture import Capture
from refine.engine import ENGINES, find_descend, fused
from refine.parametrization import Parameters
from refine.stages import GlobalStage, PixelStage, Rates
from tests.helpers import random_light, random_svbrdf, seeded

STAGES = [PixelStage(6, Rates(0.02, 0.03, 0.01, 0.01)), GlobalStage(6)]


def problem(height: int, width: int) -> tuple[Parameters, Capture]:
    photo = torch.rand(1, 3, height, width, generator=seeded(1))
    unsaturated = photo[:, :1] < 0.9
    return (
        Parameters.from_svbrdf(random_svbrdf(1, height, width)),
        Capture(photo, unsaturated, light=random_light(falloff="inverse_square")),
    )


def descend(
    stage: PixelStage | GlobalStage, start: Parameters, capture: Capture, engine: str = "fused"
) -> tuple[Parameters, list[float]]:
    found: tuple[Parameters, list[float]] = find_descend(engine)(
        start,
        stage.offsets(*start.normal.shape[-2:]),
        capture,
        iterations=stage.iterations,
        rates=stage.rates.moving(),
    )
    return found


def assert_same(a: tuple[Parameters, list[float]], b: tuple[Parameters, list[float]]) -> None:
    assert a[1] == b[1]
    assert all(torch.equal(getattr(a[0], name), getattr(b[0], name)) for name in MAPS)


@pytest.mark.parametrize("stage", STAGES, ids=["per-pixel", "global"])
def test_engines_know_from_a_photo_how_it_is_lit(stage: PixelStage | GlobalStage) -> None:
    start, capture = problem(21, 34)
    found, expected = (descend(stage, start, capture, engine) for engine in ("fused", "reference"))
    assert set(ENGINES) >= {"fused", "reference"}
    assert found[1] == pytest.approx(expected[1], rel=1e-5)
    for name in MAPS:
        torch.testing.assert_close(getattr(found[0], name), getattr(expected[0], name), rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match="light of a photo is not known"):
        descend(stage, start, replace(capture, light=None))


@pytest.mark.parametrize("stage", STAGES, ids=["per-pixel", "global"])
def test_the_threads_of_torch_change_no_byte(stage: PixelStage | GlobalStage) -> None:
    start, capture = problem(211, 457)  # more than torch computes in one thread, and not a round number
    before, runs = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            runs.append(descend(stage, start, capture))
    finally:
        torch.set_num_threads(before)
    assert_same(runs[1], runs[0])
    assert_same(runs[2], runs[0])


@pytest.mark.parametrize("stage", STAGES, ids=["per-pixel", "global"])
def test_spans_of_any_size_give_the_same(
    stage: PixelStage | GlobalStage, monkeypatch: pytest.MonkeyPatch
) -> None:
    start, capture = problem(30, 41)
    whole = descend(stage, start, capture)
    monkeypatch.setattr(fused, "SPAN_BLOCKS", 3)
    parts = descend(stage, start, capture)
    assert parts[1] == pytest.approx(whole[1], rel=1e-14)
    assert all(torch.equal(getattr(parts[0], name), getattr(whole[0], name)) for name in MAPS)


def test_offsets_may_be_one_value_for_all_pixels() -> None:
    start, capture = problem(9, 14)
    zeros = PixelStage(5).offsets(9, 14)
    spread = {name: torch.zeros(1, zero.shape[1], 1, 1).expand_as(zero) for name, zero in zeros.items()}
    both = [
        fused.descend(start, offsets, capture, iterations=5, rates=PixelStage().rates.moving())
        for offsets in (zeros, spread)
    ]
    assert_same(*both)


def test_what_all_pixels_share_is_found_from_some_of_a_large_photo(monkeypatch: pytest.MonkeyPatch) -> None:
    start, capture = problem(150, 130)
    stage = GlobalStage(20)
    everything, losses = descend(stage, start, capture)
    monkeypatch.setattr(fused, "SHARED_PIXELS", 5000)
    found, drawn = descend(stage, start, capture)
    assert drawn == pytest.approx(losses, rel=0.02)
    assert drawn != losses
    for name in ("roughness", "specular"):
        moved = getattr(everything, name) - getattr(start, name)
        assert getattr(found, name).shape == moved.shape
        assert float(moved.abs().mean()) > 0.01
        again = getattr(found, name) - getattr(start, name)
        assert float((again - moved).abs().max()) < 0.1 * float(moved.abs().mean())
    assert_same(descend(stage, start, capture), (found, drawn))
