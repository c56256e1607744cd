"""`docs/reliability.md` says what the committed records of the long runs say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from eval.benchmarks.reliability import figures, fill, main

ROOT = Path(__file__).parents[2]


def test_the_page_is_what_the_records_say() -> None:
    assert main(["--check", "--docs", str(ROOT / "docs")]) == 0


def test_figures_are_taken_from_records(tmp_path: Path) -> None:
    record = {"cases": 12345, "failures": [], "precision": {"fused": [3e-7, 0.5, 1e-7]}, "share": 0.25}
    (tmp_path / "soak.json").write_text(json.dumps(record))
    known = figures(tmp_path)
    assert known["soak.cases"] == "12,345"
    assert known["soak.failures.count"] == "0"
    assert (known["soak.precision.fused.median"], known["soak.precision.fused.largest"]) == ("3.0e-07", "0.5")
    assert known["soak.share"] == "0.25"


def test_paragraphs_of_runs_that_are_not_there_are_left_out() -> None:
    text = "A.\n\n{?soak} {soak.cases} cases.\n\n{!soak} Not yet.\n\nB."
    assert fill(text, {"soak.cases": "7"}) == "A.\n\n7 cases.\n\nB."
    assert fill(text, {"fuzz.cases": "7"}) == "A.\n\nNot yet.\n\nB."
    with pytest.raises(KeyError):
        fill("{fuzz.cases}", {})
