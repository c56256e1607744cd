"""The tables' means, bold figures and formats, from made-up results."""

from __future__ import annotations

import csv
import io
import json
import math

import pytest

from eval.tables import Column, Table, build, to_csv, to_latex, to_markdown, to_plain

COLUMNS = (
    Column("N", "normal"),
    Column("Ren", "rendering", only=("known",)),
    Column("s/scene", "seconds", 1, ranked=False, printed=False),
)
FIGURES = {"A_1": {"normal": 0.05, "rendering": 0.07}, "B": {}, "C": {"normal": 0.06}, "D": {}}


def result(normal: float, rendering: float, seconds: float = 1.0, lights_are: str = "known") -> dict:
    return {"normal": normal, "rendering": rendering, "seconds": seconds, "lights_are": lights_are}


@pytest.fixture
def table() -> Table:
    results = {
        ("A_1", "x"): result(0.1, 0.2, 3.0),
        ("A_1", "y"): result(0.3, 9.0, 1.0, "uncertain"),
        ("B", "x"): result(0.2, 0.1),
        ("B", "y"): result(0.2002, 9.0, 1.0, "uncertain"),
        ("D", "x"): result(0.0, 0.3),  # one scene only: no race against means of two
    }
    skipped = {"z": "cannot be read", "D on y": "NaN"}
    return build(
        "All of it: 100 % & more_or_less.", COLUMNS, FIGURES, results, {"C": "no weights: c"}, skipped
    )


def test_means_are_over_the_scenes_that_count(table: Table) -> None:
    values = {row.name: [cell.value for cell in row.cells] for row in table.rows}
    assert values["A_1"] == pytest.approx([0.2, 0.2, 2.0])
    assert values["B"] == pytest.approx([0.2001, 0.1, 1.0])
    assert values["C"] == [None, None, None]
    assert [row.scenes for row in table.rows] == [2, 2, 0, 1]
    assert table.gaps == {"C": "no weights: c"}


def test_the_best_is_bold_and_ties_as_printed_are(table: Table) -> None:
    best = {row.name: [cell.best for cell in row.cells] for row in table.rows}
    assert best["A_1"] == [True, False, False]  # 0.200 and 0.2001 print alike
    assert best["B"] == [True, True, False]  # seconds are no race
    assert best["C"] == best["D"] == [False, False, False]
    alone = build("", COLUMNS, {"A_1": {}}, {("A_1", "x"): result(0.1, 0.2)}, {}, {})
    assert not any(cell.best for cell in alone.rows[0].cells)


def test_markdown(table: Table) -> None:
    lines = to_markdown(table).splitlines()
    assert lines[0] == table.caption
    assert lines[2:8] == [
        "| row | scenes | N | Ren | s/scene |",
        "|---|---:|---:|---:|---:|",
        "| A_1 | 2 | **0.200** (0.050) | 0.200 (0.070) | 2.0 |",
        "| B | 2 | **0.200** | **0.100** | 1.0 |",
        "| C | gap | - (0.060) | - | - |",
        "| D | 1 | 0.000 | 0.300 | 1.0 |",
    ]
    assert "- C: no weights: c" in lines
    assert "- z: cannot be read" in lines
    assert "- D on y: NaN" in lines


def test_latex(table: Table) -> None:
    text = to_latex(table)
    assert r"\caption{All of it: 100 \% \& more\_or\_less.}" in text
    body = text[text.index(r"\midrule") : text.index(r"\bottomrule")].splitlines()[1:]
    assert [line.count(" & ") for line in body] == [4] * 4
    assert all(line.endswith(r" \\") for line in body)
    assert body[0].startswith(r"A\_1 & 2 & \textbf{0.200} {\scriptsize (0.050)} & 0.200 ")
    assert r"\begin{tabular}{lrrrr}" in text
    assert text.count("{") == text.count("}")
    begun = [line for line in text.splitlines() if line.startswith(r"\begin")]
    assert len(begun) == sum(line.startswith(r"\end") for line in text.splitlines()) == 2


def test_csv_holds_full_precision_and_empty_gaps(table: Table) -> None:
    rows = {row["row"]: row for row in csv.DictReader(io.StringIO(to_csv(table)))}
    assert list(rows) == list(FIGURES)
    assert float(rows["B"]["N"]) == pytest.approx(0.2001, abs=1e-12)
    assert (rows["A_1"]["N (paper)"], rows["B"]["N (paper)"]) == ("0.05", "")
    assert (rows["C"]["N"], rows["C"]["gap"], rows["C"]["scenes"]) == ("", "no weights: c", "0")
    assert "s/scene (paper)" not in rows["B"]


def test_json_has_no_nan() -> None:
    results = {("A_1", "x"): result(math.nan, 0.2)}
    plain = to_plain(build("", COLUMNS, {"A_1": {"normal": 0.05}}, results, {}, {"y": "torn"}))
    text = json.dumps(plain, allow_nan=False)
    (row,) = json.loads(text)["rows"]
    assert row["means"] == {"N": None, "Ren": 0.2, "s/scene": 1.0}
    assert row["paper"] == {"N": 0.05}
    assert plain["skipped"] == {"y": "torn"}


def test_a_row_whose_scenes_were_all_skipped_says_so() -> None:
    table = build("", COLUMNS, {"A_1": {}}, {}, {}, {"x": "torn"})
    assert table.gaps == {"A_1": "every scene was skipped"}
