"""Figures from tiny networks on tiny sets: what they show, their numbers, their gaps."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from typer.testing import CliRunner

from eval.cli import main
from eval.console import BAD_USAGE, INCOMPLETE
from eval.datasets import Protocol
from eval.figures.answers import Answers
from eval.figures.catalogue import FIGURES, Studio
from eval.figures.comparisons import maps, renderings, worst
from eval.figures.light_position import ANGLES, found_lights, light_at, score_angles
from eval.figures.sheet import (
    DPI,
    FONT,
    GAP,
    PAGE_WIDTH,
    SMALLEST,
    Picture,
    draw,
    fit,
    grid,
    map_picture,
    write,
)
from eval.methods import choose, find_weights
from eval.metrics import map_rmse
from eval.yardsticks import Synthetic
from losses.perceptual import LPIPS
from tests.eval_files import material, write_strips, write_surface

SIZE = 64
ROWS = ("Ours_l1", "Ours_syn", "Ours_hyb", "Ours_hyb+")


@pytest.fixture(scope="module")
def lpips() -> LPIPS:
    return LPIPS()


@pytest.fixture
def strips(tmp_path: Path) -> Path:
    return write_strips(tmp_path / "tiles", 3)


@pytest.fixture
def answers(strips: Path, tiny: Path) -> Answers:
    rows = find_weights(choose(ROWS), dict.fromkeys(ROWS, str(tiny)))[0]
    return Answers(Synthetic(strips, Protocol(size=SIZE, lights=3)), rows)


def test_maps_have_the_truth_first_and_their_errors_below(answers: Answers) -> None:
    sheet = maps(answers, 1, ("Ours_syn", "Des18"))
    assert sheet.heads == ("truth", "Ours_syn", "Des18")
    assert [line.label for line in sheet.lines] == ["normal", "diffuse", "roughness", "specular"]
    scene, answer = answers.scene(1), answers.of("Ours_syn", 1)
    assert answer is not None
    for line in sheet.lines:
        truth, ours, gap = line.pictures
        assert torch.equal(truth.image, map_picture(scene.truth, line.label))
        assert ours.below == f"{float(map_rmse(answer.svbrdf, scene.truth)[line.label]):.3f}"
        assert gap == Picture(None, "no weights")


def test_rows_answer_once_and_refined_rows_differ(answers: Answers) -> None:
    told = []
    answers.told = told.append
    first, refined = answers.of("Ours_hyb", 0), answers.of("Ours_hyb+", 0)
    assert answers.of("Ours_hyb", 0) is first
    assert told == ["Ours_hyb, scene_0", "Ours_hyb+, scene_0"]
    assert first is not None
    assert refined is not None
    assert torch.equal(first.svbrdf.diffuse, refined.initial.diffuse)
    assert not torch.equal(first.svbrdf.diffuse, refined.svbrdf.diffuse)


def test_the_truth_under_its_own_lights_has_no_error(answers: Answers, lpips: LPIPS) -> None:
    answer = answers.of("Ours_syn", 0)
    assert answer is not None
    answers._found["Ours_syn", 0] = replace(answer, svbrdf=answers.scene(0).truth)
    sheet = renderings(answers, [0], ("Ours_syn",), lpips)
    assert {line.pictures[2].below for line in sheet.lines} == {"0.000 / 0.000"}
    assert [line.pictures[0].image is not None for line in sheet.lines] == [True, False, False]


def test_the_worst_scenes_come_first(answers: Answers, lpips: LPIPS) -> None:
    order = worst(answers, [0, 1, 2], "Ours_hyb", 3, lpips)
    scores = [
        answers.yardstick.score(answers.scene(i), answers.of("Ours_hyb", i), lpips)["lpips"] for i in order
    ]
    assert scores == sorted(scores, reverse=True)
    assert worst(answers, [0, 1, 2], "Ours_hyb", 1, lpips) == order[:1]


def test_lights_stand_at_their_angle_and_distance() -> None:
    for index, angle in enumerate(ANGLES):
        x, y, z = light_at(angle, index)
        assert math.hypot(x, y, z) == pytest.approx(math.hypot(*light_at(0.0, 0)))
        assert math.degrees(math.atan2(math.hypot(x, y), z)) == pytest.approx(angle, abs=1e-9)


def test_a_light_that_is_found_leaves_no_difference(answers: Answers, monkeypatch) -> None:
    from eval.figures import light_position
    from eval.lights import off_centre
    from nets.render import PointLight

    where = off_centre(0, light_position.BANDS[0], answers.yardstick.seed)
    monkeypatch.setattr(
        light_position, "initialize", lambda model, photo: (None, PointLight.at(tuple(where.tolist())))
    )
    (line,) = found_lights(answers, [0], "Ours_hyb").lines
    assert line.pictures[1].below == "0.0° off, distance 0 % off"
    assert line.pictures[2].below == "RMSE 0.000"
    assert float(line.pictures[2].image.max()) < 1e-3


def test_errors_against_the_angle(answers: Answers, lpips: LPIPS, monkeypatch) -> None:
    monkeypatch.setattr("eval.figures.light_position.ANGLES", (0.0, 60.0))
    scores = score_angles(answers, [0], ("Ours_hyb",), lpips)
    assert [(s.row, s.angle) for s in scores] == [("Ours_hyb", 0.0), ("Ours_hyb", 60.0)]
    assert scores[0].scores != scores[1].scores  # another photo, another answer
    assert scores[0].as_dict()["angle"] == 0.0


def test_sheets_fit_a_page_and_gaps_are_seen(tmp_path: Path) -> None:
    image = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    sheet = grid(["a"] * 9, [("row", [Picture(image, "0.1")] * 8 + [Picture(None, "no weights")])])
    write(draw(sheet), tmp_path / "sheet.png")
    pixels = oiio.ImageBuf(str(tmp_path / "sheet.png")).get_pixels(oiio.UINT8)[..., :3]
    assert pixels.shape[1] == round(PAGE_WIDTH * DPI)
    middle = pixels[pixels.shape[0] // 3, :]
    assert (middle[-20] == 0xEC).all()  # the gap's grey
    first = (tmp_path / "sheet.png").read_bytes()
    write(draw(sheet), tmp_path / "sheet.png")
    assert (tmp_path / "sheet.png").read_bytes() == first
    with pytest.raises(ValueError, match="1 pictures for 2 columns"):
        grid(["a", "b"], [("row", [Picture(None)])])
    with pytest.raises(ValueError, match="cannot be written as 'soup'"):
        write(draw(sheet), tmp_path / "sheet.soup")
    assert not np.array_equal(pixels[5], pixels[40])


def drawn_texts(figure: Figure) -> dict[str, Bbox]:
    """Return where a figure's texts are, as shares of its width and height."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    to_shares = figure.transFigure.inverted()
    return {text.get_text(): text.get_window_extent(renderer).transformed(to_shares) for text in figure.texts}


def test_long_texts_stay_above_below_and_beside_their_pictures() -> None:
    image = torch.zeros(1, 3, 8, 8)
    heads = [f"Ours_hyb_{number} default" for number in range(9)]
    below = [f"{number}_mosaic_tile_of_{number}" for number in range(9)]
    pictures = [Picture(image, text) for text in below]
    found = drawn_texts(draw(grid(heads, [("a_name_that_is_far_too_long", pictures)])))
    assert len(found) == 19
    for text, box in found.items():
        assert 0.0 <= box.x0 < box.x1 <= 1.0, text
        assert 0.0 <= box.y0 < box.y1 <= 1.0, text
    for part in ("_hyb", "_mosaic"):
        boxes = [box for text, box in found.items() if part in text]
        assert len(boxes) == 9
        for first, second in pairwise(sorted(boxes, key=lambda box: box.x0)):
            assert first.x1 < second.x0


def test_texts_are_broken_then_made_smaller_then_cut() -> None:
    assert fit("short", 1.0, FONT) == ("short", FONT)
    assert fit("Ours_hyb default", 0.7, FONT, broken=True) == ("Ours_hyb\ndefault", FONT)
    text, size = fit("a_wide_name", 0.5, FONT)
    assert text == "a_wide_name"
    assert SMALLEST <= size < FONT
    text, size = fit("a_name_that_is_far_too_wide", 0.5, FONT)
    assert text.startswith("a_name")
    assert text.endswith("…")
    assert size == SMALLEST
    assert fit("", 0.5, FONT) == ("", FONT)


def test_groups_are_set_apart() -> None:
    lines = [("a", [Picture(torch.zeros(1, 3, 8, 8))])] * 4
    together, apart = draw(grid(["x"], lines)), draw(grid(["x"], lines, begins=(0, 2)))
    assert apart.get_figheight() - together.get_figheight() == pytest.approx(GAP)
    tops = [axes.get_position().y0 * apart.get_figheight() for axes in apart.axes]
    first, second, third = (above - below for above, below in pairwise(tops))
    assert first == pytest.approx(third)
    assert second == pytest.approx(first + GAP)


def test_rows_are_compared_in_the_order_asked_for(run, monkeypatch) -> None:
    seen = []
    monkeypatch.setattr("eval.figures_cli.Studio", lambda *given: seen.append(given[2]) or Studio(*given))
    run("--only", "8", "--rows", "Ours_hyb+,Ours_l1,Ours_hyb+")
    assert seen == [["Ours_hyb+", "Ours_l1"]]


@pytest.fixture
def run(tmp_path: Path, tiny: Path, strips: Path):
    def invoke(*arguments: str):
        inits = [part for row in ROWS for part in ("--init", f"{row}={tiny}")]
        base = ["figures", "--set", str(strips), "--size", str(SIZE), "--out", str(tmp_path / "out")]
        few = ["--no-flips", "--threads", "1", "--rows", "Ours_hyb"]  # others have shipped, large weights
        return CliRunner().invoke(main, [*base, *inits, *few, *arguments])

    return invoke


def test_all_figures_of_the_command(run, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("eval.figures.light_position.ANGLES", (0.0, 40.0))
    for seed in range(2):
        write_surface(tmp_path / "real" / f"surface_{seed}", material(seed), "calib.json")
    nothing = ["--init", f"Ours_no_render={tmp_path / 'nothing.safetensors'}"]
    result = run("--real-set", str(tmp_path / "real"), "--quick", "--rows", "Ours_hyb,Ours_hyb+", *nothing)
    assert result.exit_code == INCOMPLETE, result.output
    assert "Figure 11: no weights for Ours_no_render" in result.output
    out = tmp_path / "out"
    made = {int(path.name[3:5]) for path in out.glob("fig*.png")}
    assert made == set(FIGURES) - {11}
    page = (out / "figures.md").read_text()
    assert all(path.name in page for path in out.glob("*.png"))
    for part in ("tiles", "seed 0", "commit", "narrow", "Figure 11: no weights"):
        assert part in page
    numbers = json.loads((out / "figures.json").read_text())
    assert [entry["angle"] for entry in numbers["fig12"]] == [0.0, 40.0]


def test_without_real_surfaces_two_figures_are_gaps(run, tmp_path: Path) -> None:
    result = run("--only", "8,9")
    assert result.exit_code == INCOMPLETE
    assert "skipped Figure 9: it needs real surfaces; give a folder of them with --real-set" in result.output
    assert [path.name for path in sorted((tmp_path / "out").iterdir())] == ["figures.json", "figures.md"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--only", "7"), "there is no figure 7; there are 4, 5, 6, 8, 9, 10, 11, 12, 13"),
        (("--rows", "Soup"), "no row is called 'Soup'"),
        (("--format", "soup"), "figures cannot be written as 'soup'; choose one of"),
    ],
)
def test_mistakes_are_one_sentence(run, arguments: tuple[str, ...], sentence: str) -> None:
    result = run(*arguments)
    assert result.exit_code == BAD_USAGE
    assert sentence in result.output
