"""Files under writers that are killed, disks that are full, folders one may not write to, and two at once."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from eval.benchmarks.kills import NAMES, SIZE, Kills, contents, examine, in_child, is_hidden, kill_one, write
from nets.svbrdf import SVBRDF
from refine.errors import UserError
from refine.files import write_together
from refine.maps import write_maps
from refine.result import FORMAT, Output
from tests.reliability.tools import outcome_of

REAL_OPEN = os.open

STEPS = (
    *((os, name) for name in ("mkdir", "open", "close", "fsync", "replace", "unlink", "rmdir")),
    *((Path, "write_bytes"), (Path, "open")),
)
"""What a writer does to the disk."""


def killed_at(folder: Path, step: int) -> bool:
    """Have a writer killed right before its n-th step on disk; return whether it came that far."""

    def work() -> None:
        steps = 0

        def counted(function: Callable[..., Any]) -> Callable[..., Any]:
            def call(*arguments: Any, **options: Any) -> Any:
                nonlocal steps
                steps += 1
                if steps > step:
                    if isinstance(arguments[-1], bytes):  # half of it is written by then
                        os.write(REAL_OPEN(arguments[0], os.O_WRONLY), arguments[-1][: SIZE // 2])
                    os.kill(os.getpid(), signal.SIGKILL)
                return function(*arguments, **options)

            return call

        for owner, name in STEPS:
            setattr(owner, name, counted(getattr(owner, name)))
        write(folder, 1)

    _, status = os.waitpid(in_child(work), 0)
    return os.WIFSIGNALED(status)


def test_a_writer_killed_at_any_step_leaves_old_files_or_new_ones(tmp_path: Path) -> None:
    found, step = Kills(0), 0
    write(tmp_path, 0)
    while killed_at(tmp_path, step):
        step += 1
        found.kills += 1
        examine(tmp_path, found)
        assert found.broken == []
        seen = {path.name for path in tmp_path.iterdir() if not is_hidden(path)}
        assert set(NAMES[:-1]) <= seen <= set(NAMES)
        assert len(os.listdir(tmp_path)) <= len(seen) + 1  # each removes what those before it left
    assert step >= 6 * len(NAMES)  # opened, closed, written, opened, flushed, renamed
    examine(tmp_path, found)
    assert sorted(os.listdir(tmp_path)) == sorted(NAMES)
    assert [(tmp_path / name).read_bytes() for name in NAMES] == contents(1)


def test_writers_killed_at_random_moments(tmp_path: Path) -> None:
    found = Kills(1)
    write(tmp_path, 0)
    for _ in range(5):
        kill_one(tmp_path, found)
    assert (found.kills, found.broken) == (5, [])
    assert found.whole == 5 * len(NAMES) - found.unrecorded


def test_a_broken_file_would_be_noticed(tmp_path: Path) -> None:
    write(tmp_path, 0)
    (tmp_path / NAMES[1]).write_bytes(contents(1)[1][: SIZE // 2])
    found = Kills(0)
    examine(tmp_path, found)
    assert found.broken == [f"{NAMES[1]} after kill 0"]


@pytest.mark.parametrize("what", ["bytes", "maps"])
def test_a_full_disk_ends_in_one_sentence_and_leaves_what_was_there(tmp_path: Path, what: str) -> None:
    write(tmp_path, 0)

    def work() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
        if what == "bytes":
            write(tmp_path, 1)
        else:
            write_maps(tmp_path / "new", "wall", SVBRDF.constant(64, 64).map(_noisy))

    message = outcome_of(work)
    assert message.startswith("UserError: Cannot write")
    assert message.endswith("make room there.")
    assert sorted(os.listdir(tmp_path)) == sorted(NAMES)
    assert [(tmp_path / name).read_bytes() for name in NAMES] == contents(0)


def _noisy(tensor: torch.Tensor) -> torch.Tensor:
    return tensor if tensor.shape[1] == 3 and float(tensor[:, 2].min()) == 1.0 else torch.rand_like(tensor)


@pytest.mark.skipif(os.geteuid() == 0 and shutil.which("setpriv") is None, reason="root may write anywhere")
def test_a_folder_one_may_not_write_to(tmp_path: Path) -> None:
    (tmp_path / "closed").mkdir(mode=0o555)
    tmp_path.chmod(0o755)
    for parent in tmp_path.parents:
        if parent.name.startswith("pytest"):
            parent.chmod(0o755)

    def work() -> None:
        if os.geteuid() == 0:
            os.setgroups([])
            os.setgid(65534)
            os.setuid(65534)
        write(tmp_path / "closed", 0)

    message = outcome_of(work)
    assert message.startswith("UserError: Cannot write")
    assert "Permission denied; choose another folder" in message
    assert os.listdir(tmp_path / "closed") == []


def test_two_runs_into_one_folder_take_turns(tmp_path: Path) -> None:
    """Each writes in its own format and removes the other's files: those of one of them are left."""
    formats = ("png", "exr")

    def run(extension: str) -> None:
        output = Output(tmp_path, "wall", extension, report=False)
        mine = {name: path for name, path in output.paths().items() if name in ("normal", "json")}
        others = [tmp_path / f"wall_normal.{other}" for other in formats if other != extension]
        for _ in range(10):
            with write_together(list(mine.values()), lambda: others) as temporaries:
                temporaries[0].write_text(extension)
                temporaries[1].write_text(json.dumps({"format": FORMAT, "of": extension}))

    children = [in_child(lambda extension=extension: run(extension)) for extension in formats]  # type: ignore[misc]
    assert [os.waitpid(child, 0)[1] for child in children] == [0, 0]
    of = json.loads((tmp_path / "wall.json").read_text())["of"]
    assert sorted(os.listdir(tmp_path)) == ["wall.json", f"wall_normal.{of}"]
    assert (tmp_path / f"wall_normal.{of}").read_text() == of


def test_an_error_of_the_block_is_not_hidden_by_the_lock(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="Cannot write"), write_together([tmp_path / "a"]):
        raise OSError(28, "No space left on device")
    assert os.listdir(tmp_path) == []
