"""Tables beside the paper's: rows and columns with the best in bold, as Markdown, LaTeX, CSV and JSON."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from eval.methods import Method
from eval.report import markdown_table, number, plain, skipped_lines

GAP = "gap"
"""What stands for the count of scenes where a row has none."""


@dataclass(frozen=True)
class Column:
    """A column of means.

    Attributes:
        head: what it is called.
        score: the name of a result's number.
        digits: behind the point.
        ranked: whether it is an error, of which the lowest is best.
        only: values of `lights_are` of the scenes that count; all if None.
        printed: whether the paper's figure belongs here.
    """

    head: str
    score: str
    digits: int = 3
    ranked: bool = True
    only: tuple[str, ...] | None = None
    printed: bool = True

    def counts(self, result: Mapping[str, Any]) -> bool:
        """Return whether a scene's result belongs to this column's mean."""
        return self.only is None or result["lights_are"] in self.only


SECONDS = Column("s/scene", "seconds", 1, ranked=False, printed=False)

TABLE1 = (
    Column("N", "normal"),
    Column("D", "diffuse"),
    Column("R", "roughness"),
    Column("S", "specular"),
    Column("Ren", "rendering"),
    Column("LPIPS", "lpips"),
    Column("D gamma", "diffuse_gamma", printed=False),
    Column("S gamma", "specular_gamma", printed=False),
    SECONDS,
)
"""The paper's columns; diffuse and specular also encoded, as the paper does not say which it means."""

KNOWN = ("measured", "estimated")

TABLE2 = (
    Column("LPIPS", "lpips", only=KNOWN),
    Column("RMSE", "rendering", only=KNOWN),
    Column("LPIPS, all scenes", "lpips", printed=False),
    Column("RMSE, all scenes", "rendering", printed=False),
    SECONDS,
)
"""The paper's columns on scenes whose lights are known, and on all."""


@dataclass(frozen=True)
class Cell:
    """A mean over scenes, the paper's figure, and whether no other row is better; None is a gap."""

    value: float | None
    paper: float | None
    best: bool = False


@dataclass(frozen=True)
class TableRow:
    """A row: its cells in the order of the columns, how many scenes it has, why it has none."""

    name: str
    scenes: int
    cells: tuple[Cell, ...]
    gap: str | None


@dataclass(frozen=True)
class Table:
    """Everything that is printed."""

    caption: str
    columns: tuple[Column, ...]
    rows: tuple[TableRow, ...]
    skipped: Mapping[str, str]

    @property
    def gaps(self) -> dict[str, str]:
        """Why rows have no figures, by their names."""
        return {row.name: row.gap for row in self.rows if row.gap is not None}


def build(
    caption: str,
    columns: Sequence[Column],
    figures: Mapping[str, Mapping[str, float]],
    results: Mapping[tuple[str, str], Mapping[str, Any]],
    gaps: Mapping[str, str],
    skipped: Mapping[str, str],
) -> Table:
    """Average results over scenes and mark the best of every column.

    Best is the lowest, ties as printed included, of the rows that have as many scenes as any.

    Args:
        caption: plain text.
        columns: of the table.
        figures: the paper's by row and score; names all rows, in order.
        results: by row and scene.
        gaps: why a row has no results.
        skipped: scenes, or rows on scenes, and why.
    """
    found = {name: [result for (row, _), result in results.items() if row == name] for name in figures}
    means = {name: [_mean(column, found[name]) for column in columns] for name in found}
    best = [_best(column, [means[name][i] for name in found]) for i, column in enumerate(columns)]
    rows = []
    for name, paper in figures.items():
        cells = []
        for column, (value, count), lowest in zip(columns, means[name], best, strict=True):
            printed = paper.get(column.score) if column.printed else None
            cells.append(Cell(value, printed, (number(value, column.digits), count) == lowest))
        reason = gaps.get(name, "every scene was skipped")
        rows.append(TableRow(name, len(found[name]), tuple(cells), None if found[name] else reason))
    return Table(caption, tuple(columns), tuple(rows), skipped)


def paper_figures(methods: Sequence[Method], table: int) -> dict[str, Mapping[str, float]]:
    """Return the figures of Table 1 or 2 by row."""
    return {method.name: method.table1 if table == 1 else method.table2 for method in methods}


def to_markdown(table: Table) -> str:
    """Return the table in Markdown with its caption, its gaps and what was skipped."""
    rows = []
    for row in table.rows:
        cells = [
            _cell(c, column, "**{}**", "({})") for c, column in zip(row.cells, table.columns, strict=True)
        ]
        rows.append([row.name, str(row.scenes or GAP), *cells])
    lines = markdown_table(["row", "scenes", *(column.head for column in table.columns)], rows, texts=1)
    gaps = ["", "Gaps:", "", *(f"- {name}: {why}" for name, why in table.gaps.items())] if table.gaps else []
    return "\n".join([table.caption, "", *lines, *gaps, *skipped_lines(table.skipped)]) + "\n"


def to_latex(table: Table) -> str:
    """Return the table in LaTeX; needs the package booktabs."""
    heads = " & ".join(_escape(head) for head in ["", "scenes", *(column.head for column in table.columns)])
    lines = [r"\begin{table}", r"\centering", rf"\caption{{{_escape(table.caption)}}}"]
    lines += [rf"\begin{{tabular}}{{lr{'r' * len(table.columns)}}}", r"\toprule", rf"{heads} \\", r"\midrule"]
    for row in table.rows:
        cells = [
            _cell(c, column, r"\textbf{{{}}}", r"{{\scriptsize ({})}}")
            for c, column in zip(row.cells, table.columns, strict=True)
        ]
        lines.append(" & ".join([_escape(row.name), str(row.scenes or GAP), *cells]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}"]) + "\n"


def to_csv(table: Table) -> str:
    """Return means and the paper's figures as comma-separated values, at full precision; gaps are empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    heads = [
        head for c in table.columns for head in ([c.head, f"{c.head} (paper)"] if c.printed else [c.head])
    ]
    writer.writerow(["row", "scenes", *heads, "gap"])
    for row in table.rows:
        values: list[float | None] = []
        for cell, column in zip(row.cells, table.columns, strict=True):
            values += [cell.value, cell.paper] if column.printed else [cell.value]
        writer.writerow([row.name, row.scenes, *("" if v is None else v for v in values), row.gap or ""])
    return text.getvalue()


def to_plain(table: Table) -> dict[str, Any]:
    """Return the table as plain data for JSON."""
    rows = []
    for row in table.rows:
        cells = dict(zip((column.head for column in table.columns), row.cells, strict=True))
        rows.append(
            {
                "row": row.name,
                "scenes": row.scenes,
                "gap": row.gap,
                "means": {head: cell.value for head, cell in cells.items()},
                "paper": {head: cell.paper for head, cell in cells.items() if cell.paper is not None},
                "best": [head for head, cell in cells.items() if cell.best],
            }
        )
    return plain({"caption": table.caption, "rows": rows, "skipped": dict(table.skipped)})


def _mean(column: Column, results: Sequence[Mapping[str, Any]]) -> tuple[float | None, int]:
    values = [result[column.score] for result in results if column.counts(result)]
    return (math.fsum(values) / len(values) if values else None), len(values)


def _best(column: Column, means: Sequence[tuple[float | None, int]]) -> tuple[str, int] | None:
    """Return the lowest mean as printed, and of how many scenes; None where there is no race."""
    most = max((count for _, count in means), default=0)
    racing = [value for value, count in means if value is not None and count == most]
    return (number(min(racing), column.digits), most) if column.ranked and len(racing) > 1 else None


def _cell(cell: Cell, column: Column, bold: str, beside: str) -> str:
    value = number(cell.value, column.digits)
    value = bold.format(value) if cell.best else value
    return value if cell.paper is None else f"{value} {beside.format(number(cell.paper, column.digits))}"


def _escape(text: str) -> str:
    return re.sub(r"([_%&#$])", r"\\\1", text)
