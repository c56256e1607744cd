"""`refine-eval`: the command line of the evaluation. Options, files and exit codes; no numerics."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

from eval.ablations import ablation_estimator
from eval.calibration import calibration_markdown, evaluate_calibration, lights_finder, measured_scenes
from eval.console import INCOMPLETE, mistakes, progress, tell
from eval.datasets import NOVEL_LIGHTS, SIZE, Protocol, spread
from eval.development import (
    DEVELOPMENT,
    count_scenes,
    evaluate,
    markdown,
    refinement_estimator,
    require,
)
from eval.figures_cli import figures
from eval.lights import evaluate_lights, light_estimator, lights_markdown
from eval.options import (
    Flips,
    MatchExposure,
    NovelLights,
    ProtocolSeed,
    RefinementSeed,
    SceneLightsFile,
    Scenes,
    Size,
    Threads,
)
from eval.photos import find_photos, photos_markdown, score_photos
from eval.real import evaluate_real, real_estimator, real_markdown
from eval.real_scenes import CAMERA, list_real_scenes, read_scene_lights
from eval.report import Results, provenance
from eval.tables_cli import table1, table2
from losses.perceptual import LPIPS
from refine.refiner import Refiner
from refine.stages import RECIPES, find_recipe

main = typer.Typer(add_completion=False, no_args_is_help=True, help="Evaluate SVBRDF capture.")
main.command()(table1)
main.command()(table2)
main.command()(figures)

Data = Annotated[Path, typer.Option(help="Holds strips/des18_dev, strips/des19_dev and materials/dev.")]
Checkpoint = Annotated[str, typer.Option(help="Checkpoint: a shipped name or a file.")]
Checkpoints = Annotated[
    list[str] | None, typer.Option(help="As often as there are checkpoints to compare (default).")
]
RecipeName = Annotated[str, typer.Option(help=f"none, or {', '.join(sorted(RECIPES))}.")]
Iterations = Annotated[int | None, typer.Option(min=0, help="Iterations; the recipe's own by default.")]
JsonFile = Annotated[Path | None, typer.Option("--json", help="Write everything here.")]
MarkdownFile = Annotated[Path | None, typer.Option("--markdown", help="Write the table here.")]


@main.callback()
def evaluation() -> None:
    """Evaluate SVBRDF capture: tables that name their test set, count, lights, seed, commit and machine."""


@main.command()
def development(
    data: Data,
    init: Checkpoint = "default",
    recipe: RecipeName = "none",
    iters: Iterations = None,
    scenes: Scenes = None,
    size: Size = SIZE,
    lights: NovelLights = NOVEL_LIGHTS,
    seed: ProtocolSeed = 0,
    estimate_light: Annotated[bool, typer.Option(help="Do not tell the method the photo's light.")] = False,
    flips: Flips = True,
    stored_input: Annotated[bool, typer.Option(help="Use the photos stored in strips.")] = False,
    threads: Threads = 0,
    json_file: JsonFile = None,
    markdown_file: MarkdownFile = None,
) -> None:
    """Score a checkpoint's initialization, and its refinement, on the development sets.

    Example: refine-eval development --data DIR --recipe default --scenes 4
    """
    _use_threads(threads)
    with mistakes():
        require(data, DEVELOPMENT)
        chosen = find_recipe("default" if recipe == "none" else recipe)
        refiner = Refiner(init, chosen, resolution=size, flips=flips, seed=seed)

    about = provenance()  # of the code that runs, whatever is committed meanwhile
    estimator = refinement_estimator(refiner, 0 if recipe == "none" else iters, estimate_light=estimate_light)
    protocol = Protocol(size=size, lights=lights, seed=seed, stored_input=stored_input)
    with progress(count_scenes(data, DEVELOPMENT, scenes)) as advance:
        results = evaluate(estimator, data, DEVELOPMENT, protocol, scenes, LPIPS(), advance)
    results.settings |= {
        "init": init,
        "recipe": recipe,
        "iters": iters,
        "estimate_light": estimate_light,
        "flips": flips,
        **about,
    }
    _finish(results, markdown(results), json_file, markdown_file)


@main.command()
def ablations(
    data: Data,
    init: Checkpoint = "default",
    scenes: Scenes = None,
    lights: NovelLights = NOVEL_LIGHTS,
    threads: Threads = 0,
    json_file: JsonFile = None,
    markdown_file: MarkdownFile = None,
) -> None:
    """Score the default recipe with each of its ingredients taken away, on the development sets.

    Example: refine-eval ablations --data DIR --scenes 8 --lights 8
    """
    _use_threads(threads)
    with mistakes():
        require(data, DEVELOPMENT)
        refiner = Refiner(init)

    about = provenance()
    with progress(count_scenes(data, DEVELOPMENT, scenes)) as advance:
        protocol = Protocol(lights=lights)
        results = evaluate(ablation_estimator(refiner), data, DEVELOPMENT, protocol, scenes, LPIPS(), advance)
    results.settings |= {"init": init, "recipe": "ablations of default", **about}
    _finish(results, markdown(results), json_file, markdown_file)


@main.command()
def real(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Holds a folder of photos per surface.")],
    init: Checkpoints = None,
    recipe: RecipeName = "none",
    iters: Iterations = None,
    scenes: Scenes = None,
    size: Size = SIZE,
    seed: RefinementSeed = 0,
    lights: SceneLightsFile = None,
    match_exposure: MatchExposure = False,
    flips: Flips = True,
    threads: Threads = 0,
    json_file: JsonFile = None,
    markdown_file: MarkdownFile = None,
) -> None:
    """Score checkpoints on real surfaces in several flash photos of known lights (paper Table 2).

    Example: refine-eval real DIR --init default --init syn --recipe default
    """
    _use_threads(threads)
    inits = init or ["default"]
    with mistakes():
        count = len(spread(len(list_real_scenes(folder)), scenes))
        known = None if lights is None else read_scene_lights(lights)
        chosen = find_recipe("default" if recipe == "none" else recipe)
        refiners = {
            name: Refiner(name, chosen, camera=CAMERA, resolution=size, flips=flips, seed=seed)
            for name in inits
        }

    about = provenance()
    total = 0 if recipe == "none" else iters
    estimator = real_estimator(refiners, total, match_exposure=match_exposure)
    with progress(count) as advance:
        results = evaluate_real(estimator, folder, size, scenes, LPIPS(), advance, known)
    results.settings |= {
        "inits": inits,
        "recipe": recipe,
        "iters": iters,
        "match_exposure": match_exposure,
        "lights": None if lights is None else lights.name,
        "flips": flips,
        "seed": seed,
        **about,
    }
    _finish(results, real_markdown(results), json_file, markdown_file)


@main.command()
def light(
    data: Data,
    init: Checkpoints = None,
    recipe: Annotated[str, typer.Option(help=f"Whose light fit: {', '.join(sorted(RECIPES))}.")] = "default",
    scenes: Scenes = None,
    size: Size = SIZE,
    seed: Annotated[int, typer.Option(min=0, help="Of the lights.")] = 0,
    flips: Flips = True,
    threads: Threads = 0,
    json_file: JsonFile = None,
    markdown_file: MarkdownFile = None,
) -> None:
    """Score checkpoints' light heads, alone and after the light fit, on the development sets.

    Example: refine-eval light --data DIR --scenes 4
    """
    _use_threads(threads)
    inits = init or ["default"]
    with mistakes():
        require(data, DEVELOPMENT)
        refiners = {name: Refiner(name, recipe, resolution=size, flips=flips, seed=seed) for name in inits}

    about = provenance()
    with progress(count_scenes(data, DEVELOPMENT, scenes)) as advance:
        results = evaluate_lights(light_estimator(refiners), data, DEVELOPMENT, size, seed, scenes, advance)
    results.settings |= {"inits": inits, "recipe": recipe, "flips": flips, **about}
    _finish(results, lights_markdown(results), json_file, markdown_file)


@main.command()
def photos(
    folders: Annotated[list[Path], typer.Argument(help="Photos, or folders of them.")],
    init: Checkpoint = "default",
    recipe: Annotated[str, typer.Option(help=f"One of {', '.join(sorted(RECIPES))}.")] = "default",
    iters: Iterations = None,
    part: Annotated[
        str, typer.Option(help="K/N: only every N-th photo from the K-th, to share work.")
    ] = "1/1",
    threads: Threads = 0,
    json_file: JsonFile = None,
) -> None:
    """Refine real photos and say whether each is explained, with legal maps.

    Example: refine-eval photos DIR wall.jpg --recipe fast --json photos.json
    """
    _use_threads(threads)
    found = find_photos(folders)
    with mistakes():
        first, step = (int(number) for number in part.split("/"))
        refiner = Refiner(init, recipe)
        if not 1 <= first <= step:
            raise ValueError(f"--part {part} is not K/N with K from 1 to N")
        if not found:
            raise ValueError(f"no photos below {', '.join(map(str, folders))}")

    about = provenance()
    found = found[first - 1 :: step]
    skipped: list[Path] = []

    def skip(path: Path, reason: str) -> None:
        skipped.append(path)
        tell(f"skipped {path}: {reason}")

    scores = []
    with progress(len(found)) as advance:
        for score in score_photos(refiner, found, iters, skip):
            scores.append(score)
            advance(score.name)
    if scores:
        typer.echo(photos_markdown(scores), nl=False)
    if json_file is not None:
        record: dict[str, Any] = {"init": init, "recipe": recipe, "iters": iters, **about}
        record["photos"] = [asdict(score) for score in scores]
        json_file.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    if skipped:
        raise typer.Exit(INCOMPLETE)


@main.command()
def calibration(
    data: Annotated[Path, typer.Option(help="Holds photos/multi_dev.")],
    init: Checkpoint = "default",
    size: Size = SIZE,
    flips: Flips = True,
    threads: Threads = 0,
    json_file: JsonFile = None,
    markdown_file: MarkdownFile = None,
) -> None:
    """Score the self-calibration of several photos' lights where they were measured.

    Example: refine-eval calibration --data DIR
    """
    _use_threads(threads)
    with mistakes():
        scenes = measured_scenes(data / "photos/multi_dev")
        refiner = Refiner(init, resolution=size, flips=flips)

    about = provenance()
    with progress(len(scenes)) as advance:
        results = evaluate_calibration(lights_finder(refiner), scenes, advance)
    results.settings |= {"init": init, "flips": flips, "size": size, **about}
    _finish(results, calibration_markdown(results), json_file, markdown_file)


def _use_threads(count: int) -> None:
    if count:
        torch.set_num_threads(count)


def _finish(results: Results[Any], table: str, json_file: Path | None, markdown_file: Path | None) -> None:
    """Print and write a table; name what was skipped."""
    typer.echo(table, nl=False)
    if markdown_file is not None:
        markdown_file.write_text(table, encoding="utf-8")
    if json_file is not None:
        json_file.write_text(json.dumps(results.as_json(), indent=1, sort_keys=True) + "\n", encoding="utf-8")
    if results.skipped:
        for name, reason in results.skipped.items():
            tell(f"skipped {name}: {reason}")
        raise typer.Exit(INCOMPLETE)


if __name__ == "__main__":
    main()
