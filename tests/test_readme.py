"""What README prints works: its Python runs, its commands know their options, its links lead somewhere."""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest
import torch
import typer
from typer.main import get_command

from refine.cli import SUBCOMMANDS
from refine.maps import read_maps
from refine.refiner import Refined

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FEW = "iters=3"
MODULES = {"refine": "refine.cli", "refine-train": "refine.train", "refine-eval": "eval.cli"}
"""Where the console scripts are."""


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def commands() -> list[list[str]]:
    """Return README's commands as words: those in shell blocks and those in the text."""
    lines = [line for block in blocks("sh") for line in block.splitlines()]
    prose = re.sub(r"^```.*?^```", "", README, flags=re.MULTILINE | re.DOTALL)
    lines += [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose)]
    split = [shlex.split(part, comments=True) for line in lines for part in line.split("&&")]
    return [
        words
        for words in split
        if (len(words) > 1 and words[0] in MODULES) or (len(words) > 2 and words[:2] == ["python", "-m"])
    ]


@functools.cache
def offered(module: str) -> frozenset[str]:
    """Return the options of a command: typer's as it lists them, argparse's from its help."""
    loaded = importlib.import_module(module)
    for app in vars(loaded).values():
        if isinstance(app, typer.Typer):
            command = get_command(app)
            every = [command, *getattr(command, "commands", {}).values()]
            return frozenset(option for one in every for parameter in one.params for option in parameter.opts)
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said):
        patch.setattr(sys, "argv", [module, "--help"])
        with pytest.raises(SystemExit, match=r"^0$"):
            loaded.main()
    return frozenset(re.findall(r"(?<!\w)--?[a-z][a-z-]*", said.getvalue()))


def test_the_python_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (example,) = blocks("python")
    shortened, changed = re.subn(r"iters=\d+", FEW, example)
    assert changed == 1
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(shortened, "README.md", "exec"), names)
    refined, image = names["refined"], names["image"]
    assert isinstance(refined, Refined)
    assert isinstance(image, torch.Tensor)
    said = re.search(r"image = .*# \[(.*?)\]", example)
    assert said is not None
    assert list(image.shape) == [int(number) for number in said[1].split(",")]
    assert bool(torch.isfinite(image).all())
    read_maps(tmp_path / "out", "slate").validate()
    named = re.search(r"save\(.*?# (.*?), \.\.\.", example)
    assert named is not None
    assert all((tmp_path / "out" / name).is_file() for name in named[1].split(", "))


def test_commands_are_found() -> None:
    assert {words[0] for words in commands()} == {"refine", "refine-train", "refine-eval", "python"}
    assert any("--iters" in words for words in commands())


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_commands_know_their_options(words: list[str]) -> None:
    module = words[2] if words[0] == "python" else MODULES[words[0]]
    if words[0] == "refine" and words[1] in SUBCOMMANDS:
        module = SUBCOMMANDS[words[1]].partition(":")[0]
    used = {word.partition("=")[0] for word in words[3 if words[0] == "python" else 1 :] if word[0] == "-"}
    assert used <= offered(module) | {"--help"}


def test_options_named_in_the_text_exist() -> None:
    named = {word for code in re.findall(r"`(--[^`]+)`", README) for word in code.split() if word[:2] == "--"}
    assert named
    assert named <= offered("refine.cli")


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    links = [link for link in re.findall(r"\]\(([^)\s]+)", text) if not re.match(r"[a-z]+:|#", link)]
    assert [link for link in links if not (page.parent / link.partition("#")[0]).exists()] == []
    assert links or page.name != "README.md"


def test_files_named_in_commands_exist() -> None:
    named = set(re.findall(r"examples/[\w.]+", README))
    assert named
    assert [name for name in named if not (ROOT / name).is_file()] == []


def test_ci_runs_the_test_line_that_readme_prints() -> None:
    section = README.split("## Test", 1)[1].split("\n## ", 1)[0]
    found = re.search(r"```sh\n(.*?)```", section, re.DOTALL)
    assert found is not None
    lines = (ROOT / ".ci" / "run").read_text().splitlines()
    script = [re.sub(r" --quiet| --constraint \S+", "", line) for line in lines]
    assert found[1].strip() in script


def test_the_extras_that_readme_installs_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = set(re.findall(r"\.\[(\w+)\]", README))
    assert "test" in named
    assert named <= set(extras)
