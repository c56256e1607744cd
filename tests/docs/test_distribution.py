"""What is installed from a wheel and from a source distribution: all of it, nothing else, and it runs."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from collections.abc import Iterable, Iterator
from importlib import metadata
from pathlib import Path

import pytest

from tests.docs.examples import ROOT

PACKAGES = ("eval", "losses", "nets", "refine")
LARGEST = 60e6
"""Bytes of a wheel; most are networks."""


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command away from the sources; return its standard output."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["OMP_NUM_THREADS"] = "1"
    done = subprocess.run(
        list(map(str, command)), cwd=cwd, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Build a source distribution, and a wheel from what is in that; return both."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT, cwd=folder)
    (source,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return source, wheel


def files_of(*folders: str) -> set[str]:
    """Return the repository's files below some folders."""
    found = (path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file())
    return {str(path.relative_to(ROOT)) for path in found if "__pycache__" not in path.parts}


def test_a_wheel_has_every_file_of_the_packages_and_no_other(built: tuple[Path, Path]) -> None:
    with zipfile.ZipFile(built[1]) as archive:
        names = set(archive.namelist())
    about = {name for name in names if ".dist-info/" in name}
    assert names - about == files_of(*PACKAGES)
    assert {name.rpartition("/")[2] for name in about} >= {
        "LICENSE",
        "NOTICE",
        "METADATA",
        "entry_points.txt",
    }
    assert built[1].stat().st_size < LARGEST
    assert re.search(r"-py3-none-any\.whl$", built[1].name)


def test_a_source_distribution_has_what_it_takes_and_no_more(built: tuple[Path, Path]) -> None:
    with tarfile.open(built[0]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames() if not archive.getmember(name).isdir()}
    assert names >= files_of(*PACKAGES, "configs", "examples") | {"pyproject.toml", "CHANGELOG.md", "NOTICE"}
    assert not {name for name in names if name.split("/")[0] in ("tests", "docs", "runs", ".ci", "build")}


@pytest.fixture(scope="module")
def installed(built: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a fresh environment with the wheel alone, which borrows the packages it needs from this one."""
    folder = tmp_path_factory.mktemp("clean") / "venv"
    venv.create(folder)
    python = folder / "bin" / "python"
    options = ("--no-deps", "--no-index", "--no-compile", "--quiet")
    run(sys.executable, "-m", "pip", "--python", python, "install", *options, built[1], cwd=folder)
    (packages,) = (folder / "lib").glob("python*/site-packages")
    (packages / "borrowed.pth").write_text(sysconfig.get_paths()["platlib"] + "\n", encoding="utf-8")
    return folder


def test_an_installed_wheel_refines_a_photo(installed: Path, tmp_path: Path) -> None:
    where = run(installed / "bin" / "python", "-c", "import refine; print(refine.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(installed)
    assert {path.name for path in (installed / "bin").glob("refine*")} == {
        "refine",
        "refine-eval",
        "refine-train",
    }
    quick = ("--iters", "2", "--resolution", "64", "--threads", "1", "--engine", "reference", "--no-report")
    run(installed / "bin" / "refine", ROOT / "examples" / "slate.jpg", *quick, cwd=tmp_path)
    record = json.loads((tmp_path / "slate_material" / "slate.json").read_text(encoding="utf-8"))
    assert record["versions"]["svbrdf-refine"] == metadata.version("svbrdf-refine")
    page = tmp_path / "slate.html"
    run(installed / "bin" / "refine", "view", "slate_material", "--html", page, cwd=tmp_path)
    assert "webgl2" in page.read_text(encoding="utf-8")


REQUIREMENT = re.compile(r"^([\w.-]+)(?:\[([\w,.-]+)\])?")


def closure(names: Iterable[tuple[str, str]]) -> Iterator[metadata.Distribution]:
    """Yield the distributions that some, with an extra each, bring along, as this environment has them."""
    queue, seen = list(names), set()
    while queue:
        name, extra = queue.pop()
        key = (re.sub(r"[-_.]+", "-", name).lower(), extra)
        if key in seen:
            continue
        seen.add(key)
        try:
            distribution = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue  # for another system or version of Python
        yield distribution
        for line in distribution.requires or []:
            requirement, _, marker = line.partition(";")
            wanted = re.search(r"extra\s*==\s*['\"]([^'\"]+)", marker)
            if wanted is not None and wanted[1] != extra:
                continue
            found = REQUIREMENT.match(requirement.strip())
            assert found is not None
            queue += [(found[1], more) for more in ["", *(found[2] or "").split(",")]]


def test_exports_bring_nothing_for_cuda_and_nothing_that_is_compiled() -> None:
    brought = {
        one.metadata["Name"].lower(): one
        for one in closure([("svbrdf-refine", ""), ("svbrdf-refine", "export")])
    }
    assert {"torch", "numpy", "kornia", "numba", "materialx", "pygltflib", "usd-core"} <= set(brought)
    of_torch = {one.metadata["Name"].lower() for one in closure([("torch", "")])}
    own = set(brought) - of_torch - {"svbrdf-refine"}
    assert not {name for name in own if re.match(r"nvidia|cuda|cupy|triton", name)}
    for name in own:
        tags = re.findall(r"^Tag: (.*)$", brought[name].read_text("WHEEL") or "", re.MULTILINE)
        # A wheel of PyPI runs on many Linuxes; one that was compiled here says plain "linux".
        assert tags, name
        assert not [tag for tag in tags if re.search(r"-linux_\w+$", tag)], name
