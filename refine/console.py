"""What the command line says to a person: progress and summary, on standard error only."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from refine.refiner import Refined
    from refine.result import Output


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


def summarise(
    refined: Refined, record: dict[str, Any], output: Output, paths: dict[str, Path], *, estimated: bool
) -> None:
    """Say on standard error what was done and written: several lines to a person, one to a log."""
    where = ", ".join(f"{value:.2f}" for value in record["light"]["position"])
    light = f"light {'estimated' if estimated else 'given'} at ({where})"
    errors = ["unknown" if value is None else f"{value:.4f}" for value in list(record["rmse"].values())[1:]]
    count = refined.recipe.iterations
    fit = (
        f"re-rendering RMSE {errors[0]} -> {errors[1]} in {count} iterations"
        if count
        else f"RMSE {errors[0]}, not refined"
    )
    notes = "; ".join(refined.notes)
    if not sys.stderr.isatty():
        said = f"{refined.source}: {notes}; {light}; {fit}; wrote {len(paths)} files to {output.folder}"
        print(said, file=sys.stderr)
        return
    seconds = sum(refined.seconds.values())
    print(f"{refined.source}: {notes}", file=sys.stderr)
    print(f"{light}; {fit}, {seconds:.0f} s", file=sys.stderr)
    print(f"wrote {output.folder}/", file=sys.stderr)
    print("  " + "  ".join(path.name for path in paths.values()), file=sys.stderr)
