"""Where the flash was in each photo of real scenes, and how brightly it shone: solved once, for every method.

Positions that were measured are kept and only exposures are fitted; all others are found from the photos
alone (`refine.calibration`), jointly with one material for all photos of a scene. How well that material
explains the photos says whether to believe the lights. The file holds numbers only, no pixels.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

from eval.real_scenes import CAMERA, LARGEST_RESIDUAL, SceneLights, list_real_scenes
from eval.report import markdown_table, number, origin, provenance
from nets.data.images import DataError
from nets.data.photos import Scene, read_scene
from nets.render import PointLight
from refine.bands import render_in_bands
from refine.fidelity import rerendering_rmse
from refine.refiner import Refined, Refiner

main = typer.Typer(add_completion=False)


@main.command()
def find(
    folder: Annotated[Path, typer.Argument(help="Holds a folder of photos per surface.")],
    out: Annotated[Path, typer.Option(help="The file to write, JSON; a table beside it.")] = Path(
        "docs/results/scene_lights.json"
    ),
    init: Annotated[str, typer.Option(help="Checkpoint that starts the material.")] = "default",
    size: Annotated[int, typer.Option(min=64, help="Pixels of the photos.")] = 256,
) -> None:
    """Find the lights of every scene, and write them."""
    refiner = Refiner(init, camera=CAMERA, resolution=size)
    found: dict[str, SceneLights] = {}
    skipped: dict[str, str] = {}
    for path in list_real_scenes(folder):
        try:
            found[path.name] = find_scene_lights(refiner, read_scene(path))
        except (DataError, ValueError) as error:
            skipped[path.name] = str(error)
            continue
        typer.echo(f"{path.name}: residual {found[path.name].residual:.3f}")
    about = {"folder": folder.resolve().name, "init": init, "size": size, **provenance()}
    write_scene_lights(out, found, skipped, about)
    out.with_suffix(".md").write_text(scene_lights_markdown(found, skipped, about), encoding="utf-8")


def find_scene_lights(refiner: Refiner, scene: Scene) -> SceneLights:
    """Find one scene's lights.

    Args:
        refiner: its recipe refines the material whose residual is told.
        scene: with two photos or more.

    Raises:
        refine.errors.UserError: a photo cannot be read, or there is one only.
    """
    known = None
    if scene.measured and scene.positions is not None:
        positions = torch.from_numpy(scene.positions)
        known = PointLight(positions, torch.ones(len(positions), 3), "inverse_square")
    refined = refiner.fit_many(scene.photos, lights=known)
    lights = [capture.light for capture in refined.captures]
    return SceneLights(
        [[round(float(value), 4) for value in light.position[0]] for light in lights if light is not None],
        [round(float(light.intensity[0, 0]), 4) for light in lights if light is not None],
        known is not None,
        round(_residual(refined), 4),
    )


def write_scene_lights(
    path: Path, found: Mapping[str, SceneLights], skipped: Mapping[str, str], about: Mapping[str, Any]
) -> None:
    """Write lights as JSON."""
    content = {
        "about": dict(about),
        "scenes": {name: asdict(lights) for name, lights in found.items()},
        "skipped": dict(skipped),
    }
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def scene_lights_markdown(
    found: Mapping[str, SceneLights], skipped: Mapping[str, str], about: Mapping[str, Any]
) -> str:
    """Return a table of the scenes, their residuals, and whether their lights are believed."""
    heads = ["scene", "positions", "believed", "photos", "residual", "mean height", "exposures"]
    rows = []
    for name, lights in found.items():
        heights = [position[2] for position in lights.positions]
        rows.append(
            [
                name,
                "measured" if lights.measured else "self-calibrated",
                "yes" if lights.believable else "no",
                str(len(heights)),
                number(lights.residual, 3),
                number(sum(heights) / len(heights), 2),
                f"{min(lights.intensities):.2f} to {max(lights.intensities):.2f}",
            ]
        )
    caption = (
        f"Lights of the scenes of {about['folder']}: measured positions are kept, others found from the "
        f"photos; exposures are fitted. Residual: RMSE, encoded with 1/2.2, of one material refined from all "
        f"photos of a scene (checkpoint {about['init']}, recipe `several`, {about['size']} px); believed "
        f"up to {LARGEST_RESIDUAL:g}; {origin(about)}."
    )
    missing = [f"- {name}: {reason}" for name, reason in skipped.items()]
    table = markdown_table(heads, rows, 3)
    return "\n".join([caption, "", *table, *(["", *missing] if missing else []), ""])


def _residual(refined: Refined) -> float:
    """Return the re-renderings' RMSE over all photos."""
    squares = []
    for capture in refined.captures:
        assert capture.light is not None
        error = rerendering_rmse(render_in_bands(refined.svbrdf, capture.light, capture.camera), capture)
        squares.append(0.0 if error is None else error**2)
    return (sum(squares) / len(squares)) ** 0.5


if __name__ == "__main__":
    main()
