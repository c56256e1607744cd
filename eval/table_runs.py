"""Every row on every scene of a test set: what is missing is computed, by one process or several."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import Any

import torch

from eval.ledger import Ledger
from eval.methods import Row
from eval.report import provenance
from eval.yardsticks import Yardstick
from losses.perceptual import LPIPS
from nets.data.images import DataError
from nets.processes import end_with_parent
from refine.memory import StageMemory
from refine.refiner import Refiner
from refine.stages import LatentStage


@dataclass
class Run:
    """What is known of a table.

    Attributes:
        results: scores, seconds, commit and machine by row and scene.
        skipped: why, by name of a scene, or of a row and a scene.
    """

    results: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Trial:
    """One row on one scene."""

    row: str
    index: int


@dataclass(frozen=True)
class Failure:
    """Why there are no scores, and whether that is the scene's fault."""

    reason: str
    of_scene: bool


class Bench:
    """Rows and scenes at hand: each network is loaded once, each scene kept while it is used.

    Rows that begin with the same latent stage share it, if one is asked after the other: `together`.
    """

    def __init__(self, yardstick: Yardstick, rows: Sequence[Row]) -> None:
        """Load LPIPS; networks follow when they are used."""
        self.yardstick, self.rows = yardstick, {row.method.name: row for row in rows}
        self.lpips, self._memory = LPIPS(), StageMemory()
        self._refiners: dict[str, Refiner] = {}
        self._scene: tuple[int, Any] | None = None

    def attempt(self, trial: Trial) -> dict[str, Any] | Failure:
        """Return scores and seconds, or why there are none."""
        yardstick, row = self.yardstick, self.rows[trial.row]
        try:
            if self._scene is None or self._scene[0] != trial.index:
                self._scene = trial.index, yardstick.read(trial.index)
        except DataError as error:
            return Failure(str(error), of_scene=True)
        if trial.row not in self._refiners:
            self._refiners[trial.row] = row.refiner(
                yardstick.camera,
                yardstick.size,
                yardstick.seed,
                flips=yardstick.flips,
                memory=self._memory,
            )
        refiner, refine = self._refiners[trial.row], row.method.recipe is not None
        try:
            refined = yardstick.answer(self._scene[1], refiner, refine=refine)
            return yardstick.score(self._scene[1], refined, self.lpips)
        except ValueError as error:  # maps that cannot be scored: the row's fault
            return Failure(str(error), of_scene=False)


def measure(
    yardstick: Yardstick,
    rows: Sequence[Row],
    indices: Sequence[int],
    ledger: Ledger,
    workers: int,
    progress: Callable[[str], None] | None = None,
) -> Run:
    """Score rows on scenes, but for what the ledger knows already.

    Args:
        yardstick: test set and protocol.
        rows: whose weights are there.
        indices: of the scenes.
        ledger: gains every new result as soon as it is there.
        workers: processes, of one torch thread each; one is this process.
        progress: called with the name of every row and scene, known or new.

    Returns:
        Results in the order of scenes and rows, the same for any number of workers.
    """
    names, about = yardstick.scenes(), provenance()
    run, keys = Run(), {}
    for index in indices:
        scene = yardstick.key(index)
        for row in rows:
            keys[Trial(row.method.name, index)] = {**row.settings(), **scene}

    def take(trial: Trial, result: dict[str, Any]) -> None:
        run.results[trial.row, names[trial.index]] = result
        if progress is not None:
            progress(f"{trial.row}, {names[trial.index]}")

    missing = []
    for trial, key in keys.items():
        known = ledger.find(key)
        if known is None:
            missing.append(trial)
        else:
            take(trial, known)
    for trial, found in _attempts(yardstick, rows, missing, workers):
        name = names[trial.index]
        if isinstance(found, Failure):
            run.skipped[name if found.of_scene else f"{trial.row} on {name}"] = found.reason
        else:
            ledger.add(keys[trial], found | about)
            take(trial, found | about)
    order = [(trial.row, names[trial.index]) for trial in keys]
    run.results = {place: run.results[place] for place in order if place in run.results}
    return run


def _attempts(
    yardstick: Yardstick, rows: Sequence[Row], trials: Sequence[Trial], workers: int
) -> Iterator[tuple[Trial, dict[str, Any] | Failure]]:
    if not trials:
        return
    parts = together(rows, trials)
    if workers == 1:
        bench = Bench(yardstick, rows)
        yield from ((trial, bench.attempt(trial)) for part in parts for trial in part)
        return
    # Spawned: forks of a process whose libraries have threads may hang.
    with ProcessPoolExecutor(workers, get_context("spawn"), _open, (yardstick, rows)) as pool:
        try:
            pending = {pool.submit(_attempt, part): part for part in parts}
            for done in as_completed(pending):
                yield from zip(pending[done], done.result(), strict=True)
        finally:
            pool.shutdown(cancel_futures=True)


def together(rows: Sequence[Row], trials: Sequence[Trial]) -> list[list[Trial]]:
    """Part trials: those of one scene whose rows begin with the same network and latent stage go together."""
    parts: dict[tuple[Any, ...], list[Trial]] = {}
    known = {row.method.name: row for row in rows}
    for trial in trials:
        row = known[trial.row]
        first = row.recipe.stages[0] if row.recipe else None
        begins = (row.digest, first) if isinstance(first, LatentStage) else trial.row
        parts.setdefault((trial.index, begins), []).append(trial)
    return list(parts.values())


_bench: Bench | None = None


def _open(yardstick: Yardstick, rows: Sequence[Row]) -> None:
    global _bench
    end_with_parent()
    torch.set_num_threads(1)
    _bench = Bench(yardstick, rows)


def _attempt(part: Sequence[Trial]) -> list[dict[str, Any] | Failure]:
    assert _bench is not None
    return [_bench.attempt(trial) for trial in part]
