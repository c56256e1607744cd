"""Hidden folders in which files are written before they are renamed, and what killed processes left of them.

Whether a process still lives is asked of the system, by a lock that ends with it, and not of any number that
another process may have been given since. What the files hold and when they are renamed is the business of
`files.py`.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

NAME = re.compile(r"\.refine-[0-9a-f]{16}")
"""Of a hidden folder; nothing else is ever taken for one."""

LOCK = "lock"
"""The file in it that is locked as long as its process lives."""


@contextmanager
def staging_folder(folder: Path) -> Iterator[Path]:
    """Make a hidden folder in `folder`, removed in the end; what killed processes left there goes first.

    Raises:
        OSError: it cannot be made.
    """
    with contextlib.ExitStack() as stack:
        with held([folder]) as alone:  # so that nobody comes upon it before it is locked
            if alone:
                _remove(folder, _is_abandoned)
            path = folder / f".refine-{secrets.token_hex(8)}"
            path.mkdir()
            stack.callback(shutil.rmtree, path, ignore_errors=True)
            descriptor = os.open(path / LOCK, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
            stack.callback(os.close, descriptor)
            _lock(descriptor)
        yield path


def remove_debris(folder: Path, *, unasked: bool = False) -> None:
    """Remove the hidden folders in `folder` that killed processes left, and none of a process that lives.

    Args:
        folder: may be missing.
        unasked: whether they are all removed where there are no locks to tell those in use: for folders
            that nobody else writes to.
    """
    with contextlib.suppress(OSError), held([folder]) as alone:
        if alone or unasked:
            _remove(folder, _is_abandoned if alone else lambda path: True)


@contextmanager
def held(folders: Iterable[Path]) -> Iterator[bool]:
    """Keep other processes out of this block as long as it is about the same folders.

    A folder is its own lock, which leaves nothing behind. Where there are no locks (Windows, some network
    file systems) nothing is kept out, and False is yielded.

    Raises:
        OSError: a folder cannot be read.
    """
    with contextlib.ExitStack() as stack:
        alone = fcntl is not None
        for folder in sorted(folders) if fcntl is not None else ():
            descriptor = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, descriptor)
            alone &= _lock(descriptor)
        yield alone


def flush(folders: Iterable[Path]) -> None:
    """Write folders to disk, or a power cut could undo what was renamed in them."""
    for folder in folders if fcntl is not None else ():
        with contextlib.suppress(OSError):
            descriptor = os.open(folder, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)


def _remove(folder: Path, condition: Callable[[Path], bool]) -> None:
    for path in folder.glob(".refine-*"):
        if NAME.fullmatch(path.name) and path.is_dir() and not path.is_symlink() and condition(path):
            shutil.rmtree(path, ignore_errors=True)


def _is_abandoned(path: Path) -> bool:
    try:
        descriptor = os.open(path / LOCK, os.O_RDWR)
    except FileNotFoundError:  # killed before it was made, or while the folder was removed
        return True
    except OSError:
        return False
    try:
        return _lock(descriptor, wait=False)
    finally:
        os.close(descriptor)


def _lock(descriptor: int, *, wait: bool = True) -> bool:
    """Lock an open file; return whether that was possible."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except (OSError, AttributeError):  # no locks in this system or file system, or not to be had
        return False
    return True
