"""The comparison with other renderers, as far as it goes without them; docs/results has what they say."""

from __future__ import annotations

import ast
import inspect
import json
import sys
from pathlib import Path

import pytest
import torch

from eval.benchmarks import browser
from eval.benchmarks import exports as benchmark
from eval.benchmarks.exports import (
    Comparison,
    compare,
    cycles,
    main,
    materials,
    render_in_cycles,
    table,
    three_js,
)
from nets.render import PointLight, render
from nets.svbrdf import SVBRDF
from refine.errors import UserError
from tests.helpers import random_svbrdf


def stand_in(tmp_path: Path, body: str) -> str:
    """Return a program that takes the place of Blender's interpreter."""
    path = tmp_path / "interpreter"
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)
    return str(path)


def test_an_interpreter_without_blender_is_named(tmp_path: Path) -> None:
    broken = stand_in(tmp_path, "echo 'No module named bpy' >&2; exit 1")
    with pytest.raises(UserError, match="No module named bpy; give an interpreter with bpy"):
        cycles(broken, 1)(SVBRDF.constant(8, 8), tmp_path / "out")


def test_a_browser_that_cannot_be_used_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygltflib", reason="needs the extra [export]")
    with pytest.raises(UserError, match="npm pack three"):
        three_js(tmp_path, "chromium")(SVBRDF.constant(8, 8), tmp_path / "out")
    package = tmp_path / "package"
    (package / "build").mkdir(parents=True)
    (package / "build" / "three.module.js").touch()
    with pytest.raises(UserError, match="cannot be started"):
        three_js(package, str(tmp_path / "nothing"))(SVBRDF.constant(8, 8), tmp_path / "out")
    monkeypatch.setattr(browser, "PATIENCE", 0.1)
    with pytest.raises(UserError, match="no answer"):
        three_js(package, stand_in(tmp_path, "exit 0"))(SVBRDF.constant(8, 8), tmp_path / "out")


def test_pixels_come_back_from_a_page(tmp_path: Path) -> None:
    """A program in the place of the browser posts known pixels: channels, rows and lights are told apart."""
    pytest.importorskip("pygltflib", reason="needs the extra [export]")
    package = tmp_path / "package"
    (package / "build").mkdir(parents=True)
    (package / "build" / "three.module.js").touch()
    poster = tmp_path / "poster.py"
    poster.write_text(
        "import sys, urllib.request, numpy as np\n"
        "base = sys.argv[-1].rsplit('/', 1)[0]\n"
        "assert b'GLTFLoader' in urllib.request.urlopen(sys.argv[-1]).read()\n"
        "assert urllib.request.urlopen(base + '/material.glb').read(4) == b'glTF'\n"
        "pixels = np.arange(4 * 6 * 4, dtype='<f4').tobytes()\n"
        "post = lambda path, body: urllib.request.urlopen(urllib.request.Request(base + path, body))\n"
        "[post('/light/' + name, pixels) for name in ('flash', 'oblique')]\n"
        "post('/done', b'')\n"
    )
    program = stand_in(tmp_path, f'exec {sys.executable} {poster} "$@"')
    found = three_js(package, program)(SVBRDF.constant(4, 6), tmp_path / "out")
    assert set(found) == set(benchmark.LIGHTS)
    expected = torch.arange(4 * 6 * 4).reshape(4, 6, 4).flip(0)[..., :3].movedim(-1, 0)[None]
    torch.testing.assert_close(found["flash"], expected.float())


def test_what_is_compared() -> None:
    """Renderings that are ours differ by nothing; half as bright, by what gamma makes of it."""
    material = random_svbrdf(height=8, width=8)
    lights = {
        name: PointLight.at(position, falloff="inverse_square") for name, position in benchmark.LIGHTS.items()
    }
    ours = {name: render(material, light) for name, light in lights.items()}
    found, picture = compare("Cycles", "plain", material, ours)
    assert [(each.light, each.rmse, each.bias) for each in found] == [(name, 0.0, 0.0) for name in lights]
    assert picture.shape == (3, 8 * len(lights), 16)
    darker = {name: rendering * 0.5 for name, rendering in ours.items()}
    encoded, half = (rendering["flash"].clamp(1e-6, 1.0) ** (1 / 2.2) for rendering in (ours, darker))
    found, _ = compare("Cycles", "plain", material, darker)
    assert found[0].rmse == pytest.approx(float((half - encoded).square().mean().sqrt()), rel=1e-4)
    assert found[0].bias < 0.0


def test_the_driver_stands_alone() -> None:
    """It is sent to another interpreter as text: it must not use what this module imports."""
    tree = ast.parse(inspect.getsource(render_in_cycles))
    (function,) = tree.body
    assert isinstance(function, ast.FunctionDef)
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert {"bpy", "math", "runpy"} <= imported
    used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    theirs = {name for name, value in vars(benchmark).items() if not name.startswith("__")} - imported
    assert not used & theirs - {"Any"}


def test_materials_are_legal() -> None:
    for material in materials(32, []).values():
        assert material.validate().size == (32, 32)


def test_the_command_writes_table_and_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    material = SVBRDF.constant(4, 4)
    black = dict.fromkeys(benchmark.LIGHTS, torch.zeros(1, 3, 4, 4))
    monkeypatch.setattr(benchmark, "cycles", lambda *arguments: lambda svbrdf, folder: black)
    monkeypatch.setattr(benchmark, "materials", lambda size, results: {"plain": material})
    main(["--python", "python", "--out", str(tmp_path / "out")])
    assert capsys.readouterr().out.endswith((tmp_path / "out" / "exports.md").read_text())
    record = json.loads((tmp_path / "out" / "exports.json").read_text())
    assert record["comparisons"][0]["rmse"] > 0.1
    assert (tmp_path / "out" / "plain_Cycles.png").exists()
    measured = Comparison("Cycles", "plain", "flash", 0.0123, -0.001)
    assert table([measured])[-1] == "| plain | Cycles | flash | 0.0123 | -0.0010 |"
    with pytest.raises(SystemExit):
        main([])
