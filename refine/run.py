"""A recipe at work: its stages one after the other, each starting where the last one ended."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial

from nets.svbrdf import SVBRDF
from refine.bands import distance_in_bands
from refine.capture import Capture
from refine.engine import choose_engine, find_descend, find_solve
from refine.engine.reference import Progress, Stopped
from refine.latent import descend_latent
from refine.memory import Outcome, StageMemory
from refine.parametrization import Parameters
from refine.stages import LatentStage, PosteriorStage, Recipe, Stage

Report = Callable[[str, int, int, float], None]
"""Progress: stage name, iteration (from 1), iterations of all stages, loss."""


def run_stages(
    initial: SVBRDF,
    captures: Capture | Sequence[Capture],
    recipe: Recipe,
    seconds: dict[str, float],
    progress: Report | None = None,
    engine: str | None = None,
    memory: StageMemory | None = None,
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
        memory: of latent stages, which take a minute where others take a second: one that it knows is not run
            again, and counts with the seconds it took.

    Stages that move no map are passed over.

    Returns:
        The material and the losses of every stage. If the recipe has no iterations, or a material at the very
        ends of its range (`refine.parametrization`) explains the photos better than what the stages found,
        it is the initialization itself, untouched; but not after a latent stage.

    Raises:
        ValueError: a light is missing.
        StagesStopped: it was interrupted; it holds the best so far.
    """
    photos = [captures] if isinstance(captures, Capture) else list(captures)
    device = initial.normal.device
    start = _distance(initial, photos)
    losses = {"initialization": [start]}
    if recipe.iterations == 0:
        return initial, losses
    engine = choose_engine(engine, device.type)
    parameters = Parameters.from_svbrdf(initial)
    finished = 0
    for stage in recipe.stages:
        if not stage.moves:
            continue
        count = sum(name.split(" ")[0] == stage.name for name in losses)
        label = f"{stage.name} {count + 1}" if count else stage.name
        clock = time.perf_counter()

        def tell(iteration: int, loss: float, name: str = label, before: int = finished) -> None:
            if progress is not None:
                progress(name, before + iteration, recipe.iterations, loss)

        run = partial(_run_stage, stage, parameters, photos, tell, engine)
        try:
            if memory is not None and isinstance(stage, LatentStage):
                found = memory.outcome(stage, parameters, photos, engine, run)
            else:
                found = run()
        except KeyboardInterrupt as interrupt:
            if isinstance(interrupt, Stopped):
                parameters, losses[label] = interrupt.parameters, interrupt.history
            seconds[label] = time.perf_counter() - clock
            raise StagesStopped(_better(initial, parameters, photos, start), losses) from None
        parameters, losses[label], seconds[label] = found.parameters, list(found.history), found.seconds
        if isinstance(stage, LatentStage):
            # It left the initialization for what a decoder can make, which may well explain the photos worse.
            start = math.inf
        finished += stage.iterations
    return _better(initial, parameters, photos, start), losses


class StagesStopped(KeyboardInterrupt):
    """A recipe was interrupted.

    Attributes:
        svbrdf: the best so far: of the last stage that is done, or of the one at work if its engine can say.
        losses: of the stages so far.
    """

    def __init__(self, svbrdf: SVBRDF, losses: dict[str, list[float]]) -> None:
        """Keep what was reached."""
        super().__init__()
        self.svbrdf, self.losses = svbrdf, losses


def _better(initial: SVBRDF, parameters: Parameters, photos: Sequence[Capture], start: float) -> SVBRDF:
    refined = parameters.svbrdf()
    return initial if _distance(refined, photos) > start else refined


def _distance(svbrdf: SVBRDF, photos: Sequence[Capture]) -> float:
    return sum(distance_in_bands(svbrdf, photo) for photo in photos)


def _run_stage(
    stage: Stage, start: Parameters, photos: Sequence[Capture], tell: Progress, engine: str
) -> Outcome:
    clock = time.perf_counter()
    parameters, history = _descend(stage, start, photos, tell, engine)
    return Outcome(parameters, history, time.perf_counter() - clock)


def _descend(
    stage: Stage, start: Parameters, photos: Sequence[Capture], tell: Progress, engine: str
) -> tuple[Parameters, list[float]]:
    if isinstance(stage, PosteriorStage):
        posterior = find_solve(engine)(
            start,
            photos,
            iterations=stage.iterations,
            widths=stage.widths.moving(),
            noise=stage.noise,
            huber=stage.huber,
            progress=tell,
        )
        return posterior.parameters, posterior.history
    if isinstance(stage, LatentStage):
        return descend_latent(start, photos, stage, engine, tell)
    height, width = start.normal.shape[-2:]
    offsets = {name: zero.to(start.normal.device) for name, zero in stage.offsets(height, width).items()}
    descended: tuple[Parameters, list[float]] = find_descend(engine)(
        start, offsets, photos, iterations=stage.iterations, rates=stage.rates.moving(), progress=tell
    )
    return descended
