"""`refine-train`: composes data, network, objective and trainer; the rim around `nets.trainer`."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated

import torch
import typer

from losses.objective import L1Objective
from nets.checkpoint import Record, save_model
from nets.data.augment import Augmentation, augment
from nets.data.photography import FlashPhotography
from nets.data.pool import MaterialPool, decode
from nets.generator import NARROW_GENERATOR, Generator, GeneratorConfig
from nets.trainer import Phase, Trainer, TrainerConfig, TrainingBatch

POOL_SHARES = {"procedural": 0.5, "pbr": 0.3, "infinigen": 0.2}
"""How often a training material is generated here, scanned, or baked with infinigen (many of those are plain)."""


def batch_source(
    pool: MaterialPool, augmentation: Augmentation, photography: FlashPhotography, shares: dict[str, float]
) -> object:
    """Return the trainer's source: pool -> augmentation -> simulated flash photo."""

    def source(batch: int, crop: int, generator: torch.Generator) -> TrainingBatch:
        material = decode(pool.sample(batch, generator, shares))
        truth = augment(material, generator, size=crop, settings=augmentation)
        photo, light = photography.take(truth, generator)
        return TrainingBatch(photo, truth, light)

    return source


def parse_phases(text: str) -> tuple[Phase, ...]:
    """Read `iterations:crop:batch,...`, for example `4000:128:8,2000:256:4`.

    Raises:
        ValueError: text of another form.
    """
    phases = []
    for part in text.split(","):
        iterations, crop, batch = (int(number) for number in part.split(":"))
        phases.append(Phase(iterations, crop, batch))
    return tuple(phases)


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def train(
    pool: Annotated[Path, typer.Option(help="Material pool written by `python -m nets.data.pool`.")],
    out: Annotated[Path, typer.Option(help="Folder of the run: state, weights, log.")],
    phases: Annotated[str, typer.Option(help="iterations:crop:batch, comma-separated.")] = "6000:128:8,5000:256:4",
    width: Annotated[int, typer.Option(help="Channels of the first layer; 64 in the paper.")] = NARROW_GENERATOR.width,
    levels: Annotated[int, typer.Option(help="Encoder levels; 8 in the paper.")] = NARROW_GENERATOR.levels,
    deep_multiplier: Annotated[
        int, typer.Option(help="Widest layer as a multiple of the width; 8 in the paper.")
    ] = NARROW_GENERATOR.deep_multiplier,
    learning_rate: Annotated[float, typer.Option(help="Adam's peak learning rate.")] = 8e-4,
    seed: Annotated[int, typer.Option(help="Seed of weights, data and dropout.")] = 0,
    threads: Annotated[int, typer.Option(help="CPU threads.")] = 2,
    resume: Annotated[bool, typer.Option(help="Continue from the run's state if there is one.")] = False,
    save_every: Annotated[int, typer.Option(help="Iterations between saved states.")] = 250,
    data_note: Annotated[list[str] | None, typer.Option(help="Data source and licence, for the header.")] = None,
) -> None:
    """Train a generator with the L1 objective and write `<out>/weights.safetensors`."""
    torch.set_num_threads(threads)
    config = TrainerConfig(phases=parse_phases(phases), learning_rate=learning_rate, seed=seed)
    architecture = GeneratorConfig(width, levels, deep_multiplier)
    torch.manual_seed(seed)
    objective = L1Objective()
    source = batch_source(MaterialPool(pool, part="train"), Augmentation(specular=0.4, exposure=0.4), FlashPhotography(), POOL_SHARES)
    trainer = Trainer(Generator(architecture), source, objective, config)  # type: ignore[arg-type]
    state = out / "state.pt"
    if resume and state.exists():
        trainer.resume(state)
    out.mkdir(parents=True, exist_ok=True)
    with (out / "log.jsonl").open("a") as log:
        while not trainer.done:
            trainer.step()
            if trainer.iteration % 50 == 0:
                line = {
                    "iteration": trainer.iteration,
                    "samples_per_second": round(trainer.samples / trainer.seconds, 2),
                    "time": time.strftime("%H:%M:%S"),
                    **{name: round(value, 5) for name, value in trainer.averages.items()},
                }
                log.write(json.dumps(line) + "\n")
                log.flush()
            if trainer.iteration % save_every == 0 or trainer.done:
                trainer.save(state)
                record = Record(architecture, trainer.record(), data_note or [])
                save_model(out / "weights.safetensors", trainer.average, record)


def main() -> None:
    """Run the console script."""
    app()


if __name__ == "__main__":
    main()
