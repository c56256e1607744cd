"""Where was the flash? The light head, alone and after the light fit, on photos lit from off centre.

Every material of the development sets is photographed as in `datasets.py`, but with the flash elsewhere:
once in every band of angles, at distances as in training. The paper has pictures of this only (Fig. 6).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from eval.datasets import SIZE, Protocol, input_photo
from eval.development import DEVELOPMENT, TestSet, read_scenes, require
from eval.report import Results, markdown_table, number, origin, skipped_lines
from nets.data.photography import FlashPhotography
from nets.light_head import at_height
from refine.capture import Capture
from refine.initialization import initialize
from refine.light import fit_light
from refine.refiner import Refiner

Band = tuple[float, float]
"""Angles of the flash from the surface's normal, seen from the patch centre, degrees."""

BANDS: tuple[Band, ...] = ((0.0, 15.0), (15.0, 25.0), (25.0, 35.0), (35.0, 50.0))
"""Bands of angles; each material is photographed once in each."""

WITHIN: Band = (0.0, 35.0)
"""The bands in here are also told together: the paper finds its network robust up to there (Sec. 6.2)."""


@dataclass(frozen=True)
class LightScore:
    """How one estimate of one photo's light went.

    Attributes:
        method: what estimated it.
        set: of the material.
        scene: the material.
        angle: true one of the flash from the surface's normal, degrees.
        distance: true one from the patch centre, surface units.
        direction_error: angle between true and estimated direction from the patch centre, degrees.
        distance_error: of the estimated distance, as a share of the true one.
        direction_error_at_height: of the direction, once it is moved to the true height, see `at_height`.
            What is left is not about the height.
    """

    method: str
    set: str
    scene: str
    angle: float
    distance: float
    direction_error: float
    distance_error: float
    direction_error_at_height: float


class LightResults(Results[LightScore]):
    """What the table is made of."""

    def rows(self) -> list[dict[str, Any]]:
        """Return medians and 90th percentiles of the errors per method and band, then within `WITHIN`."""
        rows = []
        for method in dict.fromkeys(score.method for score in self.scored):
            for low, high in (*BANDS, WITHIN):
                found = [s for s in self.scored if s.method == method and low <= s.angle < high]
                if not found:
                    continue
                row: dict[str, Any] = {"method": method, "angles": [low, high], "photos": len(found)}
                for name in ("direction_error", "distance_error", "direction_error_at_height"):
                    median, most = np.percentile([getattr(score, name) for score in found], [50, 90])
                    row |= {f"{name}_median": float(median), f"{name}_90": float(most)}
                rows.append(row)
        return rows


LightEstimator = Callable[
    [Float[Tensor, "1 3 size size"]],
    Mapping[str, Float[Tensor, "3"]],
]
"""From a linear photo in [0, 1] to the light's position by method name."""


def light_estimator(refiners: Mapping[str, Refiner]) -> LightEstimator:
    """Return what every checkpoint's light head says, and where its recipe's light fit goes from there.

    Args:
        refiners: by the name of their checkpoint; their camera is the protocol's by default.
    """

    def estimate(photo: Float[Tensor, "1 3 size size"]) -> dict[str, Float[Tensor, "3"]]:
        found = {}
        for name, refiner in refiners.items():
            svbrdf, guess = initialize(refiner.model, photo)
            found[f"{name}, light head"] = guess.position[0]
            if refiner.recipe.light_fit is not None:
                unsaturated = (photo < 1.0).all(dim=1, keepdim=True)
                capture = Capture(photo, unsaturated, refiner.camera)
                fitted = fit_light(svbrdf, guess, capture, refiner.recipe.light_fit)
                found[f"{name}, fitted"] = fitted.position[0]
        return found

    return estimate


def off_centre(index: int, band: Band, seed: int = 0) -> Float[Tensor, "3"]:
    """Draw a flash's position.

    Its direction is cosine-weighted within the band; its distance is drawn as that of the training photos
    (`FlashPhotography`), whatever their angle.

    Args:
        index: of the photo; it alone, the band and the seed decide.
        band: of angles.
        seed: of the evaluation.
    """
    generator = torch.Generator().manual_seed(1_000_003 * seed + index)
    distance = torch.linalg.vector_norm(FlashPhotography().sample_lights(1, generator).position)
    low, high = (math.sin(math.radians(angle)) ** 2 for angle in band)
    u, v = torch.rand(2, generator=generator).tolist()
    sine = math.sqrt(low + (high - low) * u)
    x, y = sine * math.cos(2.0 * math.pi * v), sine * math.sin(2.0 * math.pi * v)
    return distance * torch.tensor([x, y, math.sqrt(1.0 - sine**2)])


def light_errors(estimate: Float[Tensor, "3"], truth: Float[Tensor, "3"]) -> tuple[float, float]:
    """Return the angle between two positions seen from the centre, degrees, and the distance's error.

    Args:
        estimate: position.
        truth: position; the distance's error is a share of its distance.
    """
    a, b = estimate.double(), truth.double()
    angle = torch.atan2(torch.linalg.vector_norm(torch.linalg.cross(a, b)), torch.dot(a, b))
    ratio = torch.linalg.vector_norm(a) / torch.linalg.vector_norm(b)
    return math.degrees(float(angle)), abs(float(ratio) - 1.0)


def evaluate_lights(
    estimate: LightEstimator,
    data: Path,
    sets: Sequence[TestSet] = DEVELOPMENT,
    size: int = SIZE,
    seed: int = 0,
    scenes: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> LightResults:
    """Photograph every material once in every band and score what methods say of the light.

    Args:
        estimate: the methods.
        data: folder that holds the sets.
        sets: which.
        size: pixels of the photos.
        seed: of the lights.
        scenes: so many of each set, evenly spread; all by default.
        progress: called with each scene's name once it is done.

    Raises:
        DataError: if a set's folder is missing or empty. Unreadable scenes are recorded and skipped.
    """
    require(data, sets)
    results = LightResults(settings={"sets": [s.name for s in sets], "size": size, "seed": seed})
    protocol = Protocol(size=size, seed=seed)
    photos = 0
    for test_set, scene in read_scenes(data, sets, protocol, scenes, results.skipped):
        for band in BANDS:
            truth = off_centre(photos, band, seed)
            photos += 1
            x, y, z = truth.tolist()
            photo, _ = input_photo(scene.truth, (x, y, z))
            where = (math.degrees(math.atan2(math.hypot(x, y), z)), math.hypot(x, y, z))
            for method, position in estimate(photo).items():
                errors = light_errors(position, truth)
                told = light_errors(at_height(position[None], truth[None, 2])[0], truth)[0]
                results.scored.append(LightScore(method, test_set.name, scene.name, *where, *errors, told))
        if progress is not None:
            progress(scene.name)
    return results


def lights_markdown(results: LightResults) -> str:
    """Return the table in Markdown with its caption and the list of skipped scenes."""
    settings = results.settings
    caption = (
        f"Error of the flash's direction from the patch centre, and of its distance as a share of it, on "
        f"{', '.join(settings['sets'])}; {settings['size']} px; each material photographed once in every "
        f"band of angles, cosine-weighted within it, at distances as in training; white light without "
        f'falloff, photo clamped; "height told": moved to the true height, mirror image left where it was; '
        f"checkpoints {', '.join(settings.get('inits', '?'))}"
        f"{', averaged over four flips' if settings.get('flips') else ''}; seed {settings['seed']}; "
        f"{origin(settings)}."
    )
    rows = []
    for row in results.rows():
        low, high = row["angles"]
        cells = [number(row[f"direction_error_{part}"], 1) for part in ("median", "90")]
        cells += [number(100.0 * row[f"distance_error_{part}"], 0) for part in ("median", "90")]
        cells.append(number(row["direction_error_at_height_median"], 1))
        rows.append([row["method"], f"{low:.0f}-{high:.0f}", str(row["photos"]), *cells])
    heads = ["method", "degrees off centre", "photos", "direction, median (degrees)", "90 %"]
    heads += ["distance, median (%)", "90 %", "direction, height told"]
    return "\n".join([caption, "", *markdown_table(heads, rows, 2), *skipped_lines(results.skipped)]) + "\n"
