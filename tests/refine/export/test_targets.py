"""From a material to all files of all targets, or none; Blender's script as text."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import pytest

from nets.svbrdf import SVBRDF
from refine.errors import UserError
from refine.export import TARGETS, export_material, targets
from refine.export.blender import blender
from refine.export.bundle import Picture, Source
from refine.export.shading import f0_of_ior

LIGHT = ("blender", "orm", "unity", "height", "tile")
"""Targets that need no package."""


def test_every_file_is_written_and_recorded(material: SVBRDF, tmp_path: Path) -> None:
    record, paths = export_material(material, tmp_path / "out", "stone", LIGHT)
    assert {path.name for path in paths} == {path.name for path in (tmp_path / "out").iterdir()}
    recorded = {file for target in record["targets"].values() for file in target["files"]}
    assert recorded | {"stone_export.json"} == {path.name for path in paths}
    assert json.loads((tmp_path / "out" / "stone_export.json").read_text()) == record


def test_the_same_bytes_twice(material: SVBRDF, tmp_path: Path) -> None:
    folders = tmp_path / "a", tmp_path / "b"
    for folder in folders:
        export_material(material, folder, "stone", LIGHT, tile=True)
    first, second = ({path.name: path.read_bytes() for path in folder.iterdir()} for folder in folders)
    assert first == second


def test_all_files_or_none(material: SVBRDF, tmp_path: Path) -> None:
    (tmp_path / "stone_height.png").mkdir()
    before = sorted(tmp_path.iterdir())
    with pytest.raises(UserError, match="stone_height"):
        export_material(material, tmp_path, "stone", LIGHT)
    assert sorted(tmp_path.iterdir()) == before


def test_what_is_exported_is_not_replaced(material: SVBRDF, tmp_path: Path) -> None:
    kept = tmp_path / "stone_normal.png"
    kept.write_bytes(b"precious")
    with pytest.raises(UserError, match="would replace the result"):
        export_material(material, tmp_path, "stone", ["orm"], keep=[kept])
    assert [path.name for path in tmp_path.iterdir()] == [kept.name]
    export_material(material, tmp_path, "stone", ["orm"])
    assert kept.read_bytes() != b"precious"


@pytest.mark.parametrize(
    ("text", "hint"), [("soup", "'soup' is unknown"), ("orm,soup", "'soup'"), (",", "','")]
)
def test_unknown_targets(text: str, hint: str) -> None:
    with pytest.raises(UserError, match=hint):
        targets.parse_targets("--to", text)


def test_names_are_taken_once_and_in_order() -> None:
    assert targets.parse_targets("--to", " height, orm,height,") == ["height", "orm"]


@pytest.mark.parametrize("name", [name for name, target in TARGETS.items() if target.package])
def test_a_missing_package_is_named_with_its_extra(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(targets, "find_spec", lambda package: None)
    with pytest.raises(UserError, match=rf"{name} needs .*svbrdf-refine\[export\]"):
        targets.parse_targets("--to", name)


def settings(source: Source) -> dict[str, Any]:
    script = blender(source).files[f"{source.stem}_blender.py"]
    assert isinstance(script, str)
    compile(script, "script.py", "exec")
    (found,) = (
        node.value
        for node in ast.parse(script).body
        if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == "SETTINGS"
    )
    assert found is not None
    return dict(ast.literal_eval(found))


def test_blender_script_says_what_it_builds(source: Source, material: SVBRDF) -> None:
    found = settings(source)
    assert found["name"] == source.stem
    assert found["half_size"] == (1.0, 0.75)
    assert f0_of_ior(found["ior"]) == pytest.approx(float(material.specular.max()))
    pictures = blender(source).files
    for name, (file, color_space) in found["pictures"].items():
        picture = pictures[file]
        assert isinstance(picture, Picture)
        assert Path(file).name == file  # beside the script
        assert color_space == ("sRGB" if name in ("base_color", "specular_tint") else "Non-Color")
        assert picture.color == (color_space == "sRGB")
