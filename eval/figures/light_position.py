"""Figures about the flash's place: the paper's Fig. 6 (is it found?) and Fig. 12 (does it matter?)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import matplotlib.style
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eval.datasets import CAMERA, INPUT_LIGHT, Scene, input_photo
from eval.development import as_photo
from eval.figures.answers import Answers
from eval.figures.sheet import DPI, FAINT, FONT, PAGE_WIDTH, SMALL, Picture, Sheet, as_seen, grid
from eval.lights import light_errors, off_centre
from eval.metrics import SceneScores, evaluate_material, rendering_rmse
from losses.perceptual import LPIPS
from nets.color import gamma_encode
from nets.render import render
from refine.initialization import initialize
from refine.photo import Photo

ANGLES = (0.0, 10.0, 20.0, 30.0, 35.0, 40.0, 50.0, 60.0)
"""Degrees of the flash off the surface's normal (Fig. 12); 35 is how far the paper calls itself robust."""

DIFFERENCE_GAIN = 4.0
"""Differences are shown this much brighter than they are."""

MAP_COLORS = {"normal": "#1f6f8b", "diffuse": "#c0562b", "roughness": "#5b8c3e", "specular": "#7a4f9a"}
RENDERING_COLORS = {"rendering": "#202020", "lpips": "#c79a1e"}
"""Of the lines of Fig. 12, by what they show."""

BANDS = ((0.0, 15.0), (15.0, 25.0), (25.0, 35.0))
"""Bands of angles that the flashes of Fig. 6 are drawn from, one for each scene in turn."""


def found_lights(answers: Answers, indices: Sequence[int], name: str) -> Sheet:
    """Fig. 6: the photo, beside the true material under the light that a row's network finds.

    Below: the light's angle, error of the direction and of the distance, RMSE of the picture.
    """
    model = answers.refiner(name).model
    lines = []
    for number, index in enumerate(indices):
        scene: Scene = answers.scene(index)
        truth = off_centre(index, BANDS[number % len(BANDS)], answers.yardstick.seed)
        x, y, z = truth.tolist()
        photo, _ = input_photo(scene.truth, (x, y, z))
        with torch.no_grad():
            _, guess = initialize(model, photo)
        again = render(scene.truth, replace(guess, intensity=torch.ones(1, 3)), CAMERA).clamp(max=1.0)
        direction, distance = light_errors(guess.position[0], truth)
        difference = (gamma_encode(again) - gamma_encode(photo)).abs() * DIFFERENCE_GAIN
        off = math.degrees(math.atan2(math.hypot(x, y), z))
        pictures = [
            Picture(as_seen(photo), f"light {off:.0f}° off centre"),
            Picture(as_seen(again), f"{direction:.1f}° off, distance {100 * distance:.0f} % off"),
            Picture(difference, f"RMSE {rendering_rmse(again, photo):.3f}"),
        ]
        lines.append((scene.name, pictures))
    return grid(("photo", "found light", f"difference x {DIFFERENCE_GAIN:g}"), lines)


@dataclass(frozen=True)
class AngleScores:
    """Mean scores of one row on photos lit from one angle."""

    row: str
    angle: float
    scores: SceneScores

    def as_dict(self) -> dict[str, float | str]:
        """Return plain data for JSON."""
        return {"row": self.row, "angle": self.angle, **asdict(self.scores)}


def light_at(angle: float, index: int) -> tuple[float, float, float]:
    """Return a flash as far away as the protocol's, so many degrees off, in the scene's own direction."""
    distance = math.hypot(*INPUT_LIGHT)
    golden = math.pi * (3.0 - math.sqrt(5.0))  # spreads directions evenly however many scenes there are
    sine = math.sin(math.radians(angle))
    return (
        distance * sine * math.cos(golden * index),
        distance * sine * math.sin(golden * index),
        distance * math.cos(math.radians(angle)),
    )


def score_angles(
    answers: Answers, indices: Sequence[int], names: Sequence[str], lpips: LPIPS
) -> list[AngleScores]:
    """Fig. 12: score rows on photos of the same scenes lit from several angles; no row is told from where."""
    found = []
    for name in names:
        row = next(row for row in answers.rows if row.method.name == name)
        refiner, iterations = answers.refiner(name), None if row.method.recipe else 0
        for angle in ANGLES:
            scores = []
            for index in indices:
                scene: Scene = answers.scene(index)
                refined = refiner.fit(_photo(scene, angle, index), iters=iterations)
                scores.append(evaluate_material(refined.svbrdf, scene.truth, scene.lights, lpips=lpips))
            answers.told(f"{name}, {angle:g} degrees")
            found.append(AngleScores(name, angle, SceneScores.mean(scores)))
    return found


def plot_angles(scores: Sequence[AngleScores]) -> Figure:
    """Draw errors of maps (left) and of renderings (right) against the flash's angle."""
    rows = list(dict.fromkeys(score.row for score in scores))
    with matplotlib.style.context("default"):
        figure = Figure(figsize=(PAGE_WIDTH, 2.3), dpi=DPI, facecolor="white", layout="constrained")
        left, right = figure.subplots(1, 2)
        for axes, columns in ((left, MAP_COLORS), (right, RENDERING_COLORS)):
            for column, color in columns.items():
                for row, style in zip(rows, ("-", "--", ":", "-."), strict=False):
                    line = [(s.angle, getattr(s.scores, column)) for s in scores if s.row == row]
                    name = "LPIPS" if column == "lpips" else "RMSE" if column == "rendering" else column
                    label = f"{name}, {row}" if len(rows) > 1 else name
                    axes.plot(*zip(*line, strict=True), style, color=color, linewidth=1.2, label=label)
            _finish(axes)
        left.set_ylabel("RMSE of maps", fontsize=FONT)
        right.set_ylabel("renderings: RMSE and LPIPS", fontsize=FONT)
    return figure


def angle_pictures(answers: Answers, index: int, name: str) -> Sheet:
    """Fig. 12, below: photos lit from several angles, and what is made of them under one novel light."""
    scene: Scene = answers.scene(index)
    light = scene.lights[:1]
    truth = render(scene.truth, light, CAMERA)
    row = next(row for row in answers.rows if row.method.name == name)
    photos, results = [Picture(None)], [Picture(as_seen(truth), "truth")]
    for angle in ANGLES:
        photo = _photo(scene, angle, index)
        refined = answers.refiner(name).fit(photo, iters=None if row.method.recipe else 0)
        rendered = render(refined.svbrdf, light, CAMERA)
        photos.append(Picture(as_seen(photo.linear)))
        results.append(Picture(as_seen(rendered), f"{rendering_rmse(rendered, truth):.3f}"))
    heads = ("", *(f"{angle:g}°" for angle in ANGLES))
    return grid(heads, [("photo", photos), (name, results)])


def _photo(scene: Scene, angle: float, index: int) -> Photo:
    image, _ = input_photo(scene.truth, light_at(angle, index))
    return as_photo(replace(scene, photo=image))


def _finish(axes: Axes) -> None:
    axes.set_xlabel("flash off centre, degrees", fontsize=FONT)
    axes.set_ylim(bottom=0.0)
    axes.tick_params(labelsize=SMALL, colors=FAINT)
    axes.grid(True, color="#e8e8e8", linewidth=0.6)
    axes.legend(fontsize=SMALL, frameon=False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("bottom", "left"):
        axes.spines[side].set_color(FAINT)
