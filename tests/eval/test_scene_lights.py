"""Lights of real scenes: solved, written, read again, and used in place of what folders say."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch.nn import functional
from typer.testing import CliRunner

from eval.real_scenes import CAMERA, LARGEST_RESIDUAL, SceneLights, read_real_scene, read_scene_lights
from eval.scene_lights import find_scene_lights, main, scene_lights_markdown, write_scene_lights
from nets.data.images import DataError
from nets.data.photos import read_scene
from nets.render import PointLight
from nets.svbrdf import SVBRDF
from refine.refiner import Refiner
from tests.eval_files import PLACES, WIDTH, material, write_surface

SIZE = 48


def knows(surface: SVBRDF) -> Callable[[torch.Tensor], tuple[SVBRDF, PointLight]]:
    """Return a model that says what the surface is, whatever it is shown."""
    large = surface.map(lambda tensor: functional.interpolate(tensor, (256, 256)))

    def predict(photo: torch.Tensor) -> tuple[SVBRDF, PointLight]:
        return large, PointLight.at((0.0, 0.0, 2.0))

    return predict


def test_measured_positions_are_kept_and_exposures_are_found(tmp_path: Path) -> None:
    surface = material(3, SIZE)
    scene = read_scene(write_surface(tmp_path / "wall", surface, "calib.json"))
    refiner = Refiner(knows(surface), camera=CAMERA, resolution=SIZE)
    found = find_scene_lights(refiner, scene)
    assert found.measured
    assert found.believable
    expected = [[value / (WIDTH / 2.0) for value in place] for place in PLACES]
    assert torch.tensor(found.positions).allclose(torch.tensor(expected), atol=1e-3)
    # The flash had one power: what is left of the intensities is the squared distance.
    squares = [sum(value**2 for value in place) for place in PLACES]
    mean = math.exp(sum(map(math.log, squares)) / len(squares))
    assert found.intensities == pytest.approx([mean / square for square in squares], rel=0.02)


def test_lights_take_the_place_of_the_folders(tmp_path: Path) -> None:
    folder = write_surface(tmp_path / "wall", material(3, SIZE), "calib.json")
    positions = [[0.1 * number, 0.2, 2.0 + number] for number in range(len(PLACES))]
    lights = SceneLights(positions, [0.5, 1.0, 2.0, 4.0], measured=False, residual=0.01)
    scene = read_real_scene(folder, SIZE, lights)
    assert scene.lights_are == "estimated"
    assert Path(scene.photo.source).name == "02.png"  # now the most central
    assert scene.light.position[0].tolist() == pytest.approx(positions[2])
    assert scene.light.intensity[0].tolist() == [1.0, 1.0, 1.0]
    assert scene.held_out_lights.intensity[:, 0].tolist() == pytest.approx([0.25, 0.5, 2.0])
    doubtful = SceneLights(positions, lights.intensities, measured=True, residual=2.0 * LARGEST_RESIDUAL)
    assert read_real_scene(folder, SIZE, doubtful).lights_are == "uncertain"
    with pytest.raises(DataError, match="holds 4 photos, not 3"):
        read_real_scene(folder, SIZE, SceneLights(positions[:3], [1.0] * 3, measured=False, residual=0.0))


def test_the_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    lights = {"wall": SceneLights([[0.0, 0.1, 3.0]], [1.0], measured=True, residual=0.2)}
    file = tmp_path / "lights.json"
    about = {"folder": "scenes", "init": "default", "size": 64}
    write_scene_lights(file, lights, {"floor": "it holds one photo"}, about)
    assert read_scene_lights(file) == lights
    table = scene_lights_markdown(lights, {"floor": "it holds one photo"}, about)
    assert "| wall | measured | no | 1 | 0.200 |" in table
    assert "- floor: it holds one photo" in table


@pytest.mark.parametrize(
    "content", ["", "[]", "{}", '{"scenes": {"wall": 1}}', '{"scenes": {"wall": {"a": 1}}}']
)
def test_anything_else_is_refused(tmp_path: Path, content: str) -> None:
    file = tmp_path / "lights.json"
    file.write_text(content)
    with pytest.raises(DataError, match=r"lights\.json cannot be read as lights of scenes"):
        read_scene_lights(file)
    with pytest.raises(DataError, match="cannot be read"):
        read_scene_lights(tmp_path / "missing.json")


def test_the_command_names_what_it_skips(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    surface = material(3, SIZE)
    write_surface(tmp_path / "scenes" / "wall", surface, "calib.json")
    (tmp_path / "scenes" / "empty").mkdir()
    made = Refiner(knows(surface), camera=CAMERA, resolution=64)
    monkeypatch.setattr("eval.scene_lights.Refiner", lambda *_, **__: made)
    out = tmp_path / "lights.json"
    result = CliRunner().invoke(main, [str(tmp_path / "scenes"), "--out", str(out), "--size", "64"])
    assert result.exit_code == 0, result.output
    assert list(read_scene_lights(out)) == ["wall"]
    assert "empty" in json.loads(out.read_text())["skipped"]
    assert "wall" in out.with_suffix(".md").read_text()
