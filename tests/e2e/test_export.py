"""`refine export`, as a person would run it on what `refine` wrote."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import refine.cli
from nets.svbrdf import MAPS
from refine.maps import map_paths, read_maps
from tests.helpers import assert_close

LIGHT = "blender,orm,height"
"""Targets that need no package."""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory, checkpoint: Path, photo: Path) -> dict[str, Path]:
    """Return folders with one result each, by format, and their stems' photo."""
    made = {}
    for format, normals in (("png8", "directx"), ("png", "opengl"), ("exr", "directx")):
        made[format] = tmp_path_factory.mktemp("results") / format
        arguments = [photo, "--init", checkpoint, "--iters", "0", "--resolution", "64", "--no-report", "-q"]
        arguments += ["--engine", "reference"]
        arguments += ["--out", made[format], "--format", format, "--normals", normals]
        assert refine.cli.run([str(argument) for argument in arguments]) == 0
    return made


def run(*arguments: str | Path) -> int:
    return refine.cli.run(["export", *map(str, arguments)])


def listing(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize("format", ["png8", "png", "exr"])
def test_every_format_of_a_result_can_be_exported(
    results: dict[str, Path], format: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    before = listing(results[format])
    assert run(results[format], "--to", LIGHT, "--out", tmp_path / "new") == 0
    out, err = capfd.readouterr()
    assert out == ""
    assert "orm: 4 files" in err
    assert listing(results[format]) == before
    record = json.loads((tmp_path / "new" / "wall_export.json").read_text())
    assert (record["width"], record["height"]) == (64, 40)
    files = {file for target in record["targets"].values() for file in target["files"]}
    assert files | {"wall_export.json"} == set(listing(tmp_path / "new"))


def test_normals_are_opengl_whatever_the_result_has(results: dict[str, Path], tmp_path: Path) -> None:
    for format in ("png8", "exr"):
        assert run(results[format], "--to", "tile,orm", "--tile", "--out", tmp_path / format, "-q") == 0
    one, other = (read_maps(tmp_path / format, "wall_tile") for format in ("png8", "exr"))
    for name in MAPS:
        assert_close(getattr(one, name), getattr(other, name), atol=0.02)


def test_exports_go_into_the_folder_of_the_result(results: dict[str, Path]) -> None:
    folder = results["png"]
    before = {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    assert run(folder, "--to", "height", "-q") == 0
    assert listing(folder / "export") == ["wall_export.json", "wall_height.png"]
    assert {path: path.read_bytes() for path in before} == before


def test_refine_exports_what_it_wrote(checkpoint: Path, photo: Path, tmp_path: Path) -> None:
    options = ("--iters", "0", "--resolution", "64", "--no-report", "-q", "--out", str(tmp_path / "wall"))
    arguments = [str(photo), "--init", str(checkpoint), *options, "--export", LIGHT]
    assert refine.cli.run(arguments) == 0
    assert "wall_blender.py" in listing(tmp_path / "wall" / "export")
    assert map_paths(tmp_path / "wall", "wall")["normal"].exists()


def test_a_photo_called_export(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The command wins, and says so; with a path in front it is a photo."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "export").touch()
    assert run("nowhere", "--to", "orm") == 2
    told, error = capfd.readouterr().err.splitlines()
    assert "for the photo of that name say refine ./export" in told
    assert "nowhere is not a folder" in error
    assert refine.cli.run(["./export"]) == 2
    assert "export is empty" in capfd.readouterr().err


def no_result(folder: Path) -> None:
    (folder / "wall.json").write_text('{"format": "something else"}')


def several(folder: Path) -> None:
    (folder / "second.json").write_text((folder / "wall.json").read_text())


def without_a_map(folder: Path) -> None:
    (folder / "wall_roughness.png").unlink()


def without_settings(folder: Path) -> None:
    record = json.loads((folder / "wall.json").read_text())
    (folder / "wall.json").write_text(json.dumps({"format": record["format"]}))


def nothing(folder: Path) -> None:
    pass


@pytest.mark.parametrize(
    ("spoil", "arguments", "hint"),
    [
        (nothing, ["--to", "soup"], "materialx, gltf"),
        (nothing, ["--to", "orm", "--format", "gif"], "png8"),
        (nothing, ["--to", "orm", "--name", "hall"], "no hall.json"),
        (nothing, ["--to", "orm", "--out", "."], "would replace the result"),
        (nothing, [], "--to"),
        (no_result, ["--to", "orm"], "a folder that refine wrote"),
        (several, ["--to", "orm"], "--name"),
        (without_a_map, ["--to", "orm"], "wall_roughness"),
        (without_settings, ["--to", "orm"], "run refine on the photo again"),
    ],
)
def test_a_mistake_ends_in_one_sentence_and_leaves_nothing(
    spoil: Callable[[Path], None],
    arguments: list[str],
    hint: str,
    results: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for path in results["png"].iterdir():
        if path.is_file():
            (tmp_path / path.name).write_bytes(path.read_bytes())
    spoil(tmp_path)
    before = listing(tmp_path)
    assert run(".", *arguments) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert hint in err
    assert err.startswith("refine: ")
    assert err.count("\n") == 1
    assert err.endswith(".\n")
    assert listing(tmp_path) == before


def test_a_missing_folder(capfd: pytest.CaptureFixture[str]) -> None:
    assert run("nowhere", "--to", "orm") == 2
    assert "nowhere is not a folder" in capfd.readouterr().err


def test_help_names_every_target_and_waits_for_nothing() -> None:
    program = (
        "import sys; from refine.cli import run; code = run(['export', '--help']);"
        "sys.exit(1 if code or {'torch', 'MaterialX', 'pxr', 'pygltflib'} & set(sys.modules) else 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    for name in ("materialx", "gltf", "usd", "blender", "orm", "unity", "height", "tile"):
        assert name in done.stdout
