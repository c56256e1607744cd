"""Ablations of the `default` recipe: each ingredient taken away, or put another way, on the same scenes."""

from __future__ import annotations

import time
from dataclasses import replace

from eval.datasets import Scene
from eval.development import Estimate, Estimator, as_photo
from refine.refiner import Refiner
from refine.run import run_stages
from refine.stages import (
    LONG_GLOBAL,
    RECIPES,
    GlobalStage,
    PixelStage,
    PosteriorStage,
    Rates,
    Recipe,
    Stage,
    Widths,
)

_SHARED, _OWN = LONG_GLOBAL, PosteriorStage()


def _recipe(*stages: Stage) -> Recipe:
    return Recipe("ablation", None, stages)


def _widths(**changed: float) -> PosteriorStage:
    return replace(_OWN, widths=replace(_OWN.widths, **changed))


ABLATIONS: dict[str, Recipe] = {
    "paper": RECIPES["paper"],
    "fast": RECIPES["fast"],
    "default": RECIPES["default"],
    "without the global stage": _recipe(_OWN),
    "without the posterior stage": _recipe(_SHARED),
    "global without diffuse, as in the paper": _recipe(
        replace(_SHARED, rates=replace(_SHARED.rates, diffuse=0.0)), _OWN
    ),
    "global with roughness": _recipe(replace(_SHARED, rates=replace(_SHARED.rates, roughness=0.01)), _OWN),
    "global as long as in the paper": _recipe(replace(_SHARED, iterations=GlobalStage().iterations), _OWN),
    "global 2.5 times as long": _recipe(replace(_SHARED, iterations=400), _OWN),
    "Adam in place of Gauss-Newton": _recipe(_SHARED, PixelStage()),
    "roughness as free as measured": _recipe(_SHARED, _widths(roughness=0.18)),
    "roughness not per pixel": _recipe(_SHARED, _widths(roughness=0.0)),
    "diffuse as narrow as measured": _recipe(_SHARED, _widths(diffuse=0.12)),
    "normals not per pixel": _recipe(_SHARED, _widths(normal=0.0)),
    "all widths twice as large": _recipe(
        _SHARED,
        replace(_OWN, widths=Widths(**{name: 2 * width for name, width in _OWN.widths.moving().items()})),
    ),
    "without Huber's robustness": _recipe(_SHARED, replace(_OWN, huber=1e6)),
    "twice the noise": _recipe(_SHARED, replace(_OWN, noise=2 * _OWN.noise)),
    "slower global": _recipe(replace(_SHARED, rates=Rates(diffuse=0.01, specular=0.01)), _OWN),
}
"""Rows of the table by name."""

UNTOLD: dict[str, Recipe] = {
    "light not told": RECIPES["default"],
    "light neither told nor fitted": replace(RECIPES["default"], light_fit=None),
}
"""Rows of the whole recipe where the photo's light has to be found, or is what the network says."""


def ablation_estimator(refiner: Refiner) -> Estimator:
    """Return the initialization and what every ablation makes of it; but for `UNTOLD`, the light is given."""
    finding = {name: Refiner(refiner.model, recipe, camera=refiner.camera) for name, recipe in UNTOLD.items()}

    def estimate(scene: Scene) -> dict[str, Estimate]:
        start = refiner.fit(as_photo(scene), light=scene.photo_light, iters=0)
        found = {"initialization": Estimate(start.initial, start.seconds["initialization"])}
        for name, recipe in ABLATIONS.items():
            clock = time.perf_counter()
            svbrdf, _ = run_stages(start.initial, start.capture, recipe, {}, None, refiner.engine)
            found[name] = Estimate(svbrdf.detach(), time.perf_counter() - clock)
        for name, unaided in finding.items():
            refined = unaided.fit(as_photo(scene))
            found[name] = Estimate(refined.svbrdf, sum(refined.seconds.values()))
        return found

    return estimate
