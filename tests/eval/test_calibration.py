"""The table of found lights, on a scene that is rendered here."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from eval.calibration import calibration_markdown, evaluate_calibration, measured_scenes
from nets.color import linear_to_srgb
from nets.data.images import DataError
from nets.data.pool_format import from_planes
from nets.data.procedural import generate
from nets.render import Camera, PointLight, render
from refine.errors import UserError
from tests.e2e.pictures import save_picture

POSITIONS = [[0.0, 0.0, 4.0], [1.0, 0.0, 3.0]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a measured scene, an estimated one and one without lights."""
    material = from_planes(generate("leather", 64, 3)).validate()
    lights = PointLight(torch.tensor(POSITIONS), torch.ones(2, 3), "inverse_square")
    encoded = linear_to_srgb(render(material, lights, Camera("collocated")).clamp(max=1.0))
    for name, file in (("measured", "calib.json"), ("estimated", "calib_fitted.json"), ("unknown", None)):
        scene = tmp_path / name
        scene.mkdir()
        for number, picture in enumerate(encoded.permute(0, 2, 3, 1).numpy()):
            save_picture(scene / f"{number:02d}.png", np.ascontiguousarray(picture))
        if file:
            (scene / file).write_text(json.dumps({"camera_pos": POSITIONS, "im_size": 2.0}))
    return tmp_path


def knowing(photos: Sequence[Path]) -> Tensor:
    """Answer with lights that are off by known amounts."""
    assert [photo.name for photo in photos] == ["00.png", "01.png"]
    return torch.tensor([[0.0, 0.2, 4.0], [1.0, 0.0, 3.6]])


def refusing(photos: Sequence[Path]) -> Tensor:
    raise UserError("The photos are of no use.")


def test_only_measured_scenes_count(folder: Path) -> None:
    assert [scene.name for scene in measured_scenes(folder)] == ["measured"]
    with pytest.raises(DataError, match="no scene whose lights were measured"):
        measured_scenes(folder / "measured")
    with pytest.raises(DataError, match="is not a folder"):
        measured_scenes(folder / "nothing")


def test_errors_are_shares_of_the_distance(folder: Path) -> None:
    results = evaluate_calibration(knowing, measured_scenes(folder))
    first, second = results.scored
    assert (first.distance, first.error) == pytest.approx((4.0, 0.05))
    assert (first.sideways_error, first.height_ratio) == pytest.approx((0.05, 1.0))
    assert second.error == pytest.approx(0.6 / 10**0.5, rel=1e-5)
    assert second.height_ratio == pytest.approx(1.2)
    (row,) = results.rows()
    assert (row["lights"], row["within"]) == (2, 1)
    assert row["height_ratio"] == pytest.approx(1.2**0.5)
    table = calibration_markdown(results)
    assert "| measured | 2 | 1 | 12.0 | 19.0 |" in table
    assert "| measured | 00.png | 4.00 | 5.0 |" in table


def test_scenes_that_cannot_be_used_are_named(folder: Path) -> None:
    results = evaluate_calibration(refusing, measured_scenes(folder))
    assert results.skipped == {"measured": "The photos are of no use."}
    assert "The photos are of no use." in calibration_markdown(results)
