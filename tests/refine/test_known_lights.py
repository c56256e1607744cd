"""Positions from files: what is read, and what is said of files that cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from refine.errors import UserError
from refine.known_lights import read_lights
from tests.e2e.pictures import flash_photo, save_picture

POSITIONS = [[0.1, -0.2, 2.0], [0.5, 0.0, 2.5]]
PHOTOS = (Path("a.png"), Path("b.png"))


def written(folder: Path, content: object) -> Path:
    path = folder / "lights.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_a_file_of_positions(tmp_path: Path) -> None:
    found = read_lights(written(tmp_path, {"positions": POSITIONS}), PHOTOS, "inverse_square")
    assert torch.equal(found.position, torch.tensor(POSITIONS))
    assert torch.equal(found.intensity, torch.ones(2, 3))
    assert found.falloff == "inverse_square"


def test_a_scene_knows_its_photos_by_name(tmp_path: Path) -> None:
    photos = [save_picture(tmp_path / f"{n:02d}.png", flash_photo(16, 16)) for n in range(3)]
    camera = [[1.0, 0.0, 20.0], [0.0, 2.0, 21.0], [-1.0, -1.0, 19.0]]
    (tmp_path / "calib.json").write_text(json.dumps({"camera_pos": camera, "im_size": 10.0}))
    found = read_lights(tmp_path, [photos[2], photos[0]], "none")
    # The surface is 10 cm wide and spans -1 to 1.
    assert torch.allclose(found.position, torch.tensor([camera[2], camera[0]]) / 5.0)
    with pytest.raises(UserError, match=r"knows no light of a\.png"):
        read_lights(tmp_path, [photos[0], Path("a.png")], "none")


@pytest.mark.parametrize(
    ("content", "hint"),
    [
        ("soup", "does not hold lights; write"),
        ({"lights": POSITIONS}, "does not hold lights; write"),
        ([1, 2], "does not hold lights; write"),
        ({"positions": [[1, 2], [3]]}, "does not hold lights; write"),
        ({"positions": POSITIONS[:1]}, r"shape \(1, 3\) for 2 photos"),
        ({"positions": [[0, 0, 1], [0, 0, -1]]}, "not in front of the surface"),
        ('{"positions": [[0, 0, 1], [0, NaN, 1]]}', "not in front of the surface"),
    ],
)
def test_other_files_are_refused(content: object, hint: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=hint):
        read_lights(written(tmp_path, content), PHOTOS, "none")


def test_what_is_not_there_or_says_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be read: No such file"):
        read_lights(tmp_path / "none.json", PHOTOS, "none")
    with pytest.raises(UserError, match="no numbered photos; give a JSON file"):
        read_lights(tmp_path, PHOTOS, "none")
    save_picture(tmp_path / "00.png", flash_photo(16, 16))
    with pytest.raises(UserError, match="does not say where its lights were"):
        read_lights(tmp_path, [tmp_path / "00.png"], "none")
