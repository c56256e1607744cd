"""The compiled engine against the reference, and the choice among engines.

`torch.compile` cannot trace the run-time type checks of this suite. So most tests take the step as it is
before compilation, and one compiles it in a process without the checks.
"""

from __future__ import annotations

import logging
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from refine.engine import choose_engine, compiled, find_descend, obstacle, reference
from refine.stages import GlobalStage, PixelStage, Rates
from tests.refine.test_fused import EVERY_MAP, Case, assert_same_descent

ROOT = Path(__file__).parent.parent.parent


@pytest.fixture
def uncompiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "_compiled_step", lambda: compiled._step)


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("photos", [1, 2])
@pytest.mark.parametrize(
    "stage",
    [PixelStage(25, EVERY_MAP), PixelStage(5, Rates(roughness=0.02)), GlobalStage(25), GlobalStage(0)],
    ids=["pixel", "roughness", "global", "none"],
)
def test_descents_agree(photos: int, stage: GlobalStage | PixelStage) -> None:
    assert_same_descent(Case((7, 9), seed=3, photos=photos), stage, 1e-9, "compiled")


@pytest.mark.usefixtures("uncompiled")
def test_the_best_is_returned_where_steps_overshoot() -> None:
    case, stage = Case(seed=2), PixelStage(9, Rates(diffuse=100.0))
    _, history = case.descend("compiled", stage)
    assert min(history) < history[-1]
    assert_same_descent(case, stage, 1e-9, "compiled")


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("iterations", [0, 1, 2, 3, 4, 7])
def test_progress_is_told_of_every_iteration(iterations: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "BURST", 3)
    case, stage, told = Case((3, 4)), PixelStage(iterations), []
    _, history = compiled.descend(
        case.start,
        {name: zero.double() for name, zero in stage.offsets(3, 4).items()},
        case.captures,
        case.geometries,
        iterations=iterations,
        rates=stage.rates.moving(),
        progress=lambda iteration, loss: told.append((iteration, loss)),
    )
    assert len(history) == iterations + 1
    assert told == list(enumerate(history[:-1], start=1))


@pytest.mark.usefixtures("uncompiled")
def test_the_given_tensors_stay_as_they_are() -> None:
    case, stage = Case((3, 4), dtype=torch.float32), PixelStage(2)
    offsets = stage.offsets(3, 4)
    compiled.descend(
        case.start, offsets, case.captures, case.geometries, iterations=2, rates=stage.rates.moving()
    )
    assert not any(bool(offset.any()) for offset in offsets.values())


@pytest.mark.skipif(compiled.missing("cpu") is not None, reason=f"{compiled.missing('cpu')}")
def test_the_compiled_step_agrees() -> None:
    program = (
        "from refine.stages import PixelStage, Rates\n"
        "from tests.refine.test_fused import Case, assert_same_descent\n"
        "stage = PixelStage(5, Rates(normal=0.02, roughness=0.01))\n"
        "assert_same_descent(Case((3, 4), seed=1), stage, 1e-9, 'compiled')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    assert compiled.COMPILING in done.stderr


def test_engines_are_chosen_by_device_and_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "missing", lambda device: None)
    devices = ("cpu", "cuda", "mps")
    assert [choose_engine(None, device) for device in devices] == ["fused", "compiled", "reference"]
    for name, device in (("reference", "cpu"), ("reference", "cuda"), ("compiled", "cpu"), ("fused", "cpu")):
        assert choose_engine(name, device) == name
    assert find_descend("reference") is reference.descend
    for name, device in (("fast", "cpu"), ("fused", "cuda")):
        with pytest.raises(ValueError, match="engine"):
            choose_engine(name, device)


def test_without_a_compiler_the_reference_takes_over_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("shutil.which", lambda name: None)
    for device in ("cpu", "cuda"):
        assert compiled.missing(device) is not None
        with pytest.raises(ValueError, match="the compiled engine cannot be used"):
            choose_engine("compiled", device)
    assert caplog.records == []
    with caplog.at_level(logging.WARNING):
        assert choose_engine(None, "cuda") == "reference"
    (record,) = caplog.records
    assert "slower" in record.message
    assert str(obstacle("compiled", "cuda")) in record.message


def test_on_cuda_triton_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda name: f"/usr/bin/{name}")
    for found, expected in ((None, "Triton is not installed"), ("a module", None)):
        monkeypatch.setattr(compiled, "find_spec", lambda name, found=found: found)
        assert compiled.missing("cuda") == expected
        assert compiled.missing("cpu") is None
