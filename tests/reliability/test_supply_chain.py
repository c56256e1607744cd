"""Locked versions, lower bounds and licences say what is true of the package and of what it depends on."""

from __future__ import annotations

import importlib.util
import re
import tomllib
from pathlib import Path
from types import ModuleType

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[2]
NOTICE = (ROOT / "NOTICE").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def dependencies() -> ModuleType:
    spec = importlib.util.spec_from_file_location("dependencies", ROOT / ".ci" / "dependencies.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_notice_names_every_dependency_with_its_licence(dependencies: ModuleType) -> None:
    named = dict(re.findall(r"^([a-z0-9-]+): (.+)$", NOTICE, flags=re.MULTILINE))
    needed = dependencies.closure()
    assert {"numpy", "torch", "numba", "llvmlite", "openimageio"} <= set(needed)
    assert sorted(set(needed) - set(named)) == []
    assert "not stated" not in named.values()


def test_the_notice_names_every_file_of_weights() -> None:
    for folder in ("nets/weights", "losses/weights"):
        for path in (ROOT / folder).glob("*.safetensors"):
            assert f"{folder}/{path.name}" in NOTICE


def test_every_dependency_is_locked_at_or_above_its_lower_bound(dependencies: ModuleType) -> None:
    lines = (ROOT / ".ci" / "constraints.txt").read_text().splitlines()
    locked = dict(line.split("==") for line in lines if not line.startswith("#"))
    for wanted in dependencies.wanted():
        name = canonicalize_name(wanted.name)
        assert name in locked, f"{name} is not locked; see .ci/dependencies.py"
        assert wanted.specifier.contains(locked[name]), (name, locked[name])


def test_every_dependency_has_a_lower_bound_that_is_tested(dependencies: ModuleType) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pins = dict(line.split("==") for line in dependencies.lower_bounds())
    for requirement in map(Requirement, project["dependencies"]):
        assert requirement.specifier.contains(Version(pins[canonicalize_name(requirement.name)]))
    assert "--constraint" in (ROOT / ".ci" / "oldest").read_text()


def test_ci_installs_what_is_locked() -> None:
    for line in (ROOT / ".ci" / "run").read_text().splitlines():
        assert not line.startswith("pip install") or "--constraint .ci/constraints.txt" in line
