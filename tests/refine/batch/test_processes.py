"""Jobs in processes: all are done, a dead process costs its own job alone, nothing is left running."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from refine.batch.processes import interrupts_held, work_in_processes
from tests.helpers import is_running
from tests.refine.batch.toys import Toys

PATIENCE = 60.0
ROOT = Path(__file__).parents[3]


def processes(folder: Path) -> list[int]:
    return [int(path.name.partition("-")[2]) for path in folder.glob("process-*")]


def test_every_job_has_its_outcome(tmp_path: Path) -> None:
    called = []
    jobs = ["one", "fail", "interrupt", "two", "three"]
    found = dict(work_in_processes(Toys(tmp_path), jobs, 2, meanwhile=lambda: called.append(True)))
    assert found == {"one": None, "fail": "it failed", "interrupt": None, "two": None, "three": None}
    assert called == [True]
    assert 1 <= len(processes(tmp_path)) <= 2
    assert multiprocessing.active_children() == []


def test_a_job_whose_process_dies_is_tried_once_more(tmp_path: Path) -> None:
    found = dict(work_in_processes(Toys(tmp_path), ["die once", "die", "one"], 1))
    assert found.keys() == {"die once", "die", "one"}
    assert (found["die once"], found["one"]) == (None, None)
    assert "died 2 times (signal 9)" in (found["die"] or "")
    assert sorted(path.name for path in tmp_path.glob("*e*-[0-9]")) == [
        "die once-0", "die once-1", "die-0", "die-1", "one-0",
    ]  # fmt: skip


def test_an_interrupt_at_a_bad_moment_is_late_not_lost() -> None:
    reached = False
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs of a shell ignore it
    try:
        with pytest.raises(KeyboardInterrupt), interrupts_held():  # noqa: PT012
            os.kill(os.getpid(), signal.SIGINT)
            reached = True
    finally:
        signal.signal(signal.SIGINT, before)
    assert reached


def test_without_jobs_nothing_is_started() -> None:
    def unexpected() -> None:
        raise AssertionError

    assert list(work_in_processes(Toys(Path("nowhere")), [], 2, meanwhile=unexpected)) == []


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks processes up in /proc")
def test_closing_ends_the_processes(tmp_path: Path) -> None:
    outcomes = work_in_processes(Toys(tmp_path), ["one", "sleep", "two"], 1)
    assert next(outcomes) == ("one", None)
    outcomes.close()
    (process,) = processes(tmp_path)
    assert not is_running(process)
    assert not (tmp_path / "two-0").exists()


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks processes up in /proc")
def test_processes_do_not_outlive_a_killed_parent(tmp_path: Path) -> None:
    program = (
        "import sys, pathlib; from refine.batch.processes import work_in_processes;"
        "from tests.refine.batch.toys import Toys;"
        "list(work_in_processes(Toys(pathlib.Path(sys.argv[1])), ['sleep'], 1))"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    parent = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], env=environment)
    deadline = time.monotonic() + PATIENCE
    while not (tmp_path / "sleep-0").exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    (process,) = processes(tmp_path)
    while is_running(process):
        assert time.monotonic() < deadline
        time.sleep(0.01)
