"""How long it takes to begin: imports and help, beside an empty Python and torch alone.

`python -m eval.benchmarks.startup [--rounds N] [--markdown FILE]`. Every command is a process of its own; all
take turns, so that a machine that slows down slows them all. Elapsed time depends on what else the machine
does, processor time hardly.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median

from eval.report import markdown_table, origin, provenance

COMMANDS: dict[str, tuple[str, ...]] = {
    "an empty Python": ("-c", "pass"),
    "import torch": ("-c", "import torch"),
    "import refine": ("-c", "import refine"),
    "from refine import Refiner": ("-c", "from refine import Refiner"),
    "refine --help": ("-m", "refine.cli", "--help"),
    "refine completion bash -- x.jpg --": ("-m", "refine.cli", "completion", "bash", "--", "x.jpg", "--"),
}
"""What is started, as arguments of Python."""

Seconds = tuple[float, float]
"""Elapsed and of the processor."""


def run_python(arguments: Sequence[str], stderr: int | None = None) -> tuple[float, resource.struct_rusage]:
    """Run Python once to its end; return the seconds it took and what it used.

    Args:
        arguments: of Python.
        stderr: `subprocess.PIPE` keeps what it says for the error.

    Raises:
        subprocess.CalledProcessError: it failed.
    """
    began = time.perf_counter()
    command = [sys.executable, *arguments]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=stderr, text=True) as process:
        said = process.stderr.read() if process.stderr else None
        _, status, usage = os.wait4(process.pid, 0)
        elapsed = time.perf_counter() - began
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, process.args, stderr=said)
    return elapsed, usage


def start(arguments: Sequence[str]) -> Seconds:
    """Run Python once to its end.

    Raises:
        subprocess.CalledProcessError: it failed.
    """
    elapsed, usage = run_python(arguments)
    return elapsed, usage.ru_utime + usage.ru_stime


def take_turns(commands: Mapping[str, Sequence[str]], rounds: int) -> dict[str, list[Seconds]]:
    """Start every command in every round, after one round that does not count."""
    taken: dict[str, list[Seconds]] = {name: [] for name in commands}
    for number in range(rounds + 1):
        for name, arguments in commands.items():
            seconds = start(arguments)
            if number:
                taken[name].append(seconds)
    return taken


def markdown(taken: Mapping[str, Sequence[Seconds]], about: Mapping[str, str]) -> str:
    """Return medians as a table."""
    rounds = len(next(iter(taken.values())))
    rows = []
    for name, seconds in taken.items():
        elapsed, processor = zip(*seconds, strict=True)
        rows.append(
            (f"`{name}`", f"{median(elapsed):.2f}", f"{min(elapsed):.2f}", f"{median(processor):.2f}")
        )
    heads = ("started", "elapsed, median (s)", "elapsed, least (s)", "processor, median (s)")
    caption = (
        f"Processes from start to end, {rounds} rounds in turns, by `python -m eval.benchmarks.startup`; "
        f"{origin(about)}."
    )
    return "\n".join([caption, "", *markdown_table(heads, rows, texts=1), ""])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--markdown", type=Path, help="write the table here, too")
    arguments = parser.parse_args()
    about = provenance()
    table = markdown(take_turns(COMMANDS, arguments.rounds), about)
    print(table, end="")
    if arguments.markdown is not None:
        arguments.markdown.write_text(table, encoding="utf-8")


if __name__ == "__main__":
    main()
