"""Where were the flashes? Self-calibration on scenes of several photos whose lights were measured.

Nothing but the photos is given. Errors are distances between the found and the measured light, as shares of
the measured one's distance from the surface's centre.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from eval.report import Results, markdown_table, number, origin, skipped_lines
from nets.data.images import DataError
from nets.data.photos import Scene, read_scene
from refine.errors import UserError
from refine.refiner import Refiner

BAR = 0.08
"""Largest error of a light that counts as found."""


@dataclass(frozen=True)
class FoundLight:
    """How one photo's light was found.

    Attributes:
        scene: name.
        photo: file name.
        distance: measured, from the surface's centre, surface units.
        error: of the position, as a share of the distance.
        sideways_error: of x and y alone, likewise.
        height_ratio: found height over measured.
    """

    scene: str
    photo: str
    distance: float
    error: float
    sideways_error: float
    height_ratio: float


class CalibrationResults(Results[FoundLight]):
    """What the table is made of."""

    def rows(self) -> list[dict[str, Any]]:
        """Return means and extremes per scene."""
        rows = []
        for scene in dict.fromkeys(light.scene for light in self.scored):
            found = [light for light in self.scored if light.scene == scene]
            errors = np.array([light.error for light in found])
            rows.append(
                {
                    "scene": scene,
                    "lights": len(found),
                    "within": int((errors <= BAR).sum()),
                    "mean": float(errors.mean()),
                    "largest": float(errors.max()),
                    "sideways": float(np.mean([light.sideways_error for light in found])),
                    "height_ratio": float(np.exp(np.mean(np.log([light.height_ratio for light in found])))),
                }
            )
        return rows


def measured_scenes(folder: Path) -> list[Scene]:
    """Return the scenes in a folder whose lights were measured.

    Raises:
        DataError: it is missing or holds none.
    """
    if not folder.is_dir():
        raise DataError(f"{folder} is not a folder")
    scenes = [read_scene(path) for path in sorted(folder.iterdir()) if path.is_dir()]
    found = [scene for scene in scenes if scene.measured]
    if not found:
        raise DataError(f"{folder} holds no scene whose lights were measured")
    return found


LightsFinder = Callable[[Sequence[Path]], Float[Tensor, "photos 3"]]
"""From photos of one surface to the positions of their lights."""


def lights_finder(refiner: Refiner) -> LightsFinder:
    """Return what a refiner finds; its model starts the material, its recipe is not run."""

    def find(photos: Sequence[Path]) -> Float[Tensor, "photos 3"]:
        refined = refiner.fit_many(photos, iters=0)
        lights = [capture.light for capture in refined.captures]
        return torch.cat([light.position.cpu() for light in lights if light is not None])

    return find


def evaluate_calibration(
    find: LightsFinder, scenes: Sequence[Scene], progress: Callable[[str], None] | None = None
) -> CalibrationResults:
    """Find the lights of every scene.

    Args:
        find: the method.
        scenes: with measured lights. Those that cannot be used are recorded and skipped.
        progress: called with each scene's name once it is done.
    """
    results = CalibrationResults()
    for scene in scenes:
        try:
            positions = find(scene.photos)
        except UserError as error:
            results.skipped[scene.name] = str(error)
        else:
            results.scored += _scores(scene, positions)
        if progress is not None:
            progress(scene.name)
    return results


def _scores(scene: Scene, positions: Float[Tensor, "photos 3"]) -> list[FoundLight]:
    assert scene.positions is not None
    truth = torch.from_numpy(scene.positions)
    distance = torch.linalg.vector_norm(truth, dim=1)
    error = torch.linalg.vector_norm(positions - truth, dim=1) / distance
    sideways = torch.linalg.vector_norm((positions - truth)[:, :2], dim=1) / distance
    height = positions[:, 2] / truth[:, 2]
    columns = (distance.tolist(), error.tolist(), sideways.tolist(), height.tolist())
    return [
        FoundLight(scene.name, photo.name, *values)
        for photo, values in zip(scene.photos, zip(*columns, strict=True), strict=True)
    ]


def calibration_markdown(results: CalibrationResults) -> str:
    """Return the tables in Markdown, per scene and per photo, with their caption."""
    settings = results.settings
    caption = (
        f"Self-calibration of lights, from the photos alone, against measured positions; errors as shares of "
        f"the light's distance; bar {100.0 * BAR:.0f} %; {settings.get('size', '?')} px; checkpoint "
        f"{settings.get('init', '?')}; {origin(settings)}."
    )
    heads = ["scene", "lights", "within the bar", "mean (%)", "largest (%)", "sideways (%)", "height ratio"]
    rows = [
        [
            row["scene"],
            str(row["lights"]),
            str(row["within"]),
            *(number(100.0 * row[name], 1) for name in ("mean", "largest", "sideways")),
            number(row["height_ratio"], 3),
        ]
        for row in results.rows()
    ]
    each = [
        [light.scene, light.photo, number(light.distance, 2), number(100.0 * light.error, 1)]
        for light in results.scored
    ]
    tables = [
        *markdown_table(heads, rows, 1),
        "",
        *markdown_table(["scene", "photo", "distance", "error (%)"], each, 2),
    ]
    return "\n".join([caption, "", *tables, *skipped_lines(results.skipped)]) + "\n"
