"""Figures that set rows beside each other and the truth: the paper's Fig. 4, 5, 8, 9, 10, 11 and 13."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from eval.datasets import CAMERA, Scene
from eval.figures.answers import Answers
from eval.figures.sheet import Picture, Sheet, as_seen, grid, map_picture
from eval.metrics import map_rmse, rendering_lpips, rendering_rmse
from eval.real import exposure
from eval.real_scenes import CAMERA as CAMERA_AT_FLASH
from eval.real_scenes import RealScene
from losses.perceptual import LPIPS
from nets.render import PointLight, render
from nets.svbrdf import MAPS, SVBRDF

LIGHTS = 3
"""Novel lights of a scene that are shown: the first ones of the protocol."""

NO_WEIGHTS = "no weights"


def maps(answers: Answers, index: int, names: Sequence[str]) -> Sheet:
    """Fig. 4: the four maps of one known material, the truth and every row's; below, their RMSE."""
    scene: Scene = answers.scene(index)
    materials = [_svbrdf(answers, name, index) for name in names]
    lines = []
    for map_name in MAPS:
        pictures = [_map(material, map_name, scene.truth) for material in materials]
        lines.append((map_name, [_map(scene.truth, map_name), *pictures]))
    return grid(("truth", *names), lines)


def renderings(answers: Answers, indices: Sequence[int], names: Sequence[str], lpips: LPIPS) -> Sheet:
    """Fig. 5: known materials under novel lights; below, RMSE and LPIPS of each picture."""
    lines = []
    for index in indices:
        scene: Scene = answers.scene(index)
        for number in range(LIGHTS):
            light = scene.lights[number : number + 1]
            truth = render(scene.truth, light, CAMERA)
            photo = Picture(as_seen(scene.photo), scene.name) if number == 0 else Picture(None)
            pictures = [photo, Picture(as_seen(truth))]
            for name in names:
                pictures.append(_compared(_lit(answers, name, index, light), truth, lpips))
            lines.append((f"light {number + 1}", pictures))
    return grid(("photo", "truth", *names), lines, begins=range(0, len(lines), LIGHTS))


def real_renderings(answers: Answers, indices: Sequence[int], names: Sequence[str], lpips: LPIPS) -> Sheet:
    """Fig. 8: real surfaces under lights of photos that were held out; below, RMSE and LPIPS."""
    lines = []
    for index in indices:
        scene: RealScene = answers.scene(index)
        for number in _spread_lights(scene):
            truth = scene.held_out[number : number + 1]
            photo = Picture(as_seen(scene.photo.linear), scene.name) if number == 0 else Picture(None)
            pictures = [photo, Picture(as_seen(truth))]
            pictures += [_compared(_real(answers, name, index, number), truth, lpips) for name in names]
            lines.append((f"photo {number + 1}", pictures))
    begins = [number for number, (_, pictures) in enumerate(lines) if pictures[0].image is not None]
    return grid(("given", "held out", *names), lines, begins)


def two_rows(answers: Answers, indices: Sequence[int], names: Sequence[str], lpips: LPIPS) -> Sheet:
    """Fig. 9, 10, 11, 13: maps and one rendering of every row, below the truth as far as it is known.

    Below maps their RMSE, below renderings RMSE and LPIPS.
    """
    lines = []
    for index in indices:
        scene = answers.scene(index)
        known = scene.truth if isinstance(scene, Scene) else None
        lines.append(("photo" if known is None else "truth", _truth_line(scene, known)))
        truth = _truth_rendering(scene)
        for name in names:
            material = _svbrdf(answers, name, index)
            pictures = [Picture(None), *(_map(material, map_name, known) for map_name in MAPS)]
            pictures.append(_compared(_rendering(answers, name, index), truth, lpips))
            lines.append((name, pictures))
    return grid(("photo", *MAPS, "rendering"), lines, begins=range(0, len(lines), 1 + len(names)))


def worst(answers: Answers, indices: Sequence[int], name: str, count: int, lpips: LPIPS) -> list[int]:
    """Return the scenes on which a row's LPIPS is highest, the worst first (Fig. 13)."""
    scores = {}
    for index in indices:
        refined = answers.of(name, index)
        if refined is not None:
            scores[index] = answers.yardstick.score(answers.scene(index), refined, lpips)["lpips"]
    return sorted(scores, key=lambda index: -scores[index])[:count]


def _svbrdf(answers: Answers, name: str, index: int) -> SVBRDF | None:
    refined = answers.of(name, index)
    return None if refined is None else refined.svbrdf


def _map(material: SVBRDF | None, name: str, truth: SVBRDF | None = None) -> Picture:
    """Return a map, and its RMSE where the truth is known."""
    if material is None:
        return Picture(None, NO_WEIGHTS)
    error = "" if truth is None else f"{float(map_rmse(material, truth)[name]):.3f}"
    return Picture(map_picture(material, name), error)


@torch.no_grad()
def _compared(rendered: torch.Tensor | None, truth: torch.Tensor, lpips: LPIPS) -> Picture:
    if rendered is None:
        return Picture(None, NO_WEIGHTS)
    errors = rendering_rmse(rendered, truth), rendering_lpips(rendered, truth, lpips)
    return Picture(as_seen(rendered), f"{errors[0]:.3f} / {errors[1]:.3f}")


def _rendering(answers: Answers, name: str, index: int) -> torch.Tensor | None:
    scene = answers.scene(index)
    if isinstance(scene, RealScene):
        return _real(answers, name, index, _spread_lights(scene)[0])
    return _lit(answers, name, index, scene.lights[:1])


def _lit(answers: Answers, name: str, index: int, light: PointLight) -> torch.Tensor | None:
    material = _svbrdf(answers, name, index)
    return None if material is None else render(material, light, CAMERA)


def _real(answers: Answers, name: str, index: int, number: int) -> torch.Tensor | None:
    scene: RealScene = answers.scene(index)
    material = _svbrdf(answers, name, index)
    if material is None:
        return None
    light = scene.held_out_lights[number : number + 1]
    return exposure(material, scene) * render(material, light, CAMERA_AT_FLASH)


def _truth_rendering(scene: Any) -> torch.Tensor:
    if isinstance(scene, RealScene):
        number = _spread_lights(scene)[0]
        return scene.held_out[number : number + 1]
    return render(scene.truth, scene.lights[:1], CAMERA)


def _truth_line(scene: Any, known: SVBRDF | None) -> list[Picture]:
    photo = scene.photo.linear if isinstance(scene, RealScene) else scene.photo
    maps_of_truth = [Picture(None, "not known") if known is None else _map(known, name) for name in MAPS]
    return [Picture(as_seen(photo), scene.name), *maps_of_truth, Picture(as_seen(_truth_rendering(scene)))]


def _spread_lights(scene: RealScene) -> list[int]:
    """Return two of the held-out photos: the first, and one from the middle of the list."""
    return sorted({0, len(scene.held_out) // 2})
