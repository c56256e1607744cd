"""Scoring of real photos: what passes, what is skipped, what is printed."""

import dataclasses
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from typer.testing import CliRunner

from eval.cli import main
from eval.console import BAD_USAGE, INCOMPLETE
from eval.photos import PhotoScore, find_photos, photos_markdown, score_photos
from nets.render import PointLight
from nets.svbrdf import SVBRDF
from refine.refiner import Refiner


def guess(photo: torch.Tensor) -> tuple[SVBRDF, PointLight]:
    return SVBRDF.constant(*photo.shape[-2:], diffuse=0.3), PointLight.at((0.0, 0.0, 2.14))


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    pixels = np.random.default_rng(0).integers(40, 160, (32, 48, 3)).astype(np.uint8)
    path = tmp_path / "wall.png"
    assert oiio.ImageBuf(pixels).write(str(path))
    return path


def test_a_refined_photo_passes(photo: Path) -> None:
    (score,) = score_photos(Refiner(guess, resolution=None), [photo], iters=300)
    assert score.name == f"{photo.parent.name}/wall.png"
    assert score.legal
    assert score.passed
    assert score.refined < 0.5 * score.initialization


def test_without_iterations_nothing_is_halved(photo: Path) -> None:
    (score,) = score_photos(Refiner(guess, resolution=None), [photo], iters=0)
    assert score.refined == score.initialization > 0.0
    assert not score.passed


def test_unreadable_photos_are_named_and_left_out(photo: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.png"
    broken.write_text("no picture")
    skipped: dict[Path, str] = {}
    scores = list(
        score_photos(Refiner(guess, resolution=None), find_photos([tmp_path]), 0, skipped.__setitem__)
    )
    assert [score.name for score in scores] == [f"{tmp_path.name}/wall.png"]
    assert list(skipped) == [broken]
    assert "broken.png" in skipped[broken]


def test_the_table_puts_the_worst_first_and_counts() -> None:
    good = PhotoScore("a/good.png", 0.1, 0.01, True, (0.0, 0.0, 2.0), 1.0)
    bad = dataclasses.replace(good, name="a/bad.png", refined=0.09)
    broken = dataclasses.replace(good, name="a/broken.png", legal=False)
    table = photos_markdown([good, bad, broken])
    assert table.startswith("1 of 3 photos pass")
    assert table.index("bad.png") < table.index("good.png")
    assert "NO" in table


@pytest.mark.parametrize(
    ("arguments", "code"),
    [(["photos", "nowhere"], BAD_USAGE), (["photos", "{}", "--part", "3/2"], BAD_USAGE)],
)
def test_mistakes(arguments: list[str], code: int, tmp_path: Path) -> None:
    result = CliRunner().invoke(main, [argument.format(tmp_path) for argument in arguments])
    assert result.exit_code == code
    assert code != INCOMPLETE
