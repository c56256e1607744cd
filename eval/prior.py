"""How far a network's maps are from the truth on materials it was not trained on: the widths of a prior.

Errors are measured in the parameters that refinement moves (`refine.parametrization`), on the part of a pool
that training holds out (training licence, simulated flash photos, centred). What all pixels of a
neighbourhood share is the global stage's business; the posterior stage moves pixels one by one, so its prior
is as wide as the errors are *around their local mean*.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from eval.report import provenance
from nets.data.materials import open_materials
from nets.data.photography import FlashPhotography
from nets.svbrdf import MAPS
from refine.initialization import NETWORK_SIZE, initialize
from refine.parametrization import PARAMETER_COUNTS, Parameters
from refine.refiner import Refiner
from refine.train import batch_source

NEIGHBOURHOOD = 33
"""Side of the squares that local means are taken over, pixels of 256."""

NORMAL_CONSISTENCY = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

CENTRED = FlashPhotography(centred_share=1.0, exposure_share=0.0, falloff_share=0.0)
"""Photos as the evaluation takes them."""

main = typer.Typer(add_completion=False)


@main.command()
def measure(
    data: Annotated[Path, typer.Option(help="Pool or strips; the part held out of training is used.")],
    init: Annotated[str, typer.Option(help="Checkpoint: a shipped name or a file.")] = "default",
    count: Annotated[int, typer.Option(min=1, help="Materials.")] = 48,
    seed: Annotated[int, typer.Option(min=0, help="Of materials and photos.")] = 0,
) -> None:
    """Print the widths of the prior, per map: around the local mean, and of the local means themselves."""
    errors = measure_errors(Refiner(init), data, count, seed)
    fine, coarse = split(errors)
    about = provenance()
    print(f"{count} held-out materials of {data}, {init}, seed {seed}, {about['commit']}, {about['machine']}")
    for name, first in zip(MAPS, _first_channels(), strict=True):
        channels = slice(first, first + PARAMETER_COUNTS[name])
        print(f"{name:10s} fine {width(fine[:, channels]):.3f}  coarse {width(coarse[:, channels]):.3f}")


@torch.no_grad()
def measure_errors(refiner: Refiner, data: Path, count: int, seed: int) -> Float[Tensor, "count 9 256 256"]:
    """Return the errors of a refiner's initialization in refinement's parameters."""
    source = batch_source(open_materials(data, "validation"), None, CENTRED)
    generator = torch.Generator().manual_seed(seed)
    errors = []
    for _ in range(count):
        batch = source(1, NETWORK_SIZE, generator)
        initial, _light = initialize(refiner.model, batch.photo)
        truth, found = (Parameters.from_svbrdf(svbrdf) for svbrdf in (batch.truth, initial))
        errors.append(torch.cat([getattr(truth, name) - getattr(found, name) for name in MAPS], dim=1))
    return torch.cat(errors)


def split(errors: Float[Tensor, "n 9 h w"]) -> tuple[Float[Tensor, "n 9 h w"], Float[Tensor, "n 9 h w"]]:
    """Return errors around their local means, and the means."""
    coarse = functional.avg_pool2d(errors, NEIGHBOURHOOD, 1, NEIGHBOURHOOD // 2, count_include_pad=False)
    return errors - coarse, coarse


def width(errors: Tensor) -> float:
    """Return the robust standard deviation: most pixels' error, not that of materials that went wrong."""
    return NORMAL_CONSISTENCY * float(errors.abs().median())


def _first_channels() -> list[int]:
    counts = [PARAMETER_COUNTS[name] for name in MAPS]
    return [sum(counts[:index]) for index in range(len(counts))]


if __name__ == "__main__":
    main()
