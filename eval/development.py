"""The development table: a checkpoint's initialization and its refinement on the development sets.

Layout of the data folder: `strips/des18_dev`, `strips/des19_dev`, `materials/dev`. What a scene is says
`datasets.py`, what a score is `metrics.py`; files and options are `cli.py`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from eval.datasets import CAMERA, YARDSTICK, Protocol, Scene, list_scenes, pbr_scenes, spread, strip_scenes
from eval.metrics import SceneScores, evaluate_material
from eval.report import Results, markdown_table, number, origin, skipped_lines
from losses.perceptual import LPIPS
from nets.data.images import DataError
from nets.svbrdf import SVBRDF
from refine.photo import Photo
from refine.refiner import Refiner


@dataclass(frozen=True)
class TestSet:
    """A folder of scenes: its name in tables, what it holds, where it is below the data folder."""

    name: str
    kind: Literal["strips", "pbr"]
    folder: str


DEVELOPMENT = (
    TestSet("des18_dev", "strips", "strips/des18_dev"),
    TestSet("des19_dev", "strips", "strips/des19_dev"),
    TestSet("materials_dev", "pbr", "materials/dev"),
)
"""The synthetic part of the development set."""

STRIPS = DEVELOPMENT[:2]
"""The two folders whose mean is the figure that issues speak of."""

STRIPS_MEAN = "mean of strips"
"""Table row: the mean of the two folders' means (not of their scenes: the folders weigh the same)."""


@dataclass(frozen=True)
class Estimate:
    """One method's answer for one scene, and the seconds it took."""

    svbrdf: SVBRDF
    seconds: float


Estimator = Callable[[Scene], Mapping[str, Estimate]]
"""From a scene (of which it may look at photo and photo_light only) to estimates by method name."""


@dataclass(frozen=True)
class ScoredScene:
    """One cell of evidence: which method, set and scene, its scores and the method's seconds."""

    method: str
    set: str
    scene: str
    scores: SceneScores
    seconds: float


class DevelopmentResults(Results[ScoredScene]):
    """What the development table is made of."""

    def rows(self) -> list[dict[str, Any]]:
        """Return table rows: scene count, mean scores and seconds per method and set, then the strips' mean.

        A set whose scenes could all not be read has count 0 and no scores; the mean over the strips is
        left out where a strip folder is not there.
        """
        methods = list(dict.fromkeys(entry.method for entry in self.scored))
        sets = self.settings.get("sets") or list(dict.fromkeys(entry.set for entry in self.scored))
        rows = []
        for method in methods:
            means: dict[str, SceneScores] = {}
            for name in sets:
                entries = [e for e in self.scored if (e.method, e.set) == (method, name)]
                row: dict[str, Any] = {"method": method, "set": name, "scenes": len(entries)}
                if entries:
                    means[name] = SceneScores.mean([entry.scores for entry in entries])
                    row |= asdict(means[name]) | {"seconds": sum(e.seconds for e in entries) / len(entries)}
                rows.append(row)
            strips = [means[s.name] for s in STRIPS if s.name in means]
            if len(strips) == len(STRIPS):
                names = [s.name for s in STRIPS]
                count = sum(entry.method == method and entry.set in names for entry in self.scored)
                mean = asdict(SceneScores.mean(strips))
                rows.append({"method": method, "set": STRIPS_MEAN, "scenes": count} | mean)
        return rows


def evaluate(
    estimate: Estimator,
    data: Path,
    sets: Sequence[TestSet] = DEVELOPMENT,
    protocol: Protocol = YARDSTICK,
    scenes: int | None = None,
    lpips: LPIPS | None = None,
    progress: Callable[[str], None] | None = None,
) -> DevelopmentResults:
    """Run methods over test sets and score every estimate.

    Args:
        estimate: the methods.
        data: folder that holds the sets.
        sets: which.
        protocol: how scenes are made.
        scenes: so many of each set, evenly spread; all by default.
        lpips: the network; without it that column is NaN.
        progress: called with each scene's name once it is done.

    Raises:
        DataError: if a set's folder is missing or empty. Unreadable scenes are recorded and skipped.
    """
    require(data, sets)
    results = DevelopmentResults(settings={"sets": [s.name for s in sets], **asdict(protocol)})

    for test_set, scene in read_scenes(data, sets, protocol, scenes, results.skipped):
        for method, found in estimate(scene).items():
            scores = evaluate_material(found.svbrdf, scene.truth, scene.lights, CAMERA, lpips=lpips)
            results.scored.append(ScoredScene(method, test_set.name, scene.name, scores, found.seconds))
        if progress is not None:
            progress(scene.name)
    return results


def read_scenes(
    data: Path,
    sets: Sequence[TestSet],
    protocol: Protocol,
    scenes: int | None,
    skipped: dict[str, str],
) -> Iterator[tuple[TestSet, Scene]]:
    """Read the scenes of test sets one after the other; arguments as in `evaluate`.

    A scene that cannot be read becomes an entry of `skipped`: its set and name, and the reason.
    """
    for test_set in sets:

        def skip(name: str, error: DataError, prefix: str = test_set.name) -> None:
            skipped[f"{prefix}/{name}"] = str(error)

        read = pbr_scenes if test_set.kind == "pbr" else strip_scenes
        for scene in read(data / test_set.folder, protocol, scenes, skip):
            yield test_set, scene


def evaluate_predictor(
    predict: Callable[[Float[Tensor, "1 3 size size"]], SVBRDF],
    data: Path,
    scenes: int | None = None,
    *,
    lights: int = YARDSTICK.lights,
    size: int = YARDSTICK.size,
    lpips: bool | LPIPS = True,
    sets: Sequence[TestSet] = STRIPS,
) -> dict[str, dict[str, float]]:
    """Score a network's initialization, without refinement: development figures for a trainer.

    Args:
        predict: from a linear photo in [0, 1] to a material of the same size; called without gradients.
        data: folder that holds the sets.
        scenes: so many of each set, evenly spread; all by default.
        lights: novel lights per scene; fewer are faster and noisier.
        size: of photo and maps, pixels.
        lpips: whether to compute it; pass the network to load it only once.
        sets: which; the two strip folders by default.

    Returns:
        Mean scores (fields of `SceneScores`) by set name and under `mean`, over the sets.

    Raises:
        DataError: if a set is missing or one of its scenes cannot be read.
    """
    network = lpips if isinstance(lpips, LPIPS) else LPIPS() if lpips else None

    def estimate(scene: Scene) -> dict[str, Estimate]:
        clock = time.perf_counter()
        with torch.no_grad():
            svbrdf = predict(scene.photo)
        return {"initialization": Estimate(svbrdf, time.perf_counter() - clock)}

    results = evaluate(estimate, data, sets, Protocol(size=size, lights=lights), scenes, network)
    if results.skipped:
        raise DataError("; ".join(results.skipped.values()))
    means = {
        s.name: SceneScores.mean([entry.scores for entry in results.scored if entry.set == s.name])
        for s in sets
    }
    return {name: asdict(m) for name, m in {**means, "mean": SceneScores.mean(list(means.values()))}.items()}


def refinement_estimator(refiner: Refiner, iters: int | None, *, estimate_light: bool) -> Estimator:
    """Return the initialization and, if any iteration is asked for, the refinement on top of it.

    Args:
        refiner: model and recipe; its camera is the protocol's by default.
        iters: of the whole recipe; None takes the recipe's own.
        estimate_light: withhold the light of the photo (the paper's Table 1 gives it: centred).
    """
    total = refiner.recipe.iterations if iters is None else iters

    def estimate(scene: Scene) -> dict[str, Estimate]:
        light = None if estimate_light else scene.photo_light
        refined = refiner.fit(as_photo(scene), light=light, iters=total)
        first = Estimate(refined.initial, refined.seconds["initialization"])
        if total == 0:
            return {"initialization": first}
        name = f"{refiner.recipe.name}, {total} iterations"
        return {"initialization": first, name: Estimate(refined.svbrdf, sum(refined.seconds.values()))}

    return estimate


def as_photo(scene: Scene) -> Photo:
    """Return the scene's photo as refinement takes it; the pixels clamped to 1 are known to be saturated."""
    unsaturated = (scene.photo < 1.0).all(dim=1, keepdim=True)
    return Photo(scene.photo, unsaturated, notes=(), source=scene.name)


def require(data: Path, sets: Sequence[TestSet]) -> None:
    """Check that every set is there before anything is computed.

    Raises:
        DataError: naming the first folder that is missing or empty.
    """
    for test_set in sets:
        list_scenes(data / test_set.folder, test_set.kind)


def count_scenes(data: Path, sets: Sequence[TestSet], scenes: int | None) -> int:
    """Return how many scenes `evaluate` will read."""
    return sum(len(spread(len(list_scenes(data / s.folder, s.kind)), scenes)) for s in sets)


COLUMNS = {
    "N": "normal",
    "D": "diffuse",
    "R": "roughness",
    "S": "specular",
    "D gamma": "diffuse_gamma",
    "S gamma": "specular_gamma",
    "Ren": "rendering",
    "LPIPS": "lpips",
    "s/scene": "seconds",
}
"""Heads of the table's number columns and what they show."""


def caption(settings: Mapping[str, Any]) -> str:
    """Return one sentence that says how the figures came about."""
    light = "estimated" if settings.get("estimate_light") else "given"
    photo = (
        "stored with the strips where there is one" if settings["stored_input"] else "rendered, centred light"
    )
    return (
        f"RMSE (maps linear; D gamma, S gamma and renderings encoded with 1/2.2) and LPIPS v0.1 AlexNet on "
        f"{', '.join(settings['sets'])}; {settings['size']} px, {settings['lights']} novel lights per scene, "
        f"seed {settings['seed']}; photo {photo}, its light {light}; checkpoint {settings.get('init', '?')}"
        f"{', averaged over four flips' if settings.get('flips') else ''}; "
        f"{origin(settings)}."
    )


def markdown(results: DevelopmentResults) -> str:
    """Return the table in Markdown with its caption and the list of skipped scenes."""
    rows = []
    for row in results.rows():
        cells = [number(row.get(name), 1 if name == "seconds" else 3) for name in COLUMNS.values()]
        rows.append([row["method"], row["set"], str(row["scenes"]), *cells])
    table = markdown_table(["method", "set", "scenes", *COLUMNS], rows, texts=2)
    return "\n".join([caption(results.settings), "", *table, *skipped_lines(results.skipped)]) + "\n"
