"""`refine a.png b.png c.png --one-surface` as a person runs it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import refine.cli
from nets.color import linear_to_srgb
from nets.data.pool_format import from_planes
from nets.data.procedural import generate
from nets.render import Camera, PointLight, render
from tests.e2e.pictures import save_picture

POSITIONS = [[0.0, 0.1, 3.0], [0.9, 0.1, 2.9], [-0.8, -0.2, 3.1]]
QUICK = ("--resolution", "64", "--threads", "1", "--iters", "4")


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return three photos of leather, in register."""
    folder = tmp_path_factory.mktemp("photos")
    material = from_planes(generate("leather", 64, 3)).validate()
    lights = PointLight(torch.tensor(POSITIONS), torch.ones(3, 3), "inverse_square")
    material = material.map(lambda tensor: tensor[..., :16])  # the fewer pixels, the faster
    encoded = linear_to_srgb(render(material, lights, Camera("collocated")).clamp(max=1.0))
    pictures = encoded.permute(0, 2, 3, 1).numpy()
    return [
        str(save_picture(folder / f"{n:02d}.png", np.ascontiguousarray(p))) for n, p in enumerate(pictures)
    ]


def run(checkpoint: Path, *arguments: str) -> int:
    return refine.cli.run([*arguments, "--init", str(checkpoint), *QUICK])


def test_one_folder_with_every_photo_s_light(
    photos: list[str], checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(checkpoint, *photos, "--one-surface") == 0
    assert [path.name for path in tmp_path.iterdir()] == ["00_material"]
    record = json.loads((tmp_path / "00_material/00.json").read_text())
    assert record["camera"]["kind"] == "collocated"
    entries = [record, *record["others"]]
    assert [entry["source"] for entry in record["others"]] == photos[1:]
    for entry in entries:
        assert entry["light"]["falloff"] == "inverse_square"
        assert entry["light"]["position"][2] > 0.0
        assert entry["light"]["intensity"][0] > 0.0
        assert entry["rmse"]["refined"] is not None
    assert len({tuple(entry["light"]["position"]) for entry in entries}) == 3
    assert len({entry["sha256"] for entry in record["others"]}) == 2
    assert "lights" in record["seconds"]
    assert (tmp_path / "00_material/00_report.png").is_file()


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_known_lights_are_kept(kind: str, photos: list[str], checkpoint: Path, tmp_path: Path) -> None:
    if kind == "file":
        source = tmp_path / "lights.json"
        source.write_text(json.dumps({"positions": POSITIONS}))
    else:
        source = Path(photos[0]).parent
        width = 0.5  # of which the surface's longer side, 2, is four times as much
        (source / "calib.json").write_text(json.dumps({"camera_pos": POSITIONS, "im_size": width}))
    out = tmp_path / "out"
    options = ("--one-surface", "--no-report", "--lights", str(source), "--out", str(out))
    assert run(checkpoint, *photos, *options) == 0
    record = json.loads((out / "00.json").read_text())
    found = [entry["light"]["position"] for entry in (record, *record["others"])]
    assert np.allclose(found, POSITIONS, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "hint"),
    [
        ([], "--one-surface"),
        (["--one-surface", "--light", "0,0,2"], "--lights"),
        (["--one-surface", "--lights", "none.json"], "none.json cannot be read"),
        (["--one-surface", "--lights", "none.json", "--align"], "leave out --align"),
        (["--one-surface", "--lights", "none.json", "--falloff", "auto"], "name the falloff"),
        (["--one-surface", "--align"], "too small to be aligned"),
    ],
)
def test_mistakes_end_in_one_sentence(
    options: list[str],
    hint: str,
    photos: list[str],
    checkpoint: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert refine.cli.run([*photos, "--init", str(checkpoint), *QUICK, *options]) == 2
    error = capsys.readouterr().err
    assert hint in error
    assert len(error.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_several_options_are_of_several_photos(
    photos: list[str], checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for options, hint in ((["--one-surface"], "two or more"), (["--align"], "say --one-surface, too")):
        assert run(checkpoint, photos[0], *options) == 2
        assert hint in capsys.readouterr().err
