"""What a training is made of: batches, losses, objectives, teams of processes, schedules. All plain data.

What runs them is `trainer.py`.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from nets.color import to_network_input
from nets.data.pairs import PairBatch
from nets.render import PointLight
from nets.svbrdf import SVBRDF

Terms = dict[str, Tensor]
"""Named parts of a loss."""


@dataclass(frozen=True)
class TrainingBatch:
    """What an objective sees: linear photos, the materials behind them, the lights that lit them.

    Attributes:
        photo: linear photos of known materials.
        truth: the materials.
        light: what lit them.
        pairs: real photos of one surface each under two lights, in hybrid training.
    """

    photo: Tensor
    truth: SVBRDF
    light: PointLight
    pairs: PairBatch | None = None

    @property
    def network_input(self) -> Tensor:
        """The photos encoded to [-1, 1]."""
        return to_network_input(self.photo).contiguous(memory_format=torch.channels_last)

    def to(self, device: torch.device) -> TrainingBatch:
        """Move everything to a device."""
        pairs = self.pairs and PairBatch(self.pairs.a.to(device), self.pairs.b.to(device))
        return TrainingBatch(self.photo.to(device), self.truth.to(device), self.light.to(device), pairs)


@dataclass(frozen=True)
class Losses:
    """What an objective says of one batch.

    Attributes:
        generator: what the network minimises.
        terms: its parts, to log.
        critics: what the critics minimise; None without critics. Both losses may share one graph: each
            player's gradient is taken with respect to its own weights only.
    """

    generator: Tensor
    terms: Terms
    critics: Tensor | None = None


Objective = Callable[[Any, nn.ModuleDict, TrainingBatch, torch.Generator], Losses]
"""`(a network it is made for, critics by name, batch, random numbers) -> losses`."""

BatchSource = Callable[[int, int, torch.Generator], TrainingBatch]
"""`(batch size, crop in pixels, random numbers) -> batch`."""


@runtime_checkable
class Team(Protocol):
    """The processes that train together; `refine.train` makes one of Lightning Fabric."""

    @property
    def rank(self) -> int:
        """This process's number, from 0."""
        ...

    @property
    def world(self) -> int:
        """How many processes there are."""
        ...

    @property
    def device(self) -> torch.device:
        """Where this process computes."""
        ...

    def autocast(self) -> contextlib.AbstractContextManager[Any]:
        """Return the context in which networks and losses run."""
        ...

    def mean(self, tensor: Tensor) -> Tensor:
        """Return the tensor's mean over all processes."""
        ...


CPU = torch.device("cpu")


@dataclass(frozen=True)
class Alone:
    """A team of one on the CPU.

    Attributes:
        low_precision: run convolutions in bfloat16 (weights stay float32).
    """

    low_precision: bool = False
    rank: int = 0
    world: int = 1
    device: torch.device = CPU

    def autocast(self) -> contextlib.AbstractContextManager[Any]:
        """Return bfloat16 autocast, or one that does nothing."""
        return torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.low_precision)

    def mean(self, tensor: Tensor) -> Tensor:
        """Return the tensor."""
        return tensor


@dataclass(frozen=True)
class Phase:
    """A stretch of training at one crop size. The learning rate decays along a cosine over all phases.

    Attributes:
        iterations: optimizer steps.
        crop: side of the photos, pixels.
        batch: photos in a shard.
        shards: parts of a step, each with random numbers of its own; processes share them out, so that two
            processes with a shard each do what one does with both.
    """

    iterations: int
    crop: int
    batch: int
    shards: int = 1


@dataclass(frozen=True)
class TrainerConfig:
    """Everything that decides what a training does, given networks, data and objective.

    Attributes:
        phases: crop and batch sizes in order.
        learning_rate: Adam's, after `warmup` iterations.
        final_learning_rate: at the last iteration.
        critic_factor: the critics' learning rate over the generator's.
        beta1: Adam's (0.5 in the paper).
        warmup: iterations over which the learning rate rises from nearly zero.
        ema_decay: of the moving average of the weights.
        gradient_clip: largest norm of each player's gradient.
        seed: of weights, data and dropout.
    """

    phases: tuple[Phase, ...]
    learning_rate: float = 8e-4
    final_learning_rate: float = 2e-5
    critic_factor: float = 1.0
    beta1: float = 0.5
    warmup: int = 100
    ema_decay: float = 0.999
    gradient_clip: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what would only be noticed when training begins, or never.

        Raises:
            ValueError: naming the value.
        """
        if not self.phases:
            raise ValueError("a training needs at least one phase")
        for name in ("learning_rate", "gradient_clip"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be greater than 0, got {getattr(self, name)}")
        for name in ("final_learning_rate", "critic_factor", "warmup"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        for name in ("beta1", "ema_decay"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(f"{name} must be from 0 to below 1, got {getattr(self, name)}")

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
