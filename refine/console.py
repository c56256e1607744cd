"""What the command line says to a person: progress and summary, on standard error only."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def progress_bar(*, shown: bool) -> Iterator[Callable[[str, int, int, float], None] | None]:
    """Show stage, loss and time left on standard error while the block runs."""
    if not shown:
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.fields[stage]:<14}", markup=False),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn("{task.fields[loss]}", markup=False),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=None, stage="initialization", loss="")

        def tell(stage: str, iteration: int, iterations: int, loss: float) -> None:
            progress.update(task, completed=iteration, total=iterations, stage=stage, loss=f"loss {loss:.4f}")

        yield tell


def summarise(record: dict[str, Any], paths: dict[str, Path], *, estimated: bool) -> None:
    """Say what was done and written: some lines to a person, one to a log.

    Args:
        record: of `refine.result.describe`.
        paths: every file written.
        estimated: whether the light was not given.
    """
    source, notes = record["photo"]["source"], "; ".join(record["photo"]["notes"])
    where = ", ".join(f"{value:.2f}" for value in record["light"]["position"])
    light = f"light {'estimated' if estimated else 'given'} at ({where})"
    before, after = (_number(record["rmse"][name]) for name in ("initialization", "refined"))
    count = sum(stage["iterations"] for stage in record["recipe"]["stages"])
    error = f"re-rendering RMSE {before} -> {after} in {count} iterations"
    if count == 0:
        error = f"re-rendering RMSE {before}, not refined"
    folder = paths["json"].parent
    if not sys.stderr.isatty():
        print(f"{source}: {notes}; {light}; {error}; wrote {len(paths)} files to {folder}", file=sys.stderr)
        return
    seconds = sum(record["seconds"].values())
    print(f"{source}: {notes}", file=sys.stderr)
    print(f"{light}; {error}, {seconds:.0f} s", file=sys.stderr)
    print(f"wrote to {folder}{os.sep}", file=sys.stderr)
    for path in paths.values():
        print(f"  {path.name}", file=sys.stderr)


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.4f}"
