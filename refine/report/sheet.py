"""The report: one picture that shows photo, maps, re-renderings, novel lights and the loss of one result.

It is drawn pixel for pixel at 100 %, without times and dates: the same result gives the same bytes.
"""

from __future__ import annotations

import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor
from torch.nn.functional import interpolate

from nets.color import gamma_encode, linear_to_srgb
from nets.render import PointLight
from nets.svbrdf import MAPS, SVBRDF
from refine.bands import render_in_bands
from refine.capture import Capture
from refine.fidelity import rerendering_rmse
from refine.refiner import Refined

DPI = 100
TILE = 256
"""Longer side of every picture on the sheet, pixels."""
SMALLEST_SLOT = (232, 150)
"""Width and height at least reserved for a picture, so that captions and plots stay readable."""
MARGIN, GAP, HEADER, CAPTION, LINE = 20, 14, 44, 38, 15
COLUMNS, ROWS = 5, 4
FURTHER_PHOTOS = 11
"""Most photos besides the first that have a row, at the bottom."""
FONT = 9.0

NOVEL_LIGHTS = ((-0.7, 0.7), (0.7, 0.7), (0.7, -0.7), (-0.7, -0.7))
"""Where the novel lights are, as shares of the half width and half height of the surface."""
NOVEL_HEIGHT = 1.3
DIFFERENCE_GAIN = 4.0
"""Differences and deviations are shown this much brighter than they are."""

INK, FAINT = "#202020", "#707070"
STAGE_COLORS = ("#c0562b", "#1f6f8b", "#5b8c3e", "#7a4f9a", "#a08020", "#404040")


def write_sheet(path: Path | str, refined: Refined, *, uncertainty: bool = False) -> None:
    """Draw the sheet of a result and write it as PNG; the same result gives the same bytes.

    Args:
        path: of the picture.
        refined: the result.
        uncertainty: whether a row shows how well each map is known.
    """
    with matplotlib.style.context("default"):
        figure = draw_sheet(refined, uncertainty=uncertainty)
        FigureCanvasAgg(figure).print_png(str(path), metadata={"Software": None})


def draw_sheet(refined: Refined, *, uncertainty: bool = False) -> Figure:
    """Return the sheet as a figure of `DPI` dots per inch; arguments as `write_sheet`."""
    height, width = refined.svbrdf.size
    further = refined.others[:FURTHER_PHOTOS]
    sheet = _Sheet(height, width, ROWS + uncertainty + len(further))

    sheet.title(Path(refined.source).name, _subtitle(refined))
    _draw_photo(sheet, 0, "photo", refined, replace(refined.capture, light=refined.light))
    for row, (name, material) in enumerate(
        (("initial", refined.initial), ("refined", refined.svbrdf)), start=1
    ):
        for column, map_name in enumerate(MAPS):
            image, fact = _map_picture(material, map_name)
            sheet.picture(row, column, image, f"{name} {map_name}", fact)
    if uncertainty:
        for column, map_name in enumerate(MAPS):
            deviation = refined.deviations[map_name]
            fact = f"mean {float(deviation.mean()):.3f}, drawn x {DIFFERENCE_GAIN:g}"
            sheet.picture(3, column, deviation * DIFFERENCE_GAIN, f"{map_name} deviation", fact)
    last = ROWS - 1 + uncertainty
    for column, position in enumerate(_novel_positions(height, width)):
        novel = PointLight(
            refined.light.position.new_tensor([position]), refined.light.intensity, refined.light.falloff
        )
        sheet.picture(
            last, column, _seen(refined.render(novel)), "novel light", f"at {_numbers(position)}", position
        )
    for number, capture in enumerate(further, start=2):
        _draw_photo(sheet, last + number - 1, f"photo {number}", refined, capture)
    _draw_losses(sheet.plot(1, 2), refined.losses)
    sheet.text(last, _facts(refined))
    return sheet.figure


def _draw_photo(sheet: _Sheet, row: int, name: str, refined: Refined, capture: Capture) -> None:
    # A photo, what both materials look like under its light, and how far that is from it.
    assert capture.light is not None
    photo, light = capture.photo, _point(capture.light)
    height, width = photo.shape[-2:]
    sheet.picture(row, 0, _seen(photo), name, f"{width} x {height}, light at {_numbers(light)}", light)
    for column, (kind, material) in enumerate(
        (("initialization", refined.initial), ("refined", refined.svbrdf)), start=1
    ):
        rendering = render_in_bands(material, capture.light, refined.camera)
        error = rerendering_rmse(rendering, capture)
        sheet.picture(row, column, _seen(rendering), f"{kind}, re-rendered", f"RMSE {_or_dash(error)}")
        difference = (gamma_encode(rendering) - gamma_encode(photo)).abs()
        shown = torch.where(capture.unsaturated, difference * DIFFERENCE_GAIN, 0.0)
        caption = f"|{kind} - {name}| x {DIFFERENCE_GAIN:g}"
        sheet.picture(row, column + 2, shown, caption, "saturated pixels left black")


class _Sheet:
    """A grid of equal slots, laid out in pixels from the top left."""

    def __init__(self, height: int, width: int, rows: int) -> None:
        scale = TILE / max(height, width)
        self.tile = max(1, round(height * scale)), max(1, round(width * scale))
        self.surface = width / max(height, width), height / max(height, width)
        self.slot = max(self.tile[1], SMALLEST_SLOT[0]), max(self.tile[0], SMALLEST_SLOT[1])
        self.width = 2 * MARGIN + COLUMNS * self.slot[0] + (COLUMNS - 1) * GAP
        self.height = 2 * MARGIN + HEADER + rows * (self.slot[1] + CAPTION) + (rows - 1) * GAP
        self.figure = Figure(figsize=(self.width / DPI, self.height / DPI), dpi=DPI, facecolor="white")

    def corner(self, row: int, column: int) -> tuple[int, int]:
        """Left and top of a slot."""
        return (
            MARGIN + column * (self.slot[0] + GAP),
            MARGIN + HEADER + row * (self.slot[1] + CAPTION + GAP),
        )

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        """Return axes that cover a box of pixels."""
        box = (
            left / self.width,
            1.0 - (top + height) / self.height,
            width / self.width,
            height / self.height,
        )
        return self.figure.add_axes(box)

    def words(
        self, left: float, base: float, words: str, size: float = FONT, color: str = INK, **style: Any
    ) -> None:
        """Write one line that begins at a pixel; `base` is its base line."""
        self.figure.text(
            left / self.width,
            1.0 - base / self.height,
            words.replace("$", r"\$"),
            fontsize=size,
            color=color,
            va="baseline",
            ha="left",
            **style,
        )

    def title(self, name: str, subtitle: str) -> None:
        """Write the head line."""
        self.words(MARGIN, MARGIN + 9, _shortened(name, 90), 13.0, fontweight="bold")
        self.words(MARGIN, MARGIN + 30, subtitle, color=FAINT)

    def picture(
        self,
        row: int,
        column: int,
        image: Float[Tensor, "1 channels h w"],
        caption: str,
        fact: str,
        light: tuple[float, float, float] | None = None,
    ) -> None:
        """Show display values in [0, 1] with two lines below, and mark where a light hangs."""
        left, top = self.corner(row, column)
        height, width = self.tile
        top += self.slot[1] - height
        axes = self.axes(left, top, width, height)
        axes.imshow(_pixels(image, self.tile), interpolation="nearest", aspect="auto")
        axes.set_axis_off()
        if light is not None:
            _mark(axes, light, self.tile)
        self.words(left, top + height + 15, caption, fontweight="bold")
        self.words(left, top + height + 30, fact, color=FAINT)

    def plot(self, first: int, last: int) -> Axes:
        """Return axes over the last column's slots of some rows."""
        left, top = self.corner(first, COLUMNS - 1)
        bottom = self.corner(last, COLUMNS - 1)[1] + self.slot[1]
        return self.axes(left + 44, top + 20, self.slot[0] - 50, bottom - top - 24)

    def text(self, row: int, lines: list[str]) -> None:
        """Write paragraphs into the last column's slot of a row, as many lines as fit."""
        left, top = self.corner(row, COLUMNS - 1)
        width = int(self.slot[0] / 6.3)
        wrapped = [part for line in lines for part in textwrap.wrap(line, width, subsequent_indent="   ")]
        room = (self.slot[1] + CAPTION) // LINE
        if len(wrapped) > room:
            wrapped = [*wrapped[: room - 1], "… (all of it in the .json)"]
        for number, line in enumerate(wrapped):
            self.words(left, top + 10 + number * LINE, line)


def _mark(axes: Axes, light: tuple[float, float, float], tile: tuple[int, int]) -> None:
    # A ring where the light hangs over the surface, or a triangle at the edge beyond which it does.
    height, width = tile
    half = max(height, width) / 2
    x, y = width / 2 + light[0] * half - 0.5, height / 2 - light[1] * half - 0.5
    inside_x, inside_y = min(max(x, 8.0), width - 9.0), min(max(y, 8.0), height - 9.0)
    beyond = abs(x - inside_x), abs(y - inside_y)
    marker = "o"
    if max(beyond) > 8.0:
        marker = (">" if x > inside_x else "<") if beyond[0] >= beyond[1] else ("v" if y > inside_y else "^")
    for color, thickness in (("black", 4.0), ("#ffd84a", 1.8)):
        axes.plot(
            [inside_x], [inside_y], marker, markersize=10, markerfacecolor="none", markeredgecolor=color,
            markeredgewidth=thickness,
        )  # fmt: skip
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)


def _draw_losses(axes: Axes, losses: dict[str, list[float]]) -> None:
    axes.set_title("loss", fontsize=FONT, fontweight="bold", color=INK, loc="left", pad=6)
    axes.tick_params(labelsize=8.0, colors=FAINT)
    axes.grid(True, which="both", color="#e8e8e8", linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    before = losses.get("initialization", [])
    stages = [
        (name, values) for name, values in losses.items() if name != "initialization" and len(values) > 1
    ]
    if before:
        axes.axhline(before[0], color=FAINT, linewidth=1.0, linestyle=":")
        axes.text(
            0.98, before[0], f"initialization {before[0]:.3g}", fontsize=8.0, color=FAINT,
            transform=axes.get_yaxis_transform(), ha="right", va="bottom",
        )  # fmt: skip
    if not stages:
        axes.text(0.5, 0.4, "not refined", transform=axes.transAxes, ha="center", fontsize=FONT, color=FAINT)
        axes.set_xticks([])
        return
    start = 0
    for (name, values), color in zip(stages, STAGE_COLORS * len(stages), strict=False):
        iterations = range(start, start + len(values))
        axes.plot(
            iterations,
            values,
            color=color,
            linewidth=1.6,
            label=f"{name}: {values[0]:.3g} → {min(values):.3g}",
        )
        if start:
            axes.axvline(start, color=color, linewidth=0.8, linestyle="--")
        start += len(values) - 1
    axes.set_xlabel("iteration", fontsize=8.0, color=FAINT, labelpad=2)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlim(0, max(1, start))
    low, high = axes.get_ylim()
    high *= (high / low) ** (0.08 + 0.04 * len(stages))  # room for the legend
    axes.set_ylim(low, high)
    labelled = "123456789" if high < 4.0 * low else "235"
    axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in labelled else "")
    axes.tick_params(axis="y", which="minor", labelsize=8.0, colors=FAINT)
    axes.legend(
        fontsize=8.0, loc="upper right", frameon=True, framealpha=0.85, edgecolor="none", handlelength=1.2
    )


def _map_picture(material: SVBRDF, name: str) -> tuple[Tensor, str]:
    # What a map looks like in its file, and one fact about it.
    tensor = getattr(material, name)
    mean = [float(value) for value in tensor.mean(dim=(0, 2, 3))]
    if name == "normal":
        tilt = float(torch.rad2deg(torch.acos(tensor[:, 2].clamp(max=1.0))).mean())
        return tensor * 0.5 + 0.5, f"mean tilt {tilt:.1f}°, green is up"
    if name == "roughness":
        return tensor, f"raw, mean {mean[0]:.2f}"
    return _seen(tensor), f"sRGB, mean {_numbers(mean)}"


def _novel_positions(height: int, width: int) -> list[tuple[float, float, float]]:
    longer = max(height, width)
    return [(x * width / longer, y * height / longer, NOVEL_HEIGHT) for x, y in NOVEL_LIGHTS]


def _seen(linear: Float[Tensor, "1 3 h w"]) -> Float[Tensor, "1 3 h w"]:
    return linear_to_srgb(linear.clamp(0.0, 1.0))


def _pixels(image: Float[Tensor, "1 channels h w"], tile: tuple[int, int]) -> np.ndarray:  # uint8 [h, w, 3]
    # Display values brought to the tile's size: shrunk smoothly, enlarged as blocks.
    image = image.detach().float().cpu().clamp(0.0, 1.0)
    if tuple(image.shape[-2:]) != tile:
        if image.shape[-1] > tile[1]:
            image = interpolate(image, tile, mode="bilinear", align_corners=False, antialias=True).clamp(
                0.0, 1.0
            )
        else:
            image = interpolate(image, tile, mode="nearest-exact")
    eight_bit = (image * 255.0).round().to(torch.uint8)
    return eight_bit.expand(1, 3, *tile)[0].permute(1, 2, 0).numpy()


def _subtitle(refined: Refined) -> str:
    recipe = refined.recipe
    stages = ", ".join(f"{stage.name} {stage.iterations}" for stage in recipe.stages if stage.iterations)
    return f"recipe {recipe.name}: {stages} iterations" if stages else "the initialization, not refined"


def _facts(refined: Refined) -> list[str]:
    light, camera = refined.light, refined.camera
    where = f" at {_numbers(camera.position)}" if camera.kind == "perspective" else ""
    falloff = {"none": "without falloff", "inverse_square": "falling off with the square"}[light.falloff]
    saturated = 1.0 - float(refined.capture.unsaturated.float().mean())
    return [
        f"light {_numbers(_point(light))}, {falloff}",
        f"camera {camera.kind}{where}",
        f"{saturated:.1%} of the pixels saturated",
        "the photo was:",
        *(f"· {note}" for note in refined.notes),
    ]


def _point(light: PointLight) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in light.position[0])
    return x, y, z


def _numbers(values: tuple[float, ...] | list[float]) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in values) + ")"


def _or_dash(value: float | None) -> str:
    return "— (all saturated)" if value is None else f"{value:.4f}"


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[: length // 2]}…{text[-(length // 2) + 1 :]}"
