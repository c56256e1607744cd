"""The benchmark runs and writes what it says; how long things take is not for tests."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from eval.benchmarks import engine as benchmark
from eval.benchmarks.engine import Limits, Measurement, main, measure, table
from eval.benchmarks.timing import peak_memory

SHORT = Limits(rounds=1, turn=0.01, recipes=())
MEASURED = Measurement("reference", 64, 1, 40.0, 20.0, 1.0, 100.0, {"paper": 12.0})


def test_the_benchmark_writes_table_numbers_and_plot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sizes, engines = ("--sizes", "8", "16"), ("--engines", "fused", "reference")
    short = ("--rounds", "1", "--turn", "0.01", "--recipes")
    main([*sizes, *engines, *short, "--threads", "1", "--out", str(tmp_path)])
    assert capsys.readouterr().out.endswith((tmp_path / "engine.md").read_text())
    record = json.loads((tmp_path / "engine.json").read_text())
    measured = [(m["size"], m["engine"]) for m in record["measurements"]]
    assert measured == [(8, "fused"), (8, "reference"), (16, "fused"), (16, "reference")]
    for m in record["measurements"]:
        assert m["pixel_ms"] > 0.0
        assert m["global_ms"] > 0.0
        assert (m["ratio"] == 1.0) == (m["engine"] == "reference")
    assert (tmp_path / "engine.png").stat().st_size > 1000


def test_whole_recipes_are_timed_and_the_number_of_threads_is_put_back() -> None:
    threads = torch.get_num_threads()
    (found,) = measure(8, threads + 1, ["fused"], replace(SHORT, recipes=("fast",)))
    assert found.run_s["fast"] > 0.0
    assert found.ratio is None
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize(
    ("limits", "reason"),
    [(replace(SHORT, longest_turn=0.4), "two iterations would take some 0.5 s"), (SHORT, "GiB")],
    ids=["time", "memory"],
)
def test_what_would_take_too_much_is_left_out(
    limits: Limits, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if reason == "GiB":
        monkeypatch.setattr(benchmark, "FREE_SHARE", 0.0)
    fused, reference = measure(128, 1, ["fused", "reference"], limits, [MEASURED])
    assert fused.left_out == {}
    assert fused.ratio is None
    assert reason in reference.left_out[""]
    assert reference.pixel_ms is None
    (larger,) = measure(256, 1, ["reference"], limits, [MEASURED, reference])
    assert larger.left_out == {"": "as at 128 px"}


def test_a_recipe_that_would_take_too_long_is_left_out() -> None:
    known = replace(MEASURED, size=4)
    (found,) = measure(8, 1, ["reference"], replace(SHORT, run=40.0, recipes=("paper", "fast")), [known])
    assert found.left_out == {"paper": "would take some 48 s"}
    assert list(found.run_s) == ["fast"]


def test_the_table_tells_what_is_missing() -> None:
    left_out = Measurement("compiled", 64, 1, left_out={"": "there is no C++ compiler"})
    slow = replace(MEASURED, left_out={"default": "would take some 99 s"})
    head, _, fast_row, missing_row, *rest = table([slow, left_out], ["paper", "default"])
    assert head.endswith("| paper, s | default, s |")
    assert fast_row == "| reference | 64 | 1 | 40.00 | 1.0x | 20.00 | 100 | 12.00 | - |"
    assert missing_row == "| compiled | 64 | 1 | - | - | - | - | - | - |"
    assert "- reference, recipe default, 64 px, threads 1: would take some 99 s" in rest
    assert "- compiled, 64 px, threads 1: there is no C++ compiler" in rest


def test_memory_that_is_taken_is_seen() -> None:
    with peak_memory() as memory:
        taken = torch.ones(2**24)
    assert 64.0 <= memory() < 200.0
    del taken
