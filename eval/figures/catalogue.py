"""Which figures there are: of each its number in the paper, what it shows, and how it is made."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from matplotlib.figure import Figure

from eval.datasets import spread
from eval.figures.answers import Answers
from eval.figures.comparisons import maps, real_renderings, renderings, two_rows, worst
from eval.figures.light_position import angle_pictures, found_lights, plot_angles, score_angles
from eval.figures.sheet import draw
from losses.perceptual import LPIPS

COMPARED = ("Des18", "Des19", "Gao19", "Gao19+", "Ours_syn", "Ours_hyb", "Ours_hyb+", "Ours_hyb default")
"""Rows that Fig. 4, 5 and 8 set beside the truth."""

SHOWN = 3
"""Scenes of a comparison, as in the paper; Fig. 10 and 11 show two."""


@dataclass(frozen=True)
class Counts:
    """How many scenes figures look at.

    Attributes:
        angles: whose scores Fig. 12 averages.
        candidates: among which Fig. 13 looks for the worst two.
    """

    angles: int = 8
    candidates: int = 32


QUICK = Counts(angles=1, candidates=4)


@dataclass
class Studio:
    """What figures are made from.

    Attributes:
        synthetic: answers on known materials.
        real: answers on real surfaces; None if there is no such set.
        compared: rows of the comparisons.
        counts: of scenes.
        numbers: figures add what they plot, by name.
        skipped: figures, rows or scenes that are left out, and why.
    """

    synthetic: Answers
    real: Answers | None
    compared: Sequence[str] = COMPARED
    counts: Counts = Counts()
    lpips: LPIPS = field(default_factory=LPIPS, repr=False)
    numbers: dict[str, list[dict[str, float | str]]] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)

    def scenes(self, answers: Answers, count: int) -> list[int]:
        """Return readable scenes, evenly spread; others are recorded."""
        return answers.readable(spread(len(answers.yardstick.scenes()), count), self.skipped)


@dataclass(frozen=True)
class PaperFigure:
    """One figure.

    Attributes:
        number: in the paper.
        caption: what ours shows.
        parts: makers of its pictures by name.
        rows: without which it says nothing.
        real: whether it needs real surfaces.
    """

    number: int
    caption: str
    parts: dict[str, Callable[[Studio], Figure]]
    rows: tuple[str, ...] = ()
    real: bool = False


def _fig4(studio: Studio) -> Figure:
    return draw(maps(studio.synthetic, studio.scenes(studio.synthetic, SHOWN)[-1], studio.compared))


def _fig5(studio: Studio) -> Figure:
    scenes = studio.scenes(studio.synthetic, SHOWN)
    return draw(renderings(studio.synthetic, scenes, studio.compared, studio.lpips))


def _fig6(studio: Studio) -> Figure:
    return draw(found_lights(studio.synthetic, studio.scenes(studio.synthetic, SHOWN), "Ours_hyb"))


def _fig8(studio: Studio) -> Figure:
    assert studio.real is not None
    return draw(
        real_renderings(studio.real, studio.scenes(studio.real, SHOWN), studio.compared, studio.lpips)
    )


def _fig9(studio: Studio) -> Figure:
    assert studio.real is not None
    scenes = studio.scenes(studio.real, SHOWN)
    return draw(two_rows(studio.real, scenes, ("Ours_syn", "Ours_hyb"), studio.lpips))


def _ablation(*rows: str) -> Callable[[Studio], Figure]:
    def make(studio: Studio) -> Figure:
        scenes = studio.scenes(studio.synthetic, SHOWN)[: SHOWN - 1]
        return draw(two_rows(studio.synthetic, scenes, rows, studio.lpips))

    return make


def _fig12_plot(studio: Studio) -> Figure:
    scenes = studio.scenes(studio.synthetic, studio.counts.angles)
    scores = score_angles(studio.synthetic, scenes, ("Ours_hyb",), studio.lpips)
    studio.numbers["fig12"] = [score.as_dict() for score in scores]
    return plot_angles(scores)


def _fig12_pictures(studio: Studio) -> Figure:
    return draw(angle_pictures(studio.synthetic, studio.scenes(studio.synthetic, SHOWN)[0], "Ours_hyb"))


def _fig13(studio: Studio) -> Figure:
    candidates = studio.scenes(studio.synthetic, studio.counts.candidates)
    chosen = worst(studio.synthetic, candidates, "Ours_hyb+", 2, studio.lpips)
    return draw(two_rows(studio.synthetic, chosen, ("Ours_hyb+",), studio.lpips))


_ALL = (
    PaperFigure(
        4, "Maps of one known material, the truth and every row's; below each its RMSE.", {"maps": _fig4}
    ),
    PaperFigure(
        5,
        "Known materials under three lights the photo never saw; below each RMSE / LPIPS.",
        {"renderings": _fig5},
    ),
    PaperFigure(
        6,
        "The photo, and the true material under the light that the network of Ours_hyb finds in it.",
        {"lights": _fig6},
        rows=("Ours_hyb",),
    ),
    PaperFigure(
        8,
        "Real surfaces under the lights of photos that were held out; below each RMSE / LPIPS.",
        {"real": _fig8},
        real=True,
    ),
    PaperFigure(
        9,
        "Trained on synthetic photos alone (Ours_syn) and on real pairs, too (Ours_hyb), on real surfaces.",
        {"hybrid": _fig9},
        rows=("Ours_syn", "Ours_hyb"),
        real=True,
    ),
    PaperFigure(
        10,
        "Trained with L1 terms alone (Ours_l1) and adversarially (Ours_syn).",
        {"adversarial": _ablation("Ours_l1", "Ours_syn")},
        rows=("Ours_l1", "Ours_syn"),
    ),
    PaperFigure(
        11,
        "Trained without the rendering terms (Ours_no_render) and with them (Ours_syn).",
        {"rendering_loss": _ablation("Ours_no_render", "Ours_syn")},
        rows=("Ours_no_render", "Ours_syn"),
    ),
    PaperFigure(
        12,
        "Errors of Ours_hyb against the angle of the photo's flash, which it is not told; below, what it "
        "makes of one material lit from each angle (RMSE of one rendering).",
        {"angles": _fig12_plot, "angle_pictures": _fig12_pictures},
        rows=("Ours_hyb",),
    ),
    PaperFigure(
        13,
        "The two scenes that Ours_hyb+ does worst on by LPIPS.",
        {"worst": _fig13},
        rows=("Ours_hyb+",),
    ),
)

FIGURES: dict[int, PaperFigure] = {figure.number: figure for figure in _ALL}
"""By the paper's number. Fig. 1 to 3 and 7 show its own photos and system."""


def obstacle(figure: PaperFigure, studio: Studio) -> str | None:
    """Return why a figure cannot be made; None if it can."""
    if figure.real and studio.real is None:
        return "it needs real surfaces; give a folder of them with --real-set"
    answers = studio.real if figure.real and studio.real is not None else studio.synthetic
    known = [row.method.name for row in answers.rows]
    missing = [name for name in figure.rows if name not in known]
    return f"no weights for {', '.join(missing)}" if missing else None


def page(made: Sequence[tuple[PaperFigure, Sequence[Path]]], caption: str, skipped: dict[str, str]) -> str:
    """Return the Markdown page that shows the figures, beside which it is kept."""
    lines = ["# Figures", "", caption]
    for figure, files in made:
        lines += ["", f"## Figure {figure.number}", ""]
        lines += [f"![Figure {figure.number}]({file.name})" for file in files]
        lines += ["", figure.caption]
    if skipped:
        lines += ["", "## Left out", "", *(f"- {name}: {reason}" for name, reason in skipped.items())]
    return "\n".join(lines) + "\n"


def as_json(studio: Studio, caption: str) -> str:
    """Return the numbers that figures plot."""
    content = {"caption": caption, "skipped": studio.skipped, **studio.numbers}
    return json.dumps(content, indent=1, sort_keys=True) + "\n"
