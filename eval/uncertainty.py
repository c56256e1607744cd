"""Is uncertainty worth its name? Rank correlation of deviations with true errors, and the fit of their model.

`fit` uses the part of a pool that training holds out (training licence); `measure` the development sets. Both
take pixels at random, the same number of every material, refined by the recipe `default`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from jaxtyping import Float, Int
from scipy.stats import spearmanr
from torch import Tensor

from eval.datasets import YARDSTICK, input_photo
from eval.development import DEVELOPMENT, read_scenes, require
from eval.prior import CENTRED
from eval.report import Results, markdown_table, number, origin, provenance
from nets.data.materials import open_materials
from nets.svbrdf import MAPS, SVBRDF
from refine.expected_error import ERROR_FLOOR, ErrorModel, features, standardise, with_means
from refine.initialization import NETWORK_SIZE
from refine.refiner import Refined, Refiner
from refine.train import batch_source
from refine.uncertainty import deviations

PIXELS = 500
"""Drawn from every material."""

RIDGE = 0.03
"""Penalty of the squared weights, times the number of pixels: neighbouring features say much the same."""

main = typer.Typer(add_completion=False)


@dataclass(frozen=True)
class ScoredMaterial:
    """Errors and deviations of some pixels of one material, `[PIXELS, 4]` in the order of `MAPS`."""

    set: str
    scene: str
    errors: list[list[float]]
    deviations: list[list[float]]


class UncertaintyResults(Results[ScoredMaterial]):
    """What the table is made of."""

    def rows(self) -> list[dict[str, Any]]:
        """Return, by set and for all, Spearman's correlation and the ratio of both root mean squares."""
        rows = []
        sets = list(dict.fromkeys(material.set for material in self.scored))
        for name in (*sets, "all"):
            chosen = [material for material in self.scored if name in (material.set, "all")]
            errors, found = (
                torch.tensor([row for material in chosen for row in getattr(material, key)])
                for key in ("errors", "deviations")
            )
            row: dict[str, Any] = {"set": name, "materials": len(chosen)}
            for index, key in enumerate(MAPS):
                row[f"{key}_rank"] = float(spearmanr(found[:, index], errors[:, index]).statistic)
                row[f"{key}_ratio"] = float(rms(errors[:, index]) / rms(found[:, index]))
            rows.append(row)
        return rows


@main.command()
def fit(
    data: Annotated[Path, typer.Option(help="Pool or strips; the part held out of training is used.")],
    out: Annotated[Path, typer.Option(help="The model, JSON.")] = Path("refine/error_model.json"),
    init: Annotated[str, typer.Option(help="Checkpoint: a shipped name or a file.")] = "default",
    count: Annotated[int, typer.Option(min=2, help="Materials.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Of materials, photos and pixels.")] = 0,
) -> None:
    """Fit the model of expected errors, and write it."""
    about = {"data": data.name, "init": init, "materials": count, "seed": seed, **provenance()}
    model = fit_model(Refiner(init), data, count, seed, about)
    model.save(out)
    print(f"{out}: scales " + ", ".join(f"{name} {value:.2f}" for name, value in model.scale.items()))


@main.command()
def measure(
    data: Annotated[Path, typer.Option(help="Folder of the development sets.")],
    out: Annotated[Path, typer.Option(help="Folder for uncertainty.md and .json.")] = Path("docs/results"),
    init: Annotated[str, typer.Option(help="Checkpoint: a shipped name or a file.")] = "default",
    scenes: Annotated[int | None, typer.Option(min=1, help="So many of each set.")] = None,
) -> None:
    """Compare deviations with errors on the development sets, and write the table."""
    results = evaluate_uncertainty(Refiner(init), data, scenes)
    results.settings |= {"init": init, **provenance()}
    markdown = uncertainty_markdown(results)
    out.mkdir(parents=True, exist_ok=True)
    (out / "uncertainty.md").write_text(markdown, encoding="utf-8")
    print(markdown)


def fit_model(refiner: Refiner, data: Path, count: int, seed: int, about: dict[str, Any]) -> ErrorModel:
    """Regress the logarithm of errors on features, then scale deviations to the errors' size."""
    results = list(held_out(refiner, data, count, seed))
    seen, errors = [], []
    for truth, refined, pixels in results:
        seen.append(with_means(features(refined.initial, refined.svbrdf, refined.capture))[pixels])
        errors.append(map_errors(refined.svbrdf, truth)[pixels])
    x, y = torch.cat(seen).double(), torch.cat(errors).double()
    mean, deviation = x.mean(dim=0), x.std(dim=0).clamp(min=1e-6)
    scores = standardise(x, mean, deviation)
    normal = scores.T @ scores + RIDGE * len(scores) * torch.eye(scores.shape[1]).double()
    weights = torch.linalg.solve(normal, scores.T @ (y + ERROR_FLOOR).log())
    model = ErrorModel(
        mean=_rounded(mean),
        deviation=_rounded(deviation),
        weights={name: _rounded(weights[:, index]) for index, name in enumerate(MAPS)},
        scale=dict.fromkeys(MAPS, 1.0),
        origin=about,
    )
    found = torch.cat([stacked(refined, model)[pixels] for _, refined, pixels in results])
    ratios = rms(y) / rms(found.double())
    return replace(model, scale=dict(zip(MAPS, _rounded(ratios), strict=True)))


def held_out(
    refiner: Refiner, data: Path, count: int, seed: int
) -> Iterator[tuple[SVBRDF, Refined, Int[Tensor, "500"]]]:
    """Yield held-out materials, what refinement makes of their photos, and pixels to look at."""
    source = batch_source(open_materials(data, "validation"), None, CENTRED)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(count):
        truth = source(1, NETWORK_SIZE, generator).truth
        photo, light = input_photo(truth)
        yield truth, refiner.fit(photo[0], light=light, color_space="linear"), _draw(truth, generator)


def evaluate_uncertainty(refiner: Refiner, data: Path, scenes: int | None = None) -> UncertaintyResults:
    """Score the deviations of every development material.

    Raises:
        DataError: if a set's folder is missing or empty. Unreadable scenes are recorded and skipped.
    """
    require(data, DEVELOPMENT)
    results = UncertaintyResults(settings={"scenes": scenes})
    generator = torch.Generator().manual_seed(YARDSTICK.seed)
    protocol = replace(YARDSTICK, lights=1)
    for test_set, scene in read_scenes(data, DEVELOPMENT, protocol, scenes, results.skipped):
        refined = refiner.fit(scene.photo[0], light=scene.photo_light, color_space="linear")
        pixels = _draw(scene.truth, generator)
        errors = map_errors(refined.svbrdf, scene.truth)[pixels]
        found = stacked(refined)[pixels]
        results.scored.append(ScoredMaterial(test_set.name, scene.name, errors.tolist(), found.tolist()))
    return results


def map_errors(estimate: SVBRDF, truth: SVBRDF) -> Float[Tensor, "pixels 4"]:
    """Return the root mean square error over channels of each map, by pixel."""
    errors = [(getattr(estimate, name) - getattr(truth, name)).square().mean(dim=1).sqrt() for name in MAPS]
    return torch.stack([error.flatten() for error in errors], dim=1)


def stacked(refined: Refined, model: ErrorModel | None = None) -> Float[Tensor, "pixels 4"]:
    """Return a result's deviations by pixel."""
    found = deviations(refined.initial, refined.svbrdf, refined.captures, model)
    return torch.stack([found[name].flatten() for name in MAPS], dim=1)


def uncertainty_markdown(results: UncertaintyResults) -> str:
    """Return caption and table."""
    heads = ["set", "materials", *(f"{name}, rank" for name in MAPS), *(f"{name}, ratio" for name in MAPS)]
    rows = [
        [
            row["set"],
            str(row["materials"]),
            *(number(row[f"{name}_rank"], 2) for name in MAPS),
            *(number(row[f"{name}_ratio"], 2) for name in MAPS),
        ]
        for row in results.rows()
    ]
    caption = (
        f"Deviations of refined maps beside their errors, {PIXELS} pixels of each material, light known, "
        f"recipe `default`, checkpoint {results.settings.get('init', '?')}: Spearman's rank correlation over "
        "all pixels of a set, and the ratio of the errors' root mean square to the deviations' (1 is "
        "calibrated); "
        f"{origin(results.settings)}."
    )
    return "\n".join([caption, "", *markdown_table(heads, rows, 1), ""])


def rms(values: Tensor) -> Tensor:
    """Return the root mean square over the first axis."""
    return values.square().mean(dim=0).sqrt()


def _draw(material: SVBRDF, generator: torch.Generator) -> Int[Tensor, "500"]:
    height, width = material.size
    return torch.randperm(height * width, generator=generator)[:PIXELS]


def _rounded(values: Tensor) -> tuple[float, ...]:
    return tuple(float(f"{value:.5g}") for value in values.tolist())


if __name__ == "__main__":
    main()
