"""Jobs on a Dask cluster of two workers: all are done, also that of a worker which is killed at it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from refine.batch.cluster import work_on_cluster
from refine.errors import UserError
from tests.refine.batch.toys import Toys

ROOT = Path(__file__).parents[3]


def test_a_killed_worker_s_job_is_done_by_another(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.refine.batch.toy_cluster", str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found == {"one": None, "die once": None, "fail": "it failed", "two": None, "three": None}
    attempts = [(tmp_path / f"die once-{number}").read_text() for number in (0, 1)]
    assert len(set(attempts)) == 2  # processes


def test_an_address_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="No Dask scheduler answers at soup://nowhere:1"):
        list(work_on_cluster(Toys(tmp_path), ["one"], "soup://nowhere:1"))
