"""What a person sees of a batch at work, on standard error: a bar on a terminal, else a line per photo."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Tell = Callable[[str, str | None], None]
"""Called with every photo, and with the reason if it failed."""


@contextmanager
def batch_view(total: int, known: int, *, quiet: bool) -> Iterator[Tell]:
    """Show how far a batch is while the block runs.

    Args:
        total: photos.
        known: how many of them are done already.
        quiet: whether nothing is shown.
    """
    if quiet:
        yield lambda photo, reason: None
    elif sys.stderr.isatty():
        with _bar(total, known) as tell:
            yield tell
    else:
        yield _lines(total, known)


def _lines(total: int, known: int) -> Tell:
    done = known

    def tell(photo: str, reason: str | None) -> None:
        nonlocal done
        done += 1
        print(f"{done}/{total} {photo}{f': {reason}' if reason else ''}", file=sys.stderr, flush=True)

    return tell


@contextmanager
def _bar(total: int, known: int) -> Iterator[Tell]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.fields[photo]:<24}", markup=False),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=total, completed=known, photo="")

        def tell(photo: str, reason: str | None) -> None:
            if reason is not None:
                progress.console.print(f"{photo}: {reason}", markup=False, highlight=False)
            progress.update(task, advance=1, photo=photo[-24:])

        yield tell
