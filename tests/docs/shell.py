"""Runs commands of the documentation in this process, on little: what is appended to them is said here.

`docs/index.md` says so, too, under "These pages are run".
"""

from __future__ import annotations

import re
import runpy
import sys
import tomllib
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from importlib import import_module
from pathlib import Path

import pytest
import typer

import refine.cli
from tests.docs.examples import ROOT

TINY_NETWORK = "tiny.safetensors"
"""In the folder that examples run in."""

QUICK = ("--iters", "2", "--resolution", "64", "--threads", "1", "--no-report")
"""Of `refine`; the last of an option counts, so that these win."""

TRAINING = ("--config", "tiny.yaml", "--data", "strips", "--devices", "1", "--accelerator", "cpu")
"""Of `refine-train`."""

UNLESS_SAID = (("--init", TINY_NETWORK), ("--recipe", "fast"))
"""Of `refine`, where the example does not say its own."""

DOWNLOADS = ("losses.fetch_weights",)
"""Modules that are not run, but must be there."""

POOL = ("--procedural", "2", "--size", "32", "--workers", "0")
"""Of `python -m nets.data.pool`."""


def run(words: Sequence[str]) -> None:
    """Run one command; output may go to a file by `>`.

    Raises:
        AssertionError: the program is none of ours, or its exit code is not 0.
    """
    *command, target = words if ">" in words else [*words, ">", ""]
    program, *arguments = command[: command.index(">")]
    assert program in PROGRAMS, f"the tests cannot run {program!r}; say why not in a comment above"
    if target:
        with Path(target).open("w", encoding="utf-8") as file, redirect_stdout(file):
            code = PROGRAMS[program](arguments)
    else:
        code = PROGRAMS[program](arguments)
    assert code == 0, f"{' '.join(words)} ended with {code}"


def _refine(arguments: list[str]) -> int:
    command = arguments[0]
    if command == "view" and "--html" not in arguments:
        arguments = [*arguments, "--html", "page.html"]
    elif command not in refine.cli.SUBCOMMANDS:
        unless_said = [word for pair in UNLESS_SAID if pair[0] not in arguments for word in pair]
        arguments = [*arguments, *QUICK, *unless_said]
    return refine.cli.run(arguments)


def _typer(module: str, name: str, *more: str) -> Callable[[list[str]], int]:
    def call(arguments: list[str]) -> int:
        app: typer.Typer = getattr(import_module(module), name)
        return app([*arguments, *more], standalone_mode=False) or 0

    return call


def _python(arguments: list[str]) -> int:
    if arguments[0] == "-m":
        module, more = arguments[1], arguments[2:]
        main = import_module(module).main
        if module in DOWNLOADS:
            return 0
        more += POOL if module == "nets.data.pool" else ()
    else:
        main = lambda: runpy.run_path(arguments[0], run_name="__main__")  # noqa: E731
        module, more = arguments[0], arguments[1:]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [module, *more])
        try:
            main()
        except SystemExit as end:
            return int(end.code or 0)
    return 0


def _pip(arguments: list[str]) -> int:
    # Installing is CI's own first step; here only that what is asked for exists.
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = {name for word in arguments for name in re.findall(r"\[([\w,]+)\]", word)}
    return 0 if arguments[0] == "install" and named <= set(extras) else 1


PROGRAMS: dict[str, Callable[[list[str]], int]] = {
    "refine": _refine,
    "refine-train": _typer("refine.train", "app", *TRAINING),
    "refine-eval": _typer("eval.cli", "main"),
    "python": _python,
    "pip": _pip,
    "pytest": lambda arguments: 0,  # this is it
}
