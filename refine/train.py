"""`refine-train`: composes plan, data, networks, objective and trainer; the rim around `nets.trainer`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

from losses.score import build_critics
from losses.vgg_weights import load_vgg16
from losses.with_vgg import give_vgg, needs_vgg
from nets.architectures import build, continues
from nets.checkpoint import Record, load_network, save_model
from nets.data.augment import Augmentation, augment
from nets.data.images import DataError
from nets.data.materials import Materials, open_materials
from nets.data.pairs import PhotoPairs
from nets.data.photography import FlashPhotography
from nets.data.pool import Part
from nets.trainer import Trainer
from nets.training import BatchSource, TrainingBatch
from refine.team import FabricTeam, process_count
from refine.training_plan import PlanError, Stage, TrainingPlan, read_plan
from refine.training_watch import Watch

STATE = "state.pt"
"""In a stage's folder: all that is needed to go on."""

PARTS: tuple[Part, ...] = ("train", "validation")

LOG_EVERY = 50
"""Iterations between lines of the log and TensorBoard's scalars."""


def batch_source(
    materials: Materials,
    augmentation: Augmentation | None = None,
    photography: FlashPhotography | None = None,
    pairs: PhotoPairs | None = None,
    pair_count: int = 0,
    device: torch.device | None = None,
) -> BatchSource:
    """Return the trainer's source: material -> augmentation -> simulated flash photo, and real pairs.

    Args:
        materials: to draw from.
        augmentation: how they are varied.
        photography: how they are photographed.
        pairs: real photos of surfaces under two lights.
        pair_count: how many of them join a batch.
        device: where batches are computed on.
    """
    camera = photography or FlashPhotography()

    def source(batch: int, crop: int, generator: torch.Generator) -> TrainingBatch:
        truth = augment(materials.draw(batch, generator), generator, size=crop, settings=augmentation)
        photo, light = camera.take(truth, generator)
        real = pairs.sample(pair_count, crop, generator) if pairs is not None and pair_count else None
        return TrainingBatch(photo, truth, light, real).to(device or torch.device("cpu"))

    return source


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def train(
    config: Annotated[Path, typer.Option(help="Plan of the training, such as configs/narrow.yaml.")],
    data: Annotated[
        Path, typer.Option(help="Materials: a pool of `python -m nets.data.pool`, or a folder of strips.")
    ],
    out: Annotated[Path, typer.Option(help="Folder of the run; every stage gets one in it.")],
    pairs: Annotated[
        Path | None, typer.Option(help="Real pairs: a folder per surface, for hybrid stages.")
    ] = None,
    stage: Annotated[
        list[str] | None, typer.Option(help="Only these stages of the plan, in its order; repeatable.")
    ] = None,
    start: Annotated[
        Path | None, typer.Option(help="State (state.pt) or checkpoint that the first stage starts from.")
    ] = None,
    resume: Annotated[bool, typer.Option(help="Continue from the run's states where there are any.")] = False,
    steps: Annotated[
        int | None, typer.Option(help="Stop after so many iterations in all, as if interrupted.", min=1)
    ] = None,
    vgg: Annotated[Path | None, typer.Option(help="Weights of VGG-16; else those fetched before.")] = None,
    accelerator: Annotated[str, typer.Option(help="cpu, cuda or auto.")] = "auto",
    devices: Annotated[int, typer.Option(help="Processes on this machine, a device each.", min=1)] = 1,
    nodes: Annotated[int, typer.Option(help="Machines.", min=1)] = 1,
    threads: Annotated[int, typer.Option(help="CPU threads of each process.", min=1)] = 1,
    seed: Annotated[int, typer.Option(help="Of weights, data and dropout.")] = 0,
    save_every: Annotated[int, typer.Option(help="Iterations between saved states.", min=1)] = 250,
    data_note: Annotated[
        list[str] | None, typer.Option(help="A data source and its licence, for the header; repeatable.")
    ] = None,
) -> None:
    """Train the stages of a plan, each from the networks of the one before.

    Writes `weights.safetensors` (moving average), `state.pt`, `log.jsonl`, `samples.png` and a TensorBoard
    log to `<out>/<stage>/`.

    Example: refine-train --config configs/narrow.yaml --data runs/pool --out runs/mine --stage l1
    """
    try:
        # Everything that can be wrong is looked at first: before any process starts, and any hour is spent.
        plan = read_plan(config)
        stages = _chosen(plan, stage)
        _check_shards(stages, process_count(devices, nodes))
        origins = {one.name: _origin(one, plan, stages, out, start) for one in stages}
        _check_folders(stages, out, resume)
        materials = {part: open_materials(data, part, plan.shares) for part in PARTS}
        photos = _open_pairs(pairs, stages)
        pairs_of = dict(zip(PARTS, photos.parts() if photos else (None, None), strict=True))
        weights = load_vgg16(vgg) if any(needs_vgg(one.objective) for one in stages) else {}
        team = FabricTeam(accelerator=accelerator, devices=devices, nodes=nodes, precision=plan.precision)
        torch.set_num_threads(threads)  # after the launch, which has ideas of its own
        weights = {name: value.to(team.device) for name, value in weights.items()}
        if team.rank == 0:
            for reason in (*materials["train"].skipped, *(photos.skipped if photos else ())):
                typer.echo(f"refine-train: skipped: {reason}", err=True)
        left = steps
        for one in stages:
            torch.manual_seed(seed)
            objective = give_vgg(one.objective, weights)
            training, validation = (
                batch_source(
                    materials[part],
                    one.augmentation,
                    one.photography,
                    pairs_of[part],
                    one.pairs,
                    team.device,
                )
                for part in PARTS
            )
            trainer = Trainer(
                build(one.network),
                training,
                objective,
                replace(one.trainer, seed=seed),
                build_critics(objective.judged, **plan.critics),
                team,
                one.parts,
            )
            folder = out / one.name
            origin = origins[one.name]
            if resume and (folder / STATE).exists():
                trainer.resume(folder / STATE)
            elif origin is not None:
                _begin_at(trainer, origin)
            facts = {**plan.as_dict(one), "processes": team.world}
            left = _run(trainer, folder, facts, data_note or [], save_every, left, validation)
            if left == 0:
                break
    except (DataError, PlanError, ValueError, OSError) as error:
        typer.echo(f"refine-train: {' '.join(str(error).split())}", err=True)
        raise typer.Exit(2) from None


def _begin_at(trainer: Trainer, origin: Path) -> None:
    """Start from a training's state, or from a checkpoint, which is a network without critics."""
    if origin.suffix != ".safetensors":
        trainer.adopt(origin)
        return
    weights = load_network(origin).state_dict()
    try:
        trainer.take_weights(weights, weights)
    except RuntimeError:
        raise ValueError(
            f"--start {origin} is another network than the plan's; make the plan's generator like it"
        ) from None


def _run(
    trainer: Trainer,
    folder: Path,
    facts: dict[str, Any],
    notes: list[str],
    save_every: int,
    left: int | None,
    validation: BatchSource,
) -> int | None:
    """Train one stage to its end, or until `left` iterations are used up; return how many are left."""
    watch = Watch(folder, validation) if trainer.team.rank == 0 else None
    try:
        while not trainer.done and left != 0:
            trainer.step()
            left = None if left is None else left - 1
            if watch is None:
                continue
            if trainer.iteration % LOG_EVERY == 0:
                watch.log(trainer)
            if trainer.iteration % save_every == 0 or trainer.done or left == 0:
                trainer.save(folder / STATE)
                record = Record(trainer.network.config, {**trainer.record(), **facts}, notes)
                save_model(folder / "weights.safetensors", trainer.average, record)
                watch.validate(trainer)
    finally:
        if watch is not None:
            watch.close()
    # A barrier: the next stage starts from the state that the first process has just written.
    trainer.team.mean(torch.zeros(1, device=trainer.team.device))
    return left


def _chosen(plan: TrainingPlan, names: list[str] | None) -> list[Stage]:
    known = [stage.name for stage in plan.stages]
    unknown = [name for name in names or [] if name not in known]
    if unknown:
        raise PlanError(f"--stage {unknown[0]} is not in the plan; it has {', '.join(known)}")
    return [stage for stage in plan.stages if not names or stage.name in names]


def _open_pairs(folder: Path | None, stages: list[Stage]) -> PhotoPairs | None:
    if not any(stage.pairs for stage in stages):
        return None
    if folder is None:
        raise PlanError("a stage trains on real pairs; give their folder with --pairs")
    crops = [phase.crop for stage in stages if stage.pairs for phase in stage.trainer.phases]
    return PhotoPairs(folder, crop=max(crops))


def _check_shards(stages: list[Stage], processes: int) -> None:
    for stage in stages:
        for phase in stage.trainer.phases:
            if phase.shards % processes:
                raise PlanError(
                    f"stage {stage.name} has phases of {phase.shards} shards, which do not divide among "
                    f"{processes} processes; give it shards in multiples of {processes}"
                )


def _origin(
    stage: Stage, plan: TrainingPlan, chosen: list[Stage], out: Path, start: Path | None
) -> Path | None:
    """Return the state whose networks a stage starts from; None for the plan's first that it could continue.

    It is that of the stage trained before it in this run; else `--start`; else that of the stage before it in
    the plan, from a run of before.
    """
    earlier = [one for one in chosen[: chosen.index(stage)] if continues(stage.network, one.network)]
    if earlier:
        return out / earlier[-1].name / STATE
    if start is not None:
        if not start.is_file():
            raise PlanError(f"--start {start} is not a file")
        return start
    before = [one for one in plan.stages[: plan.stages.index(stage)] if continues(stage.network, one.network)]
    if not before:
        return None
    origin = out / before[-1].name / STATE
    if not (origin.is_file() or (out / stage.name / STATE).is_file()):
        raise PlanError(
            f"stage {stage.name} starts from the networks of {before[-1].name}, but there is no "
            f"{origin}; train that first, or give a state with --start"
        )
    return origin


def _check_folders(stages: list[Stage], out: Path, resume: bool) -> None:
    for stage in stages:
        if (out / stage.name / STATE).exists() and not resume:
            raise PlanError(
                f"{out / stage.name} holds a training already; go on with --resume or give another --out"
            )


def main() -> None:
    """Run the console script."""
    app()


if __name__ == "__main__":
    main()
