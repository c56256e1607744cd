"""The generic trainer: network, critics, batches, objective; resumable to the bit, on one process or many.

It knows nothing of losses: an objective is any callable that turns networks and a batch into `Losses`.
"""

from __future__ import annotations

import contextlib
import copy
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from nets.architectures import Network
from nets.training import Alone, BatchSource, Objective, Phase, Team, Terms, TrainerConfig


@dataclass
class Trainer:
    """One training: call `step` until `done`; `save` and `resume` at any moment.

    Random numbers are a function of seed, iteration and shard alone: a resumed training draws what an
    uninterrupted one would, and which process draws it does not matter. Only the parts of the network that
    `parts` names are trained, all if it names none.
    """

    network: Network
    source: BatchSource
    objective: Objective
    config: TrainerConfig
    critics: nn.ModuleDict = field(default_factory=nn.ModuleDict)
    team: Team = field(default_factory=Alone)
    parts: tuple[str, ...] = ()
    iteration: int = 0
    seconds: float = 0.0
    samples: int = 0
    averages: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Place the networks and build optimizers and moving average.

        Raises:
            ValueError: shards of a phase do not divide among the processes, or the network lacks a part.
        """
        torch.set_flush_denormal(True)  # dying activations become denormal and several times slower
        for phase in self.config.phases:
            if phase.shards % self.team.world:
                raise ValueError(
                    f"{phase.shards} shards do not divide among {self.team.world} processes; "
                    f"give a multiple of {self.team.world}"
                )
        for players in (self.network, self.critics):
            players.to(device=self.team.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network).eval().requires_grad_(False)
        trained: list[nn.Module] = [self.network.get_submodule(part) for part in self._known_parts()]
        trained = trained or [self.network]
        self._trained_modules = trained
        self._trained = [parameter for module in trained for parameter in module.parameters()]
        self.network.requires_grad_(False)
        for parameter in self._trained:
            parameter.requires_grad_(True)
        self.optimizer = self._adam(self._trained)
        self.critic_optimizer = self._adam([*self.critics.parameters()]) if len(self.critics) else None

    def _known_parts(self) -> tuple[str, ...]:
        known = [name for name, _ in self.network.named_children()]
        for part in self.parts:
            if part not in known:
                raise ValueError(f"the network has no {part}; it has {', '.join(known)}")
        return self.parts

    def _adam(self, parameters: list[nn.Parameter]) -> torch.optim.Adam:
        return torch.optim.Adam(parameters, lr=self.config.learning_rate, betas=(self.config.beta1, 0.999))

    @property
    def done(self) -> bool:
        """Whether all phases are over."""
        return self.iteration >= self.config.iterations

    def step(self) -> dict[str, float]:
        """Run one iteration; return the loss and its terms, averaged over shards and processes."""
        start = time.perf_counter()
        phase = self.config.phase_at(self.iteration)
        # What is not trained is as it will be used: without dropout.
        self.network.eval()
        for module in self._trained_modules:
            module.train()
        for optimizer, factor in self._optimizers():
            optimizer.zero_grad(set_to_none=True)
            for group in optimizer.param_groups:
                group["lr"] = factor * self.config.learning_rate_at(self.iteration)
        own = range(self.team.rank, phase.shards, self.team.world)
        values: dict[str, Tensor] = {}
        for shard in own:
            for name, value in self._accumulate(phase, shard, 1.0 / len(own)).items():
                values[name] = values.get(name, 0.0) + value / len(own)
        means = self._share(values)
        for optimizer, _ in self._optimizers():
            parameters = [p for group in optimizer.param_groups for p in group["params"]]
            norm = torch.nn.utils.clip_grad_norm_(parameters, self.config.gradient_clip)
            if bool(torch.isfinite(norm)):
                optimizer.step()
        self._update_average()
        self.iteration += 1
        self.samples += phase.batch * phase.shards
        self.seconds += time.perf_counter() - start
        for name, mean in means.items():
            self.averages[name] = 0.98 * self.averages.get(name, mean) + 0.02 * mean
        return means

    def _optimizers(self) -> Iterator[tuple[torch.optim.Adam, float]]:
        yield self.optimizer, 1.0
        if self.critic_optimizer is not None:
            yield self.critic_optimizer, self.config.critic_factor

    def _accumulate(self, phase: Phase, shard: int, weight: float) -> Terms:
        """Add one shard's gradients to both players'."""
        seed = stream_seed(self.config.seed, self.iteration, shard)
        generator = torch.Generator().manual_seed(seed)
        torch.manual_seed(seed)  # of dropout
        batch = self.source(phase.batch, phase.crop, generator)
        with self.team.autocast():
            losses = self.objective(self.network, self.critics, batch, generator)
        values = {"loss": losses.generator.detach()}
        if losses.critics is not None:
            values["critics"] = losses.critics.detach()
            torch.autograd.backward(
                losses.critics * weight, inputs=list(self.critics.parameters()), retain_graph=True
            )
        torch.autograd.backward(losses.generator * weight, inputs=self._trained)
        return values | {name: term.detach() for name, term in losses.terms.items()}

    def _share(self, values: Terms) -> dict[str, float]:
        """Average gradients and logged values over the processes, in one message: latency would cost more."""
        names = sorted(values)
        logged = torch.stack([values[name].float().reshape(()).to(self.team.device) for name in names])
        if self.team.world > 1:
            players = [*self.network.parameters(), *self.critics.parameters()]
            gradients = [p.grad for p in players if p.grad is not None]
            parts = [*(gradient.reshape(-1) for gradient in gradients), logged]
            means = self.team.mean(torch.cat(parts)).split([part.numel() for part in parts])
            for gradient, mean in zip(gradients, means, strict=False):
                gradient.copy_(mean.view_as(gradient))
            logged = means[-1]
        return dict(zip(names, logged.tolist(), strict=True))

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
        """Write the full state; the file of before stays whole until the new one is.

        Raises:
            OSError: it cannot be written, for instance on a full disk.
        """
        state = {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "critics": self.critics.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "critic_optimizer": self.critic_optimizer.state_dict() if self.critic_optimizer else None,
            "iteration": self.iteration,
            "seconds": self.seconds,
            "samples": self.samples,
            "averages": self.averages,
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".partial")
        try:
            torch.save(state, temporary)
            temporary.replace(path)
        except (OSError, RuntimeError) as error:  # torch says RuntimeError when a disk is full
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise OSError(f"{path} cannot be written ({_first_line(error)}); what it was is kept") from error

    def resume(self, path: Path) -> None:
        """Continue from a state written by `save`, as if never interrupted.

        Raises:
            ValueError: the state is of other networks, or no state at all.
        """
        state = self._load(path)
        try:
            self.network.load_state_dict(state["network"])
            self.average.load_state_dict(state["average"])
            self.critics.load_state_dict(state["critics"])
            self.optimizer.load_state_dict(state["optimizer"])
            if self.critic_optimizer is not None:
                self.critic_optimizer.load_state_dict(state["critic_optimizer"])
            self.iteration, self.seconds = state["iteration"], state["seconds"]
            self.samples, self.averages = state["samples"], state["averages"]
        except (KeyError, RuntimeError, ValueError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{path} is the state of another network or objective ({_first_line(error)}); "
                f"start it anew elsewhere"
            ) from None

    def adopt(self, path: Path) -> None:
        """Start from the networks of another training's state: the stage before this one.

        Critics that both have are taken too; optimizers, counters and parts of the network that the state
        lacks as a whole start anew.

        Raises:
            ValueError: the state's generator is another one, or it is no state at all.
        """
        state = self._load(path)
        try:
            self.take_weights(state["network"], state["average"])
            for name, critic in self.critics.items():
                prefix = f"{name}."
                known = state.get("critics", {}).items()  # old states have none
                own = {k.removeprefix(prefix): v for k, v in known if k.startswith(prefix)}
                if own:
                    critic.load_state_dict(own)
        except (KeyError, RuntimeError) as error:
            raise ValueError(f"{path} is the state of another network ({_first_line(error)})") from None

    def take_weights(self, weights: Mapping[str, Tensor], average: Mapping[str, Tensor]) -> None:
        """Start from a network's weights and their moving average; parts they lack as a whole start anew.

        Raises:
            RuntimeError: they are another network's.
        """
        for network, given in ((self.network, weights), (self.average, average)):
            present = {name.partition(".")[0] for name in given}
            own = network.state_dict().items()
            new = {name: value for name, value in own if name.partition(".")[0] not in present}
            network.load_state_dict({**new, **given})

    def _load(self, path: Path) -> dict[str, Any]:
        try:
            state = torch.load(path, map_location=self.team.device, weights_only=True)
        except Exception as error:  # torch names no common base of what a damaged file raises
            raise ValueError(f"{path} is not the state of a training ({_first_line(error)})") from None
        if not isinstance(state, dict) or not {"network", "average"} <= state.keys():
            raise ValueError(f"{path} is not the state of a training")
        return state


def stream_seed(seed: int, iteration: int, shard: int) -> int:
    """Return the seed of a shard's random numbers: far apart for neighbours, the same on every machine."""
    return int(np.random.SeedSequence([seed, iteration, shard]).generate_state(1, np.uint64)[0] >> 1)


def _first_line(error: Exception) -> str:
    """Return the part of an error's message that says what is wrong: torch's are headings and long lists."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
    return lines[1] if lines[0].endswith(":") and len(lines) > 1 else lines[0]
