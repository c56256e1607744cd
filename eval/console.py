"""What every command of `refine-eval` says and how it ends: messages, exit codes, the progress bar."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from nets.checkpoint import CheckpointError
from nets.data.images import DataError

BAD_USAGE = 2
"""Exit code: nothing was done, one sentence says why."""

INCOMPLETE = 3
"""Exit code: done, but scenes, sets or rows that are named were skipped."""

errors = Console(stderr=True, soft_wrap=True, highlight=False)


def tell(message: str) -> None:
    """Say something on standard error."""
    errors.print(f"refine-eval: {message}", markup=False)


@contextmanager
def mistakes() -> Iterator[None]:
    """Turn what a user can mend into one sentence and an exit code, before anything is computed."""
    try:
        yield
    except (DataError, CheckpointError, ValueError) as error:
        tell(str(error))
        raise typer.Exit(BAD_USAGE) from None


@contextmanager
def progress(total: int) -> Iterator[Callable[[str], None]]:
    """Show a bar on a terminal; yield what is to be called with the name of everything that is done."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as bar:
        task = bar.add_task("scenes", total=total)
        yield lambda name: bar.update(task, advance=1, description=name[-40:])
