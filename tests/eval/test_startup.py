"""The benchmark of start-up: processes are timed to their end, by medians, failures are not passed over."""

from __future__ import annotations

import subprocess

import pytest

from eval.benchmarks.startup import COMMANDS, markdown, start, take_turns


def test_a_process_is_timed_to_its_end() -> None:
    elapsed, processor = start(("-S", "-c", "import time; time.sleep(0.3)"))
    assert elapsed >= 0.3
    assert 0.0 < processor < elapsed


def test_processor_time_is_the_process_s_own() -> None:
    busy = "import time\nwhile time.process_time() < 0.2: pass"
    assert start(("-S", "-c", busy))[1] >= 0.2


def test_a_failure_is_no_time() -> None:
    with pytest.raises(subprocess.CalledProcessError):
        start(("-S", "-c", "raise SystemExit(3)"))


def test_the_first_round_does_not_count() -> None:
    assert [len(seconds) for seconds in take_turns({"nothing": ("-S", "-c", "pass")}, 2).values()] == [2]


def test_the_table_has_medians_and_the_least() -> None:
    table = markdown({"x": [(3.0, 0.3), (1.0, 0.1), (2.0, 0.2)]}, {"commit": "c", "machine": "m"})
    assert "| `x` | 2.00 | 1.00 | 0.20 |" in table
    assert "3 rounds" in table


def test_what_is_promised_is_timed() -> None:
    assert {"import refine", "refine --help"} <= set(COMMANDS)
