"""The benchmark runs and writes what it says; how long things take is not for tests."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from eval.benchmarks.engine import Measurement, main, measure, table


def test_the_benchmark_writes_table_numbers_and_plot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(
        [
            "--sizes",
            "16",
            "--threads",
            "1",
            "--rounds",
            "1",
            "--budget",
            "0.01",
            "--no-runs",
            "--out",
            str(tmp_path),
        ]
    )
    printed = capsys.readouterr().out
    assert printed == (tmp_path / "engine.md").read_text()
    record = json.loads((tmp_path / "engine.json").read_text())
    assert {(m["engine"], m["size"]) for m in record["measurements"]} == {("fused", 16), ("reference", 16)}
    assert all(m["pixel_ms"] > 0.0 and m["global_ms"] > 0.0 for m in record["measurements"])
    assert (tmp_path / "engine.png").stat().st_size > 1000


def test_a_whole_run_is_timed() -> None:
    (found,) = measure(8, 1, ["fused"], rounds=1, budget=0.01)
    assert found.run_s is not None
    assert found.run_s > 0.0


def test_the_table_has_ratios_only_to_a_measured_reference() -> None:
    fast = Measurement("fused", 256, 2, 0.5, 0.4, 0.2, 15.0)
    slow = Measurement("reference", 256, 2, 20.0, 10.0)
    assert "40.0x" in table([fast, slow])
    assert "x |" not in table([fast]).splitlines()[2]
