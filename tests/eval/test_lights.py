"""Where the flash was, and how wrong it is to say it was elsewhere."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner

from eval import cli, console
from eval.lights import (
    BANDS,
    LightResults,
    LightScore,
    evaluate_lights,
    light_errors,
    light_estimator,
    lights_markdown,
    off_centre,
)
from nets.render import PointLight, render
from nets.svbrdf import SVBRDF
from refine.refiner import Refiner
from tests.eval_files import material

SIZE = 64


def angle(position: Tensor) -> float:
    return math.degrees(math.acos(float(position[2] / torch.linalg.vector_norm(position))))


@pytest.mark.parametrize("band", BANDS)
def test_lights_are_in_their_band_and_cosine_weighted(band: tuple[float, float]) -> None:
    positions = torch.stack([off_centre(index, band) for index in range(400)])
    angles = [angle(position) for position in positions]
    assert band[0] - 0.05 <= min(angles) <= max(angles) <= band[1] + 0.05
    low, high = (math.sin(math.radians(end)) ** 2 for end in band)
    squared = (positions[:, :2] ** 2).sum(dim=1) / (positions**2).sum(dim=1)
    assert float(((squared - low) / (high - low)).mean()) == pytest.approx(0.5, abs=0.05)
    assert abs(float(positions[:, 0].sign().mean())) < 0.15


def test_distances_are_those_of_training() -> None:
    distances = [float(torch.linalg.vector_norm(off_centre(index, BANDS[0]))) for index in range(400)]
    assert 1.0 - 1e-5 < min(distances) < max(distances) < 8.0 + 1e-5
    # Six tenths log-uniform in 1.2 to 4, the rest log-normal around e, clipped to 1 to 8.
    assert float(np.median(distances)) == pytest.approx(2.35, abs=0.25)


def test_lights_depend_on_index_and_seed_only() -> None:
    assert torch.equal(off_centre(3, BANDS[1]), off_centre(3, BANDS[1]))
    assert not torch.equal(off_centre(3, BANDS[1]), off_centre(4, BANDS[1]))
    assert not torch.equal(off_centre(3, BANDS[1]), off_centre(3, BANDS[1], seed=1))


@pytest.mark.parametrize(
    ("estimate", "direction", "distance"),
    [
        ((0.0, 0.0, 2.0), 0.0, 0.0),
        ((0.0, 0.0, 3.0), 0.0, 0.5),
        ((0.0, 0.0, 1.0), 0.0, 0.5),
        ((2.0, 0.0, 0.0), 90.0, 0.0),
        ((0.0, -2.0, 2.0), 45.0, math.sqrt(2.0) - 1.0),
    ],
)
def test_errors(estimate: tuple[float, ...], direction: float, distance: float) -> None:
    found = light_errors(torch.tensor(estimate), torch.tensor([0.0, 0.0, 2.0]))
    assert found == (pytest.approx(direction, abs=1e-5), pytest.approx(distance, abs=1e-6))


def test_rows_are_medians_and_ninetieths_by_band_and_within_35_degrees() -> None:
    scored = [
        LightScore(
            "a",
            "s",
            str(number),
            where,
            2.0,
            direction_error=float(number),
            distance_error=0.01 * number,
            direction_error_at_height=0.5 * number,
        )
        for number, where in enumerate([1.0, 5.0, 14.9, 15.0, 30.0, 40.0])
    ]
    rows = {tuple(row["angles"]): row for row in LightResults(scored).rows()}
    assert {band: row["photos"] for band, row in rows.items()} == {
        (0.0, 15.0): 3,
        (15.0, 25.0): 1,
        (25.0, 35.0): 1,
        (35.0, 50.0): 1,
        (0.0, 35.0): 5,
    }
    assert rows[0.0, 35.0]["direction_error_median"] == 2.0
    assert rows[0.0, 35.0]["direction_error_90"] == pytest.approx(3.6)
    assert rows[0.0, 15.0]["distance_error_median"] == pytest.approx(0.01)
    assert rows[0.0, 35.0]["direction_error_at_height_median"] == pytest.approx(1.0)


def test_the_light_fit_starts_from_the_head_and_mends_it() -> None:
    truth = material(0, SIZE)
    true_light = torch.tensor([0.6, -0.4, 2.4])

    def head(photo: Tensor) -> tuple[SVBRDF, PointLight]:
        # The material of the photo, but a light that is 12 degrees off.
        whole = truth.map(lambda tensor: torch.nn.functional.interpolate(tensor, size=photo.shape[-2:]))
        return whole, PointLight.at((0.1, -0.4, 2.4))

    photo = render(truth, PointLight(true_light[None], torch.ones(1, 3))).clamp(0.0, 1.0)
    found = light_estimator({"mine": Refiner(head, flips=False)})(photo)
    assert list(found) == ["mine, light head", "mine, fitted"]
    before, after = (light_errors(position, true_light)[0] for position in found.values())
    assert before == pytest.approx(11.6, abs=0.5)
    assert after < 0.3 * before


def test_every_material_is_photographed_once_in_every_band(data: Path) -> None:
    seen = []

    def centred(photo: Tensor) -> dict[str, Tensor]:
        seen.append(photo)
        return {"centred": torch.tensor([0.0, 0.0, 2.0])}

    results = evaluate_lights(centred, data, size=SIZE)
    assert len(results.scored) == len(seen) == 4 * 8
    # Who always says "above the centre" is wrong by the angle itself.
    assert all(one.direction_error == pytest.approx(one.angle, abs=1e-3) for one in results.scored)
    assert all(one.direction_error_at_height == pytest.approx(one.angle, abs=1e-3) for one in results.scored)
    assert all(one.distance_error == pytest.approx(abs(2.0 / one.distance - 1.0)) for one in results.scored)
    assert {row["photos"] for row in results.rows()} == {8, 24}
    assert "| centred | 0-35 | 24 |" in lights_markdown(results)
    assert all(0.0 <= float(photo.min()) <= float(photo.max()) <= 1.0 for photo in seen)


def test_the_command_prints_and_writes_the_table(
    data: Path, tmp_path: Path, no_network: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("eval.lights.fit_light", lambda svbrdf, guess, *rest: guess)  # seconds each
    files = ["--json", str(tmp_path / "t.json"), "--markdown", str(tmp_path / "t.md")]
    chosen = ["--data", str(data), "--size", "64", "--scenes", "1", "--init", "a", "--init", "b"]
    result = CliRunner().invoke(cli.main, ["light", *chosen, *files])
    assert result.exit_code == 0, result.output
    table = (tmp_path / "t.md").read_text(encoding="utf-8")
    assert result.stdout == table
    for part in ("des18_dev", "64 px", "checkpoints a, b", "seed 0", "commit", "| b, fitted | 0-35 | 9 |"):
        assert part in table
    plain = json.loads((tmp_path / "t.json").read_text())
    assert {one["method"] for one in plain["scenes"]} == {
        f"{name}, {how}" for name in "ab" for how in ("light head", "fitted")
    }


def test_missing_data_is_one_sentence_and_exit_2(tmp_path: Path, no_network: None) -> None:
    result = CliRunner().invoke(cli.main, ["light", "--data", str(tmp_path)])
    assert result.exit_code == console.BAD_USAGE
    assert result.stderr.strip().endswith("strips/des18_dev is not a folder")
