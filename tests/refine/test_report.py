"""The report sheet, and the JSON beside it: pixel for pixel, the same twice, and not upset by odd results."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from torch import Tensor

from nets.color import linear_to_srgb
from nets.render import PointLight
from nets.svbrdf import SVBRDF
from refine import Refined, Refiner
from refine.errors import UserError
from refine.fidelity import rerendering_rmse
from refine.report import sheet
from refine.report.sheet import write_sheet
from refine.result import Output, to_json
from tests.helpers import seeded


def constant(photo: Tensor) -> tuple[SVBRDF, PointLight]:
    return SVBRDF.constant(*photo.shape[-2:], diffuse=0.2), PointLight.at((0.1, 0.2, 2.0))


def refined(height: int, width: int, *, brightness: float = 0.6, iters: int = 3) -> Refined:
    photo = torch.rand(3, height, width, generator=seeded(1)) * 0.3 + brightness
    return Refiner(constant).fit(photo.clamp(max=1.0), iters=iters)


def read(path: Path) -> np.ndarray:
    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.UINT8))


@pytest.mark.parametrize(("height", "width"), [(128, 256), (256, 90)])
def test_pictures_are_drawn_pixel_for_pixel(height: int, width: int, tmp_path: Path) -> None:
    result = refined(height, width)
    write_sheet(tmp_path / "report.png", result)
    slot = max(width, sheet.SMALLEST_SLOT[0]), max(height, sheet.SMALLEST_SLOT[1])
    left = sheet.MARGIN + 2 * (slot[0] + sheet.GAP)  # the third picture: the refined re-rendering
    top = sheet.MARGIN + sheet.HEADER + slot[1] - height
    found = read(tmp_path / "report.png")[top : top + height, left : left + width, :3]
    expected = (linear_to_srgb(result.render().clamp(0.0, 1.0))[0].permute(1, 2, 0) * 255.0).round().numpy()
    assert np.abs(found.astype(float) - expected).max() <= 1.0


def test_every_photo_of_a_surface_has_a_row_under_its_own_light(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sheet, "FURTHER_PHOTOS", 2)
    result = refined(160, 256)
    other = torch.rand(1, 3, 160, 256, generator=seeded(2))
    lights = [PointLight.at((x, 0.0, 2.0)) for x in (0.8, -0.8, 0.3)]
    result = replace(
        result,
        others=tuple(
            replace(result.capture, photo=other * (1 - k / 9), light=light) for k, light in enumerate(lights)
        ),
    )
    write_sheet(tmp_path / "report.png", result)
    whole = read(tmp_path / "report.png")
    step = 160 + sheet.CAPTION + sheet.GAP
    first = sheet.MARGIN + sheet.HEADER + sheet.ROWS * step
    assert whole.shape[0] == first + 2 * step - sheet.GAP + sheet.MARGIN  # two rows, for two were asked for
    for row, capture in enumerate(result.others[:2]):
        top = first + row * step
        pictures = capture.photo, result.render(capture.light)
        for column, linear in zip((0, 2), pictures, strict=True):
            left = sheet.MARGIN + column * (256 + sheet.GAP)
            found = whole[top : top + 160, left : left + 256, :3].astype(float)
            expected = (linear_to_srgb(linear.clamp(0.0, 1.0))[0].permute(1, 2, 0) * 255.0).round().numpy()
            agree = np.abs(found - expected).max(axis=-1) <= 1.0
            assert agree.mean() > (0.98 if column == 0 else 0.9999)  # a ring marks the light in the photo


def test_the_same_result_gives_the_same_bytes(tmp_path: Path) -> None:
    result = refined(40, 64)
    write_sheet(tmp_path / "a.png", result)
    write_sheet(tmp_path / "b.png", result)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert b"Software" not in (tmp_path / "a.png").read_bytes()


@pytest.mark.parametrize(
    ("size", "brightness", "iters"),
    [((32, 32), 1.0, 2), ((32, 32), 0.5, 0), ((32, 32), 0.5, 1), ((16, 250), 0.5, 2), ((250, 16), 0.5, 2)],
    ids=["all saturated", "not refined", "a stage without iterations", "very wide", "very high"],
)
def test_odd_results_are_drawn_too(
    size: tuple[int, int], brightness: float, iters: int, tmp_path: Path
) -> None:
    write_sheet(tmp_path / "report.png", refined(*size, brightness=brightness, iters=iters))
    assert read(tmp_path / "report.png").shape[0] > 500


def test_the_error_counts_unsaturated_pixels_only() -> None:
    result = refined(32, 32)
    exact = result.capture.photo.clone()
    assert rerendering_rmse(exact, result.capture) == 0.0
    exact[:, :, 3, 4] = 0.0
    assert (rerendering_rmse(exact, result.capture) or 0.0) > 0.0
    assert rerendering_rmse(exact, refined(32, 32, brightness=1.0).capture) is None


def test_json_keeps_lists_of_numbers_on_one_line_and_text_as_it_is() -> None:
    record = {
        "curve": [1.5, -2e-07, 3],
        "notes": ["a, b", "[\n 1,\n 2\n]"],
        "deep": [[1], [2, 3]],
        "none": [],
    }
    text = to_json(record)
    assert json.loads(text) == record
    assert '"curve": [1.5, -2e-07, 3]' in text
    with pytest.raises(ValueError, match="not JSON compliant"):
        to_json({"loss": float("nan")})


def test_asking_whether_files_can_be_written_leaves_nothing(tmp_path: Path) -> None:
    Output(tmp_path / "new" / "deep", "x").require_writable(tmp_path / "photo.png")
    assert list(tmp_path.iterdir()) == []
    photo = tmp_path / "x.json"
    photo.write_text("a photo")
    with pytest.raises(UserError, match="replace the photo"):
        Output(tmp_path, "x").require_writable(photo)
