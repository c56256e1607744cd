"""The rooms of the house: imports go `nets <- losses <- refine <- eval`, one way, no exceptions."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("nets", "losses", "refine", "eval")
"""In the order in which they may import each other: each only itself and those before it."""

MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
LONGEST_MODULE = 350


def imported_names(source: str, package: str = "") -> Iterator[str]:
    """Yield the absolute name of everything imported anywhere in a module, inside functions too."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            yield ".".join([*parents, *([node.module] if node.module else [])])
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = ast.unparse(node.func)
            if called in {"__import__", "import_module", "importlib.import_module"}:
                yield str(node.args[0].value)


def imports_of(path: Path) -> set[str]:
    package = ".".join(path.relative_to(ROOT).parts[:-1])
    return {name.partition(".")[0] for name in imported_names(path.read_text(), package)}


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_the_reader_of_imports_sees_every_form() -> None:
    source = """
import eval.table1 as t, json
from refine.stages import Recipe
from . import sibling
from ..losses import objective
def late():
    import torchvision.models
    import_module("eval")
"""
    assert set(imported_names(source, "nets.data")) == {
        "eval.table1", "json", "refine.stages", "nets.data", "nets.losses", "torchvision.models", "eval",
    }  # fmt: skip


def test_all_packages_are_there() -> None:
    assert {name_of(path).split("/")[0] for path in MODULES} == set(PACKAGES)


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_imports_go_one_way(path: Path) -> None:
    room = PACKAGES.index(path.relative_to(ROOT).parts[0])
    forbidden = set(PACKAGES[room + 1 :]) | {"tests", "torchvision"}
    assert not imports_of(path) & forbidden


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_a_reader_can_hold_a_module_in_mind(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= LONGEST_MODULE
