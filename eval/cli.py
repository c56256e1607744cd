"""`refine-eval`: the command line of the evaluation. Options, files and exit codes; no numerics."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from eval.datasets import NOVEL_LIGHTS, SIZE, Protocol
from eval.development import (
    DEVELOPMENT,
    as_json,
    count_scenes,
    evaluate,
    markdown,
    provenance,
    refinement_estimator,
    require,
)
from eval.photos import find_photos, photos_markdown, score_photos
from losses.perceptual import LPIPS
from nets.checkpoint import CheckpointError
from nets.data.images import DataError
from refine.refiner import Refiner
from refine.stages import RECIPES, find_recipe

BAD_USAGE = 2
"""Exit code: nothing was done, one sentence says why."""

INCOMPLETE = 3
"""Exit code: done, but scenes that are named were skipped."""

main = typer.Typer(add_completion=False, no_args_is_help=True, help="Evaluate SVBRDF capture.")
errors = Console(stderr=True, soft_wrap=True, highlight=False)


@main.callback()
def evaluation() -> None:
    """Evaluate SVBRDF capture: tables that name their test set, count, lights, seed, commit and machine."""


@main.command()
def development(
    data: Annotated[Path, typer.Option(help="Holds strips/des18_dev, strips/des19_dev and materials/dev.")],
    init: Annotated[str, typer.Option(help="Checkpoint: a shipped name or a file.")] = "default",
    recipe: Annotated[str, typer.Option(help=f"none, or {', '.join(sorted(RECIPES))}.")] = "none",
    iters: Annotated[int | None, typer.Option(min=0, help="Iterations; the recipe's own by default.")] = None,
    scenes: Annotated[int | None, typer.Option(min=1, help="Scenes per set, evenly spread; all.")] = None,
    size: Annotated[int, typer.Option(min=64, help="Pixels of photo and maps.")] = SIZE,
    lights: Annotated[int, typer.Option(min=1, help="Novel lights per scene.")] = NOVEL_LIGHTS,
    seed: Annotated[int, typer.Option(min=0, help="Of the novel lights and of refinement.")] = 0,
    estimate_light: Annotated[bool, typer.Option(help="Do not tell the method the photo's light.")] = False,
    flips: Annotated[bool, typer.Option(help="Average the network over four mirrored photos.")] = True,
    stored_input: Annotated[bool, typer.Option(help="Use the photos stored in strips.")] = False,
    threads: Annotated[int, typer.Option(min=0, help="CPU threads; 0 leaves torch's choice.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write everything here.")] = None,
    markdown_file: Annotated[Path | None, typer.Option("--markdown", help="Write the table here.")] = None,
) -> None:
    """Score a checkpoint's initialization, and its refinement, on the development sets."""
    if threads:
        torch.set_num_threads(threads)
    try:
        require(data, DEVELOPMENT)
        chosen = find_recipe("paper" if recipe == "none" else recipe)
        refiner = Refiner(init, chosen, resolution=size, flips=flips, seed=seed)
    except (DataError, CheckpointError, ValueError) as error:
        errors.print(f"refine-eval: {error}", markup=False)
        raise typer.Exit(BAD_USAGE) from None

    origin = provenance()  # of the code that runs, whatever is committed meanwhile
    estimator = refinement_estimator(refiner, 0 if recipe == "none" else iters, estimate_light=estimate_light)
    protocol = Protocol(size=size, lights=lights, seed=seed, stored_input=stored_input)
    with _progress() as bar:
        task = bar.add_task("scenes", total=count_scenes(data, DEVELOPMENT, scenes))
        results = evaluate(
            estimator,
            data,
            DEVELOPMENT,
            protocol,
            scenes,
            LPIPS(),
            progress=lambda name: bar.update(task, advance=1, description=name[:40]),
        )
    results.settings |= {
        "init": init,
        "recipe": recipe,
        "iters": iters,
        "estimate_light": estimate_light,
        "flips": flips,
    }
    results.settings |= origin

    table = markdown(results)
    typer.echo(table, nl=False)
    if markdown_file is not None:
        markdown_file.write_text(table, encoding="utf-8")
    if json_file is not None:
        json_file.write_text(json.dumps(as_json(results), indent=1, sort_keys=True) + "\n", encoding="utf-8")
    if results.skipped:
        for name, reason in results.skipped.items():
            errors.print(f"refine-eval: skipped {name}: {reason}", markup=False)
        raise typer.Exit(INCOMPLETE)


@main.command()
def photos(
    folders: Annotated[list[Path], typer.Argument(help="Photos, or folders of them.")],
    init: Annotated[str, typer.Option(help="Checkpoint: a shipped name or a file.")] = "default",
    recipe: Annotated[str, typer.Option(help=f"One of {', '.join(sorted(RECIPES))}.")] = "paper",
    iters: Annotated[int | None, typer.Option(min=0, help="Iterations; the recipe's own by default.")] = None,
    part: Annotated[
        str, typer.Option(help="K/N: only every N-th photo from the K-th, to share work.")
    ] = "1/1",
    threads: Annotated[int, typer.Option(min=0, help="CPU threads; 0 leaves torch's choice.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the scores here.")] = None,
) -> None:
    """Refine real photos and say whether each is explained, with legal maps."""
    if threads:
        torch.set_num_threads(threads)
    found = find_photos(folders)
    try:
        first, step = (int(number) for number in part.split("/"))
        refiner = Refiner(init, recipe)
        if not 1 <= first <= step:
            raise ValueError(f"--part {part} is not K/N with K from 1 to N")
        if not found:
            raise ValueError(f"no photos below {', '.join(map(str, folders))}")
    except ValueError as error:
        errors.print(f"refine-eval: {error}", markup=False)
        raise typer.Exit(BAD_USAGE) from None

    origin = provenance()
    found = found[first - 1 :: step]
    skipped: list[Path] = []

    def skip(path: Path, reason: str) -> None:
        skipped.append(path)
        errors.print(f"refine-eval: skipped {path}: {reason}", markup=False)

    scores = []
    with _progress() as bar:
        task = bar.add_task("photos", total=len(found))
        for score in score_photos(refiner, found, iters, skip):
            scores.append(score)
            bar.update(task, advance=1, description=score.name[-40:])
    if scores:
        typer.echo(photos_markdown(scores), nl=False)
    if json_file is not None:
        record: dict[str, Any] = {"init": init, "recipe": recipe, "iters": iters, **origin}
        record["photos"] = [asdict(score) for score in scores]
        json_file.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    if skipped:
        raise typer.Exit(INCOMPLETE)


def _progress() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal)


if __name__ == "__main__":
    main()
