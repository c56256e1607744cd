"""`refine-train` as a person runs it: two processes, by its own launch and by torchrun, do what one does."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from refine.train import STATE
from tests.training_files import NO_VGG, write_plan, write_strips

STAGES = [
    {
        "name": name,
        "objective": {"kind": "synthetic", "rendering_weight": weight, **NO_VGG},
        "phases": [{"iterations": 2, "crop": 16, "batch": 2, "shards": 2}],
    }
    for name, weight in (("maps", 0.0), ("syn", 5.0))
]
PROGRAM = """
import refine.train as train
train.LOG_EVERY = 1
train.main()
"""
"""The console script, with a log of every iteration."""


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Train the same plan three times, at once; return the folders."""
    folder = tmp_path_factory.mktemp("processes")
    data, plan = write_strips(folder / "strips", 4), write_plan(folder / "plan.yaml", *STAGES)
    script = folder / "often.py"
    script.write_text(PROGRAM)
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    launches: dict[str, tuple[list[str], list[str]]] = {
        "one": ([], []),
        "own": ([], ["--devices", "2"]),
        "torchrun": (torchrun, []),
    }
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("RANK", "LOCAL_", "WORLD_", "MASTER_"))}
    running = {}
    for name, (before, after) in launches.items():
        asked = ["--config", plan, "--data", data, "--out", folder / name, "--accelerator", "cpu", *after]
        running[name] = subprocess.Popen(
            [sys.executable, *before, str(script), *map(str, asked)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**clean, "OMP_NUM_THREADS": "1"},
        )
    for name, process in running.items():
        said, complained = process.communicate(timeout=600)
        assert process.returncode == 0, complained
        assert (name, complained) == (name, "")
        assert (name, said) == (name, "")
    return {name: folder / name for name in launches}


def lines_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


@pytest.mark.parametrize("launch", ["own", "torchrun"])
@pytest.mark.parametrize("stage", ["maps", "syn"])
def test_two_processes_log_what_one_does(trained: dict[str, Path], launch: str, stage: str) -> None:
    alone, together = (lines_of(trained[name] / stage) for name in ("one", launch))
    assert [line["iteration"] for line in alone] == [line["iteration"] for line in together] == [1, 2, 2]
    for one, two in zip(alone, together, strict=True):
        one, two = one.get("validation", one), two.get("validation", two)
        assert one.keys() == two.keys()
        for name in one.keys() - {"time", "samples_per_second"}:
            assert two[name] == pytest.approx(one[name], rel=1e-4, abs=2e-5), name


@pytest.mark.parametrize("launch", ["own", "torchrun"])
def test_two_processes_end_with_the_networks_of_one(trained: dict[str, Path], launch: str) -> None:
    one, two = (torch.load(trained[name] / "syn" / STATE, weights_only=True) for name in ("one", launch))
    assert (two["iteration"], two["samples"]) == (2, 8)
    for player in ("network", "critics"):
        for name, value in one[player].items():
            torch.testing.assert_close(two[player][name], value, rtol=1e-3, atol=2e-5)


def test_several_processes_write_one_log(trained: dict[str, Path]) -> None:
    for launch in ("one", "own", "torchrun"):
        for stage in ("maps", "syn"):
            boards = list((trained[launch] / stage / "tensorboard").iterdir())
            assert len(boards) == 1
