"""`python -m eval.benchmarks.kills --count 200`: writers that are killed at random moments.

A process writes the files of two results in turn, again and again, into one folder, until it is killed. Every
file must be that of one of the two, to the byte; what the writer had not renamed yet may lie beside them in a
hidden folder, never in their place, until the next writer comes, who removes it. The record, the last of
them, is away while the others are renamed: where it is, all are of one result.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np

from eval.benchmarks.progress import write_progress
from eval.report import provenance
from refine.files import write_together
from refine.staging import NAME as HIDDEN

FORMAT = "svbrdf-refine kills 1"

NAMES = ("wall_normal.png", "wall_diffuse.png", "wall.json")

ROUNDS = 3.0
"""How many times a writer may write its files, about, before it is killed."""

SIZE = 200_000
"""Bytes of a file."""


@dataclass
class Kills:
    """What was found.

    Attributes:
        seed: of the moments.
        round: seconds that a writer takes to start and to write its files once.
        kills: how many writers were killed.
        whole: files that were there and were one of the two, whole.
        broken: files that were not.
        unrecorded: kills after which the record was away: between two renamings.
        leftovers: kills after which a hidden folder was there.
        uncleared: hidden folders that were there still after a writer that was not killed.
    """

    seed: int
    round: float = 0.03
    kills: int = 0
    whole: int = 0
    broken: list[str] = field(default_factory=list)
    unrecorded: int = 0
    leftovers: int = 0
    uncleared: int = 0


def contents(version: int) -> list[bytes]:
    """Return the files of one of the two results."""
    return [np.random.default_rng((version, number)).bytes(SIZE) for number in range(len(NAMES))]


def write(folder: Path, version: int) -> None:
    """Write one of the two results as `refine` does."""
    with write_together([folder / name for name in NAMES]) as temporaries:
        for temporary, content in zip(temporaries, contents(version), strict=True):
            temporary.write_bytes(content)


def in_child(work: Callable[[], object]) -> int:
    """Start `work` in a copy of this process; return its number."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forks besides threads: the child uses none
        child = os.fork()
    if child == 0:
        _work_and_end(work)
    return child


def _work_and_end(work: Callable[[], object]) -> NoReturn:
    try:
        work()
        os._exit(0)
    except BaseException:
        os._exit(1)


def is_hidden(path: Path) -> bool:
    """Whether this is where a writer has its files until it renames them."""
    return HIDDEN.fullmatch(path.name) is not None and path.is_dir()


def examine(folder: Path, found: Kills) -> None:
    """Compare what is in the folder with the two results."""
    known = {name: {contents(v)[n]: v for v in (0, 1)} for n, name in enumerate(NAMES)}
    versions = set()
    found.leftovers += any(map(is_hidden, folder.iterdir()))
    for path in folder.iterdir():
        if is_hidden(path):
            continue
        if path.name in known and (version := known[path.name].get(path.read_bytes())) is not None:
            found.whole += 1
            versions.add(version)
        else:
            found.broken.append(f"{path.name} after kill {found.kills}")
    if not (folder / NAMES[-1]).exists():
        found.unrecorded += 1
    elif len(versions) > 1:
        found.broken.append(f"a record of two results after kill {found.kills}")


def seconds_of_writing(folder: Path) -> float:
    """Return how long a writer takes that nobody kills, the median of some."""
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        os.waitpid(in_child(lambda: write(folder, 0)), 0)
        seconds.append(time.perf_counter() - start)
    return sorted(seconds)[2]


def kill_one(folder: Path, found: Kills) -> None:
    """Start a writer, kill it and look."""

    def write_for_ever() -> None:
        version = 0
        while True:
            write(folder, version % 2)
            version += 1

    moment = np.random.default_rng((found.seed, found.kills)).uniform(0.0, ROUNDS * found.round)
    writer = in_child(write_for_ever)
    time.sleep(moment)
    os.kill(writer, signal.SIGKILL)
    os.waitpid(writer, 0)
    found.kills += 1
    examine(folder, found)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return 0 if no file was broken and nothing is left."""
    parser = argparse.ArgumentParser(prog="python -m eval.benchmarks.kills", description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("docs/results/reliability/kills.json"))
    options = parser.parse_args(arguments)
    found = Kills(options.seed)
    with tempfile.TemporaryDirectory() as folder:
        found.round = round(seconds_of_writing(Path(folder)), 4)
        while found.kills < options.count:
            kill_one(Path(folder), found)
        write(Path(folder), 0)
        found.uncleared = sum(map(is_hidden, Path(folder).iterdir()))
    write_progress(options.out, FORMAT, asdict(found), provenance())
    print(json.dumps(asdict(found)), file=sys.stderr)
    return 1 if found.broken or found.uncleared else 0


if __name__ == "__main__":
    sys.exit(main())
