"""`refine-eval table1` and `table2`: the paper's tables, resumable. Options and files; no numerics."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
import typer

from eval.console import INCOMPLETE, mistakes, progress, tell
from eval.datasets import NOVEL_LIGHTS, SIZE, spread
from eval.datasets import Protocol as Settings
from eval.held_out import NAME as BUILT_IN
from eval.ledger import Ledger
from eval.methods import METHODS, Method, Row, choose, find_weights, note_of_quick, parse_inits
from eval.options import (
    Flips,
    Inits,
    MatchExposure,
    NovelLights,
    ProtocolSeed,
    RefinementSeed,
    SceneLightsFile,
    Scenes,
    Size,
)
from eval.real_scenes import read_scene_lights
from eval.report import origin, provenance
from eval.table_runs import Run, measure
from eval.tables import TABLE1, TABLE2, Table, build, paper_figures, to_csv, to_latex, to_markdown, to_plain
from eval.yardsticks import Real, Synthetic, Yardstick
from nets.data.images import DataError

QUICK = {1: 8, 2: 3}
"""Scenes of `--quick`, by table."""

NARROW = "Our networks are narrow ones that were trained for hours on two CPU cores, the paper's are not"
"""What every caption owes the reader."""

Out = Annotated[
    Path, typer.Option(help="Folder of the tables, and of the results so far: run again to go on.")
]
Names = Annotated[
    list[str] | None, typer.Option("--rows", help=f"All, or some, comma-separated, of {', '.join(METHODS)}.")
]
Quick = Annotated[
    bool, typer.Option("--quick", help="8 scenes of Table 1, 3 of Table 2; Gao19 with fewer steps.")
]
Workers = Annotated[int, typer.Option(min=1, help="Processes, of one CPU thread each.")]


def table1(
    sets: Annotated[
        list[str] | None,
        typer.Option("--set", help=f"{BUILT_IN} (default), a folder of strips, or one of PBR folders."),
    ] = None,
    out: Out = Path("tables"),
    rows: Names = None,
    scenes: Scenes = None,
    quick: Quick = False,
    init: Inits = None,
    size: Size = SIZE,
    lights: NovelLights = NOVEL_LIGHTS,
    seed: ProtocolSeed = 0,
    estimate_light: Annotated[bool, typer.Option(help="Do not tell the methods the photo's light.")] = False,
    flips: Flips = True,
    workers: Workers = 1,
) -> None:
    """The paper's Table 1: maps and renderings against known materials, every row.

    Example: refine-eval table1 --quick --workers 2
    """
    protocol = Settings(size=size, lights=lights, seed=seed)
    yardsticks = [
        Synthetic(Synthetic.named(name), protocol, estimate_light, flips) for name in sets or [BUILT_IN]
    ]
    _tables(1, yardsticks, out, rows, _count(1, scenes, quick), init, workers, quick=quick)


def table2(
    sets: Annotated[list[Path], typer.Option("--set", help="Holds a folder of photos per surface.")],
    out: Out = Path("tables"),
    rows: Names = None,
    scenes: Scenes = None,
    quick: Quick = False,
    init: Inits = None,
    size: Size = SIZE,
    seed: RefinementSeed = 0,
    lights: SceneLightsFile = None,
    match_exposure: MatchExposure = False,
    flips: Flips = True,
    workers: Workers = 1,
) -> None:
    """The paper's Table 2: one photo of a real surface in, its other photos as the truth, every row.

    Example: refine-eval table2 --set DIR --rows Ours_l1
    """
    with mistakes():
        known = {} if lights is None else read_scene_lights(lights)
    yardsticks = [Real(folder, size, seed, match_exposure, known, flips) for folder in sets]
    _tables(2, yardsticks, out, rows, _count(2, scenes, quick), init, workers, quick=quick)


def _count(table: int, scenes: int | None, quick: bool) -> int | None:
    return QUICK[table] if quick and scenes is None else scenes


def _tables(
    table: int,
    yardsticks: Sequence[Yardstick],
    out: Path,
    names: Sequence[str] | None,
    scenes: int | None,
    inits: Sequence[str] | None,
    workers: int,
    *,
    quick: bool,
) -> None:
    """Compute, print and write one table per test set; end with `INCOMPLETE` if anything is not there."""
    torch.set_num_threads(1)
    with mistakes():
        methods = choose(None if names is None else [name for text in names for name in text.split(",")])
        rows, gaps = find_weights(methods, parse_inits(inits or []), quick=quick)
        sets = [yardstick.name for yardstick in yardsticks]
        if len(set(sets)) < len(sets):
            raise ValueError(f"two test sets are called alike among {', '.join(sets)}; give them one by one")

    ledger = Ledger(out / f"table{table}.jsonl")
    complete = True
    for yardstick in yardsticks:
        made = _table(table, yardstick, methods, rows, gaps, scenes, ledger, workers)
        _write(made, out / f"table{table}_{yardstick.name}")
        typer.echo(to_markdown(made), nl=False)
        for name, reason in {**made.gaps, **made.skipped}.items():
            complete = False
            tell(f"skipped {name}: {reason}")
    if not complete:
        raise typer.Exit(INCOMPLETE)


def _table(
    table: int,
    yardstick: Yardstick,
    methods: Sequence[Method],
    rows: Sequence[Row],
    gaps: dict[str, str],
    scenes: int | None,
    ledger: Ledger,
    workers: int,
) -> Table:
    about, run, count = provenance(), Run(), 0
    try:
        indices = spread(len(yardstick.scenes()), scenes)
        count = len(indices)
        with progress(count * len(rows)) as advance:
            run = measure(yardstick, rows, indices, ledger, workers, advance)
    except DataError as error:
        gaps = gaps | {row.method.name: f"no test set: {error}" for row in rows}
    origins = {(result["commit"], result["machine"]) for result in run.results.values()}
    made_by = [origin({"commit": commit, "machine": machine}) for commit, machine in sorted(origins)]
    caption = (
        f"Table {table} on {yardstick.name}, {count} scenes. {yardstick.caption()} {NARROW}. Weights: "
        f"{', '.join(row.sources() for row in rows) or 'none'}. "
        f"{note_of_quick(rows)}"
        f"The paper's figures, of other scenes, are in parentheses; the best of ours is bold; "
        f"{' and '.join(made_by) or origin(about)}."
    )
    columns = TABLE1 if table == 1 else TABLE2
    return build(caption, columns, paper_figures(methods, table), run.results, gaps, run.skipped)


def _write(table: Table, stem: Path) -> None:
    stem.parent.mkdir(parents=True, exist_ok=True)
    texts = {
        "md": to_markdown(table),
        "tex": to_latex(table),
        "csv": to_csv(table),
        "json": json.dumps(to_plain(table), indent=1, sort_keys=True) + "\n",
    }
    for suffix, text in texts.items():
        stem.with_name(f"{stem.name}.{suffix}").write_text(text, encoding="utf-8")
