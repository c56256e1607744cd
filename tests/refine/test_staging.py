"""What killed processes left is removed by the next; what a living one writes is never touched."""

from __future__ import annotations

import errno
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from eval.benchmarks.kills import in_child
from refine import staging
from refine.files import write_text_atomically
from refine.staging import LOCK, NAME, remove_debris, staging_folder

DEBRIS = ".refine-0123456789abcdef"


def leave_debris(folder: Path) -> Path:
    """Have a process killed while it writes in `folder`; return what it left."""

    def work() -> None:
        with staging_folder(folder) as hidden:
            (hidden / "0.png").write_bytes(b"half")
            os.kill(os.getpid(), signal.SIGKILL)

    before = set(folder.iterdir())
    _, status = os.waitpid(in_child(work), 0)
    assert os.WIFSIGNALED(status)
    (left,) = set(folder.iterdir()) - before
    assert NAME.fullmatch(left.name)
    assert sorted(os.listdir(left)) == ["0.png", LOCK]
    return left


def no_locks(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(descriptor: int, operation: int) -> None:
        raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))

    monkeypatch.setattr(staging.fcntl, "flock", refuse)


def clear(folder: Path) -> None:
    write_text_atomically(folder / "next.txt", "")


@pytest.mark.parametrize("remove", [clear, remove_debris])
def test_debris_of_a_killed_process_is_removed(tmp_path: Path, remove: Callable[[Path], None]) -> None:
    left = leave_debris(tmp_path)
    remove(tmp_path)
    assert not left.exists()


def test_debris_without_a_lock_is_removed(tmp_path: Path) -> None:
    """A process killed right after making the folder, or while it removes it."""
    (tmp_path / DEBRIS).mkdir()
    clear(tmp_path)
    assert os.listdir(tmp_path) == ["next.txt"]


@pytest.mark.parametrize("remove", [clear, remove_debris])
def test_what_a_living_process_writes_is_kept(tmp_path: Path, remove: Callable[[Path], None]) -> None:
    ready, told = os.pipe()
    finish, ask = os.pipe()

    def work() -> None:
        with staging_folder(tmp_path) as hidden:
            (hidden / "0.png").write_bytes(b"half")
            os.write(told, b".")
            os.read(finish, 1)
            assert (hidden / "0.png").read_bytes() == b"half"

    child = in_child(work)
    os.read(ready, 1)
    (living,) = tmp_path.iterdir()
    dead = leave_debris(tmp_path)
    remove(tmp_path)
    assert (living / "0.png").read_bytes() == b"half"
    assert not dead.exists()
    os.write(ask, b".")
    assert os.waitpid(child, 0)[1] == 0
    assert not living.exists()
    for descriptor in (ready, told, finish, ask):
        os.close(descriptor)


def test_what_this_process_writes_is_kept(tmp_path: Path) -> None:
    with staging_folder(tmp_path) as first, staging_folder(tmp_path) as second:
        remove_debris(tmp_path)
        assert first.is_dir()
        assert second.is_dir()
    assert os.listdir(tmp_path) == []


def test_nothing_of_another_name_or_kind_is_removed(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "kept.txt").write_text("kept")
    (tmp_path / DEBRIS).symlink_to(elsewhere)
    for name in (".refine-0123", DEBRIS + "0", ".refine-0123456789ABCDEF", "refine-0123456789abcdef"):
        (tmp_path / name).mkdir()
    (tmp_path / ".refine-fedcba9876543210").write_text("a file")
    before = sorted(tmp_path.rglob("*"))
    remove_debris(tmp_path, unasked=True)
    assert sorted(tmp_path.rglob("*")) == before


def test_where_there_are_no_locks_only_what_is_nobody_elses_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = leave_debris(tmp_path)
    no_locks(monkeypatch)
    clear(tmp_path)
    remove_debris(tmp_path)
    assert left.exists()
    remove_debris(tmp_path, unasked=True)
    assert not left.exists()


def test_a_system_without_locks_still_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(staging, "fcntl", None)
    left = tmp_path / DEBRIS
    left.mkdir()
    clear(tmp_path)
    assert sorted(os.listdir(tmp_path)) == [DEBRIS, "next.txt"]
    remove_debris(tmp_path, unasked=True)
    assert os.listdir(tmp_path) == ["next.txt"]


def test_a_folder_that_is_missing_holds_no_debris(tmp_path: Path) -> None:
    remove_debris(tmp_path / "missing", unasked=True)
    assert os.listdir(tmp_path) == []
