"""The table of real scenes: one photo in, the others of the surface are the truth (paper Table 2).

Nothing says how brightly the flash shone or how long the camera was open, so every estimate's renderings are
exposed as the photo it was made from, by one number. What a scene is says `real_scenes.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from eval.development import Estimate
from eval.metrics import rendering_lpips, rendering_rmse
from eval.real_scenes import CAMERA, RELIABLE, Lights, RealScene, SceneLights, read_real_scenes
from eval.report import Results, markdown_table, number, origin, skipped_lines
from losses.perceptual import LPIPS
from nets.color import luminance
from nets.render import render
from nets.svbrdf import SVBRDF
from refine.refiner import Refiner

DARKEST = 1e-4
"""Luminance of a rendering below which it says nothing of the exposure."""

GROUPS: dict[str, tuple[Lights, ...]] = {
    "lights known": ("measured", "estimated"),
    "lights uncertain": ("uncertain",),
    "all": ("measured", "estimated", "uncertain"),
}
"""Table rows, and the scenes whose mean each is. Scenes of uncertain lights stand apart: where a light is
wrong, so is every rendering under it, of whatever material."""


@dataclass(frozen=True)
class RealScore:
    """How one estimate of one scene went.

    Attributes:
        method: what estimated it.
        scene: its name.
        lights_are: how well the scene's lights are known.
        given: file name of the photo that was given.
        angle: of that photo's light from the surface's normal, degrees.
        exposure: factor between renderings and photos, see `exposure`.
        rendering: RMSE over all photos that were not given, encoded with gamma 1/2.2.
        lpips: mean LPIPS over them; NaN if it was not asked for.
        seconds: that the method took.
    """

    method: str
    scene: str
    lights_are: Lights
    given: str
    angle: float
    exposure: float
    rendering: float
    lpips: float
    seconds: float


class RealResults(Results[RealScore]):
    """What the table is made of."""

    def rows(self) -> list[dict[str, Any]]:
        """Return one row per method and group that has scenes: their count, mean scores and seconds."""
        rows = []
        for method in dict.fromkeys(score.method for score in self.scored):
            for group, members in GROUPS.items():
                found = [s for s in self.scored if s.method == method and s.lights_are in members]
                if found:
                    means = {
                        name: math.fsum(getattr(score, name) for score in found) / len(found)
                        for name in ("rendering", "lpips", "seconds")
                    }
                    rows.append({"method": method, "scenes": group, "count": len(found), **means})
        return rows


Estimator = Callable[[RealScene], Mapping[str, Estimate]]
"""From a scene (of which it may look at photo and light only) to estimates by method name."""


def real_estimator(
    refiners: Mapping[str, Refiner], iters: int | None, *, match_exposure: bool = False
) -> Estimator:
    """Return every checkpoint's initialization and, if any iteration is asked for, its refinement.

    Args:
        refiners: by the name of their checkpoint; their camera should be `CAMERA`.
        iters: of the whole recipe; None takes the recipe's own.
        match_exposure: refine under a light as bright as the initialization needs it (`exposure`), not 1:
            what was merely exposed otherwise than in training need not be explained by the maps.
    """

    def estimate(scene: RealScene) -> dict[str, Estimate]:
        found = {}
        for name, refiner in refiners.items():
            total = refiner.recipe.iterations if iters is None else iters
            first = refiner.fit(scene.photo, light=scene.light, iters=0)
            seconds = first.seconds["initialization"]
            found[f"{name}, initialization"] = Estimate(first.initial, seconds)
            if total:
                factor = exposure(first.initial, scene) if match_exposure else 1.0
                light = replace(scene.light, intensity=factor * scene.light.intensity)
                refined = refiner.fit(scene.photo, light=light, iters=total)
                label = f"{name}, {refiner.recipe.name}, {total} iterations"
                found[label] = Estimate(refined.svbrdf, sum(refined.seconds.values()))
        return found

    return estimate


@torch.no_grad()
def exposure(svbrdf: SVBRDF, scene: RealScene) -> float:
    """Return the factor that exposes renderings of an estimate as the photo it was made from.

    The median over unsaturated pixels of the photo's luminance by the rendering's under the photo's light:
    highlights, shadows and texture that an estimate missed do not move it. What remains wrong with the
    brightness of the other photos is the material's fault.

    Args:
        svbrdf: a batch of one at the photo's size.
        scene: of which only the given photo is looked at.

    Returns:
        The factor; 1 if all pixels are saturated or black.
    """
    rendered = luminance(render(svbrdf, scene.light, CAMERA))
    counted = scene.photo.unsaturated & (rendered > DARKEST)
    if not bool(counted.any()):
        return 1.0
    return float((luminance(scene.photo.linear) / rendered)[counted].median())


@torch.no_grad()
def score_estimate(
    svbrdf: SVBRDF, scene: RealScene, lpips: LPIPS | None = None
) -> tuple[float, float, float]:
    """Return an estimate's exposure, and RMSE and LPIPS (NaN without the network) on the held-out photos.

    Args:
        svbrdf: a batch of one at the photo's size.
        scene: with the photos it is compared with.
        lpips: the network; None skips it.
    """
    factor = exposure(svbrdf, scene)
    rendered = factor * render(svbrdf, scene.held_out_lights, CAMERA)
    distance = math.nan if lpips is None else rendering_lpips(rendered, scene.held_out, lpips)
    return factor, rendering_rmse(rendered, scene.held_out), distance


def evaluate_real(
    estimate: Estimator,
    folder: Path,
    size: int,
    scenes: int | None = None,
    lpips: LPIPS | None = None,
    progress: Callable[[str], None] | None = None,
    lights: Mapping[str, SceneLights] | None = None,
) -> RealResults:
    """Run methods over the scenes of a folder and score every estimate.

    Args:
        estimate: the methods.
        folder: holds one folder per scene.
        size: longer side of photos and maps, pixels.
        scenes: so many, evenly spread; all by default.
        lpips: the network; without it that column is NaN.
        progress: called with each scene's name once it is done.
        lights: of scenes by name, in place of what their folders say.

    Raises:
        DataError: the folder is missing or empty. Unusable scenes are recorded and skipped.
    """
    results = RealResults(settings={"folder": folder.resolve().name, "size": size})
    for scene in read_real_scenes(folder, size, scenes, results.skipped, lights):
        x, y, z = scene.light.position[0].tolist()
        angle = math.degrees(math.atan2(math.hypot(x, y), z))
        given = Path(scene.photo.source).name
        for method, found in estimate(scene).items():
            scores = score_estimate(found.svbrdf, scene, lpips)
            results.scored.append(
                RealScore(method, scene.name, scene.lights_are, given, angle, *scores, found.seconds)
            )
        if progress is not None:
            progress(scene.name)
    return results


def caption(settings: Mapping[str, Any]) -> str:
    """Return a few sentences that say how the figures came about."""
    matched = settings.get("match_exposure")
    brightness = "as bright as the initialization needs it" if matched else "of intensity 1"
    flips = ", averaged over four flips" if settings.get("flips") else ""
    return (
        f"Photos of {settings['folder']} that were not given, {settings['size']} px: RMSE (one over all "
        f"photos of a scene, encoded with 1/2.2) and LPIPS v0.1 AlexNet, averaged over scenes. Given is "
        f"the photo whose light is most central, and that light, {brightness}. Camera at the flash, "
        f"inverse-square falloff; one exposure per estimate, the median ratio of the given photo to its "
        f"rendering. {_lights_caption(settings.get('lights'))} "
        f"Checkpoints {', '.join(settings.get('inits', '?'))}{flips}; seed {settings.get('seed', '?')}; "
        f"{origin(settings)}."
    )


def _lights_caption(file: str | None) -> str:
    if file is None:
        return f"Lights are uncertain where their calibration does not call itself {RELIABLE}."
    return f"Lights and every photo's exposure are those of {file}, uncertain where it does not believe them."


def real_markdown(results: RealResults) -> str:
    """Return the table of means, that of all scenes, the caption and the list of skipped scenes."""
    means = [
        [
            row["method"],
            row["scenes"],
            str(row["count"]),
            number(row["rendering"], 3),
            number(row["lpips"], 3),
            number(row["seconds"], 1),
        ]
        for row in results.rows()
    ]
    scores = [
        [
            score.scene,
            score.lights_are,
            f"{score.given}, {score.angle:.0f} degrees",
            score.method,
            number(score.exposure, 2),
            number(score.rendering, 3),
            number(score.lpips, 3),
        ]
        for score in results.scored
    ]
    lines = [
        caption(results.settings),
        "",
        *markdown_table(["method", "scenes", "count", "RMSE", "LPIPS", "s/scene"], means, texts=2),
        "",
        *markdown_table(
            ["scene", "lights", "given, off centre", "method", "exposure", "RMSE", "LPIPS"], scores, texts=4
        ),
        *skipped_lines(results.skipped),
    ]
    return "\n".join(lines) + "\n"
