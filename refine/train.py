"""`refine-train`: composes data, network, objective and trainer; the rim around `nets.trainer`.

Several processes share the work when started by torchrun (own batches, averaged gradients), for example
`torchrun --nproc-per-node 2 -m refine.train --pool ... --threads 1`.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

from losses.objective import L1Objective
from nets.checkpoint import Record, save_model
from nets.data import DataError
from nets.data.augment import Augmentation, augment
from nets.data.photography import FlashPhotography
from nets.data.pool import MaterialPool, decode
from nets.generator import NARROW_GENERATOR, Generator, GeneratorConfig
from nets.trainer import BatchSource, Phase, Trainer, TrainerConfig, TrainingBatch

POOL_SHARES = {"procedural": 0.5, "pbr": 0.3, "infinigen": 0.2}
"""How often a training material is generated here, scanned, or baked with infinigen (many are plain)."""

AUGMENTATION = Augmentation(specular=0.4, exposure=0.4)
"""Wider than the default in specular and albedo: few training materials lie between plastic and metal."""

DEFAULT_PHASES = "3500:128:8,3500:256:4"

LOG_EVERY = 50
"""Iterations between lines of the log."""


def batch_source(
    pool: MaterialPool,
    augmentation: Augmentation = AUGMENTATION,
    photography: FlashPhotography | None = None,
    shares: dict[str, float] | None = None,
) -> BatchSource:
    """Return the trainer's source: pool -> augmentation -> simulated flash photo.

    Args:
        pool: materials to draw from.
        augmentation: how they are varied.
        photography: how they are photographed.
        shares: how often each collection is drawn; those the pool lacks are left out. None draws every
            entry alike.
    """
    camera = photography or FlashPhotography()
    wanted = shares or {}
    held = {entry.collection if entry.collection in wanted else entry.kind for entry in pool.index}
    present = {name: share for name, share in wanted.items() if name in held} or None

    def source(batch: int, crop: int, generator: torch.Generator) -> TrainingBatch:
        material = decode(pool.sample(batch, generator, present))
        truth = augment(material, generator, size=crop, settings=augmentation)
        photo, light = camera.take(truth, generator)
        return TrainingBatch(photo, truth, light)

    return source


def parse_phases(text: str) -> tuple[Phase, ...]:
    """Read `iterations:crop:batch,...`, for example `4000:128:8,2000:256:4`.

    Raises:
        ValueError: text of another form.
    """
    try:
        phases = tuple(Phase(*(int(number) for number in part.split(":"))) for part in text.split(","))
        if min(number for phase in phases for number in asdict(phase).values()) < 1:
            raise ValueError
    except (TypeError, ValueError):
        raise ValueError(
            f"--phases {text!r} is not iterations:crop:batch,...; give for example {DEFAULT_PHASES}"
        ) from None
    return phases


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def train(
    pool: Annotated[Path, typer.Option(help="Material pool written by `python -m nets.data.pool`.")],
    out: Annotated[Path, typer.Option(help="Folder of the run: state, weights, log.")],
    phases: Annotated[str, typer.Option(help="iterations:crop:batch, comma-separated.")] = DEFAULT_PHASES,
    width: Annotated[int, typer.Option(help="First layer's channels; 64 in the paper.")] = (
        NARROW_GENERATOR.width
    ),
    levels: Annotated[int, typer.Option(help="Encoder levels; 8 in the paper.")] = NARROW_GENERATOR.levels,
    deep_multiplier: Annotated[
        int, typer.Option(help="Widest layer as a multiple of the width; 8 in the paper.")
    ] = NARROW_GENERATOR.deep_multiplier,
    shading_cues: Annotated[
        bool, typer.Option(help="Let the network see first-order shading cues; not in the paper.")
    ] = NARROW_GENERATOR.shading_cues,
    detail_channels: Annotated[
        int, typer.Option(help="Of the full-resolution layers; 0 as in the paper.")
    ] = NARROW_GENERATOR.detail_channels,
    learning_rate: Annotated[float, typer.Option(help="Adam's peak learning rate.")] = 8e-4,
    ema_decay: Annotated[float, typer.Option(help="Of the moving average that is written.")] = 0.999,
    seed: Annotated[int, typer.Option(help="Seed of weights, data and dropout.")] = 0,
    threads: Annotated[int, typer.Option(help="CPU threads of each process.")] = 1,
    resume: Annotated[bool, typer.Option(help="Continue from the run's state if there is one.")] = False,
    save_every: Annotated[int, typer.Option(help="Iterations between saved states.")] = 250,
    data_note: Annotated[
        list[str] | None, typer.Option(help="A data source and its licence, for the header; repeatable.")
    ] = None,
) -> None:
    """Train a generator with the L1 objective and write `<out>/weights.safetensors`."""
    torch.set_num_threads(threads)
    if "RANK" in os.environ:
        torch.distributed.init_process_group("gloo")
    try:
        config = TrainerConfig(
            phases=parse_phases(phases), learning_rate=learning_rate, ema_decay=ema_decay, seed=seed
        )
        architecture = GeneratorConfig(width, levels, deep_multiplier, shading_cues, detail_channels)
        for phase in config.phases:
            if phase.crop % architecture.multiple:
                raise ValueError(
                    f"--phases {phases!r} has a crop of {phase.crop} pixels; "
                    f"{levels} levels need multiples of {architecture.multiple}"
                )
        materials = MaterialPool(pool, part="train")
    except (DataError, ValueError) as error:
        typer.echo(f"refine-train: {error}", err=True)
        raise typer.Exit(2) from None

    torch.manual_seed(seed)
    objective, photography = L1Objective(), FlashPhotography()
    source = batch_source(materials, AUGMENTATION, photography, POOL_SHARES)
    trainer = Trainer(Generator(architecture), source, objective, config)
    state = out / "state.pt"
    if resume and state.exists():
        trainer.resume(state)
    trainer.diverge()
    settings = {
        "objective": asdict(objective),
        "photography": asdict(photography),
        "augmentation": asdict(AUGMENTATION),
        "shares": POOL_SHARES,
        "processes": trainer.world,
    }
    while not trainer.done:
        trainer.step()
        if trainer.rank > 0:
            continue
        if trainer.iteration % LOG_EVERY == 0:
            _log(out / "log.jsonl", trainer)
        if trainer.iteration % save_every == 0 or trainer.done:
            trainer.save(state)
            record = Record(architecture, {**trainer.record(), **settings}, data_note or [])
            save_model(out / "weights.safetensors", trainer.average, record)


def _log(path: Path, trainer: Trainer) -> None:
    line: dict[str, Any] = {
        "iteration": trainer.iteration,
        "samples_per_second": round(trainer.samples / trainer.seconds, 2),
        "time": time.strftime("%H:%M:%S"),
        **{name: round(value, 5) for name, value in trainer.averages.items()},
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as log:
        log.write(json.dumps(line) + "\n")


def main() -> None:
    """Run the console script."""
    app()


if __name__ == "__main__":
    main()
