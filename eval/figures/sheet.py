"""A sheet of pictures for print: rows and columns with heads, a line below each picture, and gaps that show.

Sizes are in points and inches of a page that is as wide as a paper's two columns.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib.style
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from torch import Tensor

from nets.color import linear_to_srgb
from nets.svbrdf import SVBRDF
from refine.files import write_atomically

PAGE_WIDTH = 7.0
"""Inches: the text width of a two-column page."""

LARGEST_PICTURE = 1.25
"""Inches of a side: a sheet of few columns is narrower than the page."""

DPI = 200
FONT, SMALL, SMALLEST = 7.0, 5.5, 5.0
"""Points of heads, of the lines below pictures, and of print that can still be read."""

LABEL, HEAD, LINE, SPACE, GAP = 0.16, 0.12, 0.12, 0.03, 0.1
"""Inches: of rows' labels, of a line of the heads and below pictures, between pictures and between groups."""

INK, FAINT, NOTHING = "#202020", "#606060", "#ececec"


@dataclass(frozen=True)
class Picture:
    """One picture, or the reason why there is none.

    Attributes:
        image: display values in [0, 1], one or three channels; None leaves the place empty.
        below: a short line; without an image, why there is none.
    """

    image: Float[Tensor, "1 channels h w"] | None
    below: str = ""


@dataclass(frozen=True)
class Line:
    """A row of pictures.

    Attributes:
        label: what it is called.
        pictures: as many as there are heads.
        begins: whether a group of rows begins here.
    """

    label: str
    pictures: tuple[Picture, ...]
    begins: bool = False

    @property
    def below(self) -> float:
        """Inches between its pictures and what follows: a line of text, where any picture has one."""
        return (
            LINE if any(picture.image is not None and picture.below for picture in self.pictures) else SPACE
        )


@dataclass(frozen=True)
class Sheet:
    """Pictures under heads.

    Attributes:
        heads: of the columns.
        lines: each with a picture per column.
    """

    heads: tuple[str, ...]
    lines: tuple[Line, ...] = field(default=())


def as_seen(linear: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Return linear radiance or albedo as a screen shows it: clamped, sRGB."""
    return linear_to_srgb(linear.clamp(0.0, 1.0))


def map_picture(material: SVBRDF, name: str) -> Float[Tensor, "1 channels h w"]:
    """Return a map as its file shows it: normals as (n + 1) / 2, albedos in sRGB, roughness as it is."""
    tensor: Tensor = getattr(material, name)
    if name == "normal":
        return tensor * 0.5 + 0.5
    return tensor if name == "roughness" else as_seen(tensor)


def draw(sheet: Sheet) -> Figure:
    """Return the sheet as a figure."""
    columns = len(sheet.heads)
    side = min(LARGEST_PICTURE, (PAGE_WIDTH - LABEL - SPACE * (columns - 1)) / columns)
    width = LABEL + columns * side + SPACE * (columns - 1)
    heads = [fit(head, side, FONT, broken=True) for head in sheet.heads]
    head_height = HEAD * max(1 + text.count("\n") for text, _ in heads) + SPACE
    tops = [head_height]
    for line, following in zip(sheet.lines, [*sheet.lines[1:], None], strict=True):
        gap = GAP if following is not None and following.begins else 0.0
        tops.append(tops[-1] + side + line.below + gap)
    height = tops[-1]
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white")

    def place(left: float, top: float) -> tuple[float, float]:
        return left / width, 1.0 - top / height

    for row, line in enumerate(sheet.lines):
        top = tops[row]
        x, y = place(LABEL * 0.4, top + side / 2)
        label, size = fit(line.label, side, FONT)
        figure.text(x, y, label, fontsize=size, color=INK, rotation=90, ha="center", va="center")
        for column, picture in enumerate(line.pictures):
            left = LABEL + column * (side + SPACE)
            if row == 0:
                head, size = heads[column]
                x, y = place(left + side / 2, head_height - SPACE - HEAD * 0.25)
                figure.text(x, y, head, fontsize=size, color=INK, ha="center", va="baseline", linespacing=1.1)
            x, y = place(left, top + side)
            _show(figure.add_axes((x, y, side / width, side / height)), picture)
            if picture.image is not None:
                x, y = place(left + side / 2, top + side + LINE * 0.72)
                below, size = fit(picture.below, side, SMALL)
                figure.text(x, y, below, fontsize=size, color=FAINT, ha="center", va="baseline")
    return figure


def fit(text: str, width: float, size: float, *, broken: bool = False) -> tuple[str, float]:
    """Return a text as it fits above or below a picture, and the size of its letters.

    Letters become smaller while they can still be read, then the end of the text is left out.

    Args:
        text: one line.
        width: inches.
        size: points it should have.
        broken: let it go on in a new line after its first space, if it has to.
    """
    if broken and _inches(text, size) > width and " " in text:
        parts = [fit(part, width, size) for part in text.split(" ", 1)]
        return "\n".join(part for part, _ in parts), min(points for _, points in parts)
    while size > SMALLEST and _inches(text, size) > width:
        size = max(SMALLEST, size - 0.1)
    if _inches(text, size) <= width:
        return text, size
    kept = len(text) - 1
    while kept > 1 and _inches(f"{text[:kept]}…", size) > width:
        kept -= 1
    return f"{text[:kept]}…", size


def _inches(text: str, size: float) -> float:
    """Return the width of a text whose letters stand on whole pixels, which makes it wider than in print."""
    width, _, _ = RendererAgg(1, 1, DPI).get_text_width_height_descent(text, FontProperties(size=size), False)
    return float(width) / DPI


def require_format(kind: str) -> None:
    """Check that figures can be written as that.

    Raises:
        ValueError: they cannot, naming what they can be written as.
    """
    known = FigureCanvasAgg.get_supported_filetypes()
    if kind not in known:
        raise ValueError(f"figures cannot be written as {kind!r}; choose one of {', '.join(sorted(known))}")


def write(figure: Figure, path: Path) -> None:
    """Write a figure, whole or not at all; the suffix says as what (png, jpg, pdf, ...).

    Raises:
        ValueError: as `require_format`.
    """
    kind = path.suffix.lstrip(".").lower()
    require_format(kind)
    undated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}, "png": {"Software": None}}
    with matplotlib.style.context("default"), write_atomically(path) as temporary:
        figure.savefig(temporary, format=kind, dpi=DPI, metadata=undated.get(kind))


def grid(
    heads: Sequence[str], lines: Sequence[tuple[str, Sequence[Picture]]], begins: Collection[int] = ()
) -> Sheet:
    """Return a sheet of plain sequences.

    Args:
        heads: of the columns.
        lines: labels and pictures.
        begins: numbers of the lines at which a group begins, with a gap above.

    Raises:
        ValueError: a row that has not one picture per head.
    """
    made = tuple(
        Line(label, tuple(pictures), begins=number in begins)
        for number, (label, pictures) in enumerate(lines)
    )
    for line in made:
        if len(line.pictures) != len(heads):
            raise ValueError(f"row {line.label!r} has {len(line.pictures)} pictures for {len(heads)} columns")
    return Sheet(tuple(heads), made)


def _show(axes: Axes, picture: Picture) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    if picture.image is None:
        axes.set_facecolor(NOTHING if picture.below else "white")
        axes.text(0.5, 0.5, picture.below, fontsize=SMALL, color=FAINT, ha="center", va="center", wrap=True)
        return
    axes.imshow(_pixels(picture.image), interpolation="antialiased", aspect="auto")


def _pixels(image: Tensor) -> np.ndarray:  # uint8 [h, w, 3]
    values = image[0].detach().cpu().clamp(0.0, 1.0).expand(3, -1, -1).permute(1, 2, 0)
    pixels: np.ndarray = (values * 255.0).round().byte().numpy()
    return pixels
