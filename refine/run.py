"""A recipe at work: its stages one after the other, each starting where the last one ended."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import torch

from losses.refinement import photo_distance
from nets.render import Geometry, shade, shading_geometry, surface_points
from nets.svbrdf import SVBRDF
from refine.capture import Capture
from refine.engine import choose_engine, find_descend
from refine.parametrization import Parameters
from refine.stages import Recipe

Report = Callable[[str, int, int, float], None]
"""Progress: stage name, iteration (from 1), iterations of all stages, loss."""


def run_stages(
    initial: SVBRDF,
    captures: Capture | Sequence[Capture],
    recipe: Recipe,
    seconds: dict[str, float],
    progress: Report | None = None,
    engine: str | None = None,
) -> tuple[SVBRDF, dict[str, list[float]]]:
    """Run a recipe's stages from an initialization under fixed lights, by an engine of `refine.engine`.

    Args:
        initial: the material to start from.
        captures: the photo to explain, or several of the same surface, whose distances add; each with its
            light.
        recipe: its stages; the light fit is not run here.
        seconds: gains one entry per stage.
        progress: called after every iteration.
        engine: a name in `refine.engine.ENGINES`; None takes the fastest for the device.

    Returns:
        The material (the initialization itself, untouched, if the recipe has no iterations) and the losses
        of every stage.

    Raises:
        ValueError: a light is missing.
    """
    photos = [captures] if isinstance(captures, Capture) else list(captures)
    height, width = initial.size
    device = initial.normal.device
    geometries = [_geometry(capture, height, width) for capture in photos]
    with torch.no_grad():
        start = sum(
            float(photo_distance(shade(initial, geometry), capture.photo, capture.unsaturated))
            for capture, geometry in zip(photos, geometries, strict=True)
        )
    losses = {"initialization": [start]}
    if recipe.iterations == 0:
        return initial, losses
    descend = find_descend(choose_engine(engine, device.type))
    parameters = Parameters.from_svbrdf(initial)
    finished = 0
    for stage in recipe.stages:
        clock = time.perf_counter()
        count = sum(name.split(" ")[0] == stage.name for name in losses)
        label = f"{stage.name} {count + 1}" if count else stage.name
        offsets = {name: zero.to(device) for name, zero in stage.offsets(height, width).items()}

        def tell(iteration: int, loss: float, name: str = label, before: int = finished) -> None:
            if progress is not None:
                progress(name, before + iteration, recipe.iterations, loss)

        parameters, losses[label] = descend(
            parameters,
            offsets,
            photos,
            geometries,
            iterations=stage.iterations,
            rates=stage.rates.moving(),
            progress=tell,
        )
        finished += stage.iterations
        seconds[label] = time.perf_counter() - clock
    return parameters.svbrdf(), losses


def _geometry(capture: Capture, height: int, width: int) -> Geometry:
    if capture.light is None:
        raise ValueError("the light of a photo is not known; fit it or give it before the stages run")
    points = surface_points(height, width, device=capture.photo.device)
    return shading_geometry(points, capture.light, capture.camera)
