"""The generic trainer: network + batches + objective, resumable to the bit, best kept by moving average.

It knows nothing of losses: an objective is any callable `(network, batch, generator) -> (loss, terms)`.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nets.color import to_network_input
from nets.generator import Generator
from nets.render import PointLight
from nets.svbrdf import SVBRDF

Terms = dict[str, Tensor]
"""Named parts of a loss."""


@dataclass(frozen=True)
class TrainingBatch:
    """What an objective sees: linear photos, the materials behind them, the lights that lit them."""

    photo: Tensor
    truth: SVBRDF
    light: PointLight

    @property
    def network_input(self) -> Tensor:
        """The photos encoded to [-1, 1]."""
        return to_network_input(self.photo).contiguous(memory_format=torch.channels_last)


Objective = Callable[[Generator, TrainingBatch, torch.Generator], tuple[Tensor, Terms]]
BatchSource = Callable[[int, int, torch.Generator], TrainingBatch]
"""`(batch size, crop in pixels, generator) -> batch`."""


@dataclass(frozen=True)
class Phase:
    """A stretch of training at one crop size. The learning rate decays along a cosine over all phases."""

    iterations: int
    crop: int
    batch: int


@dataclass(frozen=True)
class TrainerConfig:
    """Everything that decides what a training does, given network, data and objective.

    Attributes:
        phases: crop and batch sizes in order.
        learning_rate: Adam's, after `warmup` iterations.
        final_learning_rate: at the last iteration.
        beta1: Adam's (0.5 in the paper).
        ema_decay: of the moving average of the weights.
        gradient_clip: largest norm of the gradient.
        seed: of weights, data and dropout.
        low_precision: run convolutions in bfloat16 (weights stay float32).
    """

    phases: tuple[Phase, ...]
    learning_rate: float = 8e-4
    final_learning_rate: float = 2e-5
    beta1: float = 0.5
    warmup: int = 100
    ema_decay: float = 0.999
    gradient_clip: float = 1.0
    seed: int = 0
    low_precision: bool = True

    @property
    def iterations(self) -> int:
        """Length of all phases together."""
        return sum(phase.iterations for phase in self.phases)

    def phase_at(self, iteration: int) -> Phase:
        """Return the phase that iteration (0-based) belongs to."""
        for phase in self.phases:
            if iteration < phase.iterations:
                return phase
            iteration -= phase.iterations
        return self.phases[-1]

    def learning_rate_at(self, iteration: int) -> float:
        """Linear warm-up, then a cosine from `learning_rate` to `final_learning_rate`."""
        progress = min(1.0, iteration / max(1, self.iterations))
        cosine = 0.5 * (1.0 + math.cos(math.pi * progress))
        rate = self.final_learning_rate + (self.learning_rate - self.final_learning_rate) * cosine
        return rate * min(1.0, (iteration + 1) / max(1, self.warmup))


@dataclass
class Trainer:
    """One training: call `step` until `done`; `save` and `resume` at any moment."""

    network: Generator
    source: BatchSource
    objective: Objective
    config: TrainerConfig
    iteration: int = 0
    seconds: float = 0.0
    samples: int = 0
    averages: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Seed the random streams and build optimizer and moving average."""
        torch.set_flush_denormal(True)  # dying activations become denormal and several times slower
        torch.manual_seed(self.config.seed)
        self.generator = torch.Generator().manual_seed(self.config.seed)
        self.rank, self.world = _rank_and_world()
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network).eval().requires_grad_(False)
        self.optimizer = torch.optim.Adam(
            self.network.parameters(), lr=self.config.learning_rate, betas=(self.config.beta1, 0.999)
        )

    @property
    def done(self) -> bool:
        """Whether all phases are over."""
        return self.iteration >= self.config.iterations

    def step(self) -> dict[str, float]:
        """Run one iteration; return the loss and its terms."""
        start = time.perf_counter()
        phase = self.config.phase_at(self.iteration)
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate_at(self.iteration)
        batch = self.source(phase.batch, phase.crop, self.generator)
        self.network.train()
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.config.low_precision):
            loss, terms = self.objective(self.network, batch, self.generator)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if self.world > 1:
            _average_gradients(list(self.network.parameters()), self.world)
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.config.gradient_clip)
        if bool(torch.isfinite(norm)):
            self.optimizer.step()
        self._update_average()
        self.iteration += 1
        self.samples += phase.batch * self.world
        self.seconds += time.perf_counter() - start
        values = {
            "loss": float(loss.detach()),
            **{name: float(term.detach()) for name, term in terms.items()},
        }
        for name, value in values.items():
            self.averages[name] = 0.98 * self.averages.get(name, value) + 0.02 * value
        return values

    def _update_average(self) -> None:
        # A young average would remember the random start: let it grow old first.
        decay = min(self.config.ema_decay, (1.0 + self.iteration) / (10.0 + self.iteration))
        with torch.no_grad():
            for mean, value in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(value, 1.0 - decay)

    def record(self) -> dict[str, Any]:
        """Return the training's facts for a checkpoint header."""
        return {
            "iterations": self.iteration,
            "samples": self.samples,
            "seconds": round(self.seconds),
            "config": asdict(self.config),
        }

    def save(self, path: Path) -> None:
        """Write the full state; the file of before stays whole until the new one is."""
        state = {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
            "torch": torch.get_rng_state(),
            "iteration": self.iteration,
            "seconds": self.seconds,
            "samples": self.samples,
            "averages": self.averages,
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".partial")
        torch.save(state, temporary)
        temporary.replace(path)

    def resume(self, path: Path) -> None:
        """Continue from a state written by `save`, as if never interrupted."""
        state = torch.load(path, map_location="cpu", weights_only=True)
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"])
        torch.set_rng_state(state["torch"])
        self.iteration, self.seconds = state["iteration"], state["seconds"]
        self.samples, self.averages = state["samples"], state["averages"]
        self.diverge()

    def diverge(self) -> None:
        """Give every process but the first its own random streams, by rank and iteration."""
        if self.rank > 0:
            seed = hash((self.config.seed, self.rank, self.iteration)) % 2**63
            self.generator.manual_seed(seed)
            torch.manual_seed(seed)


def _rank_and_world() -> tuple[int, int]:
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1


def _average_gradients(parameters: list[torch.nn.Parameter], world: int) -> None:
    # One message for all: the network is small and the latency of many would cost more.
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
    torch.distributed.all_reduce(flat)
    flat /= world
    for gradient, part in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
        gradient.copy_(part.view_as(gradient))
