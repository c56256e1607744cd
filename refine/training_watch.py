"""What can be seen of a training while it runs: a log, TensorBoard, figures and pictures of held-out data."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nets.architectures import Network
from nets.baselines.autoencoder import Autoencoder
from nets.color import gamma_encode
from nets.data.contact_sheet import panels
from nets.data.images import write_image
from nets.svbrdf import SVBRDF
from nets.trainer import Trainer, stream_seed
from nets.training import BatchSource, TrainingBatch

VALIDATION_SHARDS = 4
"""At least so many batches of held-out data are what figures are averaged over."""

VALIDATION_PHOTOS = 32
"""And so many photos: the accuracies of critics on fewer say little."""

SHEET_MATERIALS = 3
"""Held-out materials on a sample sheet, two rows each: truth, then estimate."""


class Watch:
    """Writes `log.jsonl`, `samples.png` and TensorBoard events into a run's folder."""

    def __init__(self, folder: Path, validation: BatchSource) -> None:
        """Open the log.

        Args:
            folder: of the stage; made if it is not there.
            validation: source of held-out data.

        Raises:
            ValueError: TensorBoard is not installed.
        """
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise ValueError('training needs TensorBoard; run pip install "svbrdf-refine[train]"') from None
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.validation = folder, validation
        self.board = SummaryWriter(str(folder / "tensorboard"))

    def log(self, trainer: Trainer) -> None:
        """Write the running averages of loss and terms."""
        speed = {"samples_per_second": round(trainer.samples / trainer.seconds, 2)}
        self._write({"iteration": trainer.iteration, **speed, **_rounded(trainer.averages)})
        for name, value in trainer.averages.items():
            self.board.add_scalar(f"training/{name}", value, trainer.iteration)

    @torch.no_grad()
    def validate(self, trainer: Trainer) -> dict[str, float]:
        """Write loss and terms on held-out data, the same at every call, and a sheet of samples.

        Accuracies of critics are among the terms: of held-out truth and of what the network makes of
        held-out photos.
        """
        phase = trainer.config.phase_at(trainer.iteration)
        trainer.network.eval()
        sums: dict[str, float] = {}
        shards = max(VALIDATION_SHARDS, math.ceil(VALIDATION_PHOTOS / phase.batch))
        for shard in range(shards):
            generator = torch.Generator().manual_seed(stream_seed(0, 0, shard))
            batch = self.validation(phase.batch, phase.crop, generator)
            with trainer.team.autocast():
                losses = trainer.objective(trainer.network, trainer.critics, batch, generator)
            for name, term in {"loss": losses.generator, **losses.terms}.items():
                sums[name] = sums.get(name, 0.0) + float(term) / shards
        self._write({"iteration": trainer.iteration, "validation": _rounded(sums)})
        for name, value in sums.items():
            self.board.add_scalar(f"validation/{name}", value, trainer.iteration)
        self._sheet(trainer, phase.crop)
        return sums

    def _sheet(self, trainer: Trainer, crop: int) -> None:
        generator = torch.Generator().manual_seed(stream_seed(0, 0, VALIDATION_PHOTOS))
        batch = self.validation(SHEET_MATERIALS, crop, generator)
        estimate = _estimate(trainer.average, batch)
        rows = []
        for number in range(SHEET_MATERIALS):
            photo = gamma_encode(batch.photo[number]).permute(1, 2, 0)
            for material in (batch.truth, estimate):
                one = SVBRDF.from_channels(material.channels()[number : number + 1].float().cpu())
                rows.append(np.concatenate([photo.cpu().numpy(), *panels(one)], axis=1))
        sheet = np.rint(np.concatenate(rows) * 255.0).astype(np.uint8)
        write_image(self.folder / "samples.png", sheet)
        self.board.add_image("samples", sheet, trainer.iteration, dataformats="HWC")

    def _write(self, line: dict[str, Any]) -> None:
        with (self.folder / "log.jsonl").open("a", encoding="utf-8") as log:
            log.write(json.dumps({"time": time.strftime("%H:%M:%S"), **line}) + "\n")

    def close(self) -> None:
        """Flush TensorBoard."""
        self.board.close()


def _estimate(network: Network, batch: TrainingBatch) -> SVBRDF:
    if isinstance(network, Autoencoder):
        return network.reconstruct(batch.truth)
    return network.predict(batch.photo)[0]


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 5) for name, value in values.items()}
