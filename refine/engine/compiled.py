"""The compiled engine: the reference's objective, its gradient and Adam's step in one `torch.compile` graph.

For GPUs above all. What it needs and torch does not bring, `missing` names: a C++ compiler, on CUDA Triton.
No step waits for the device: losses and the best offsets stay there, and losses are fetched in bursts.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Sequence
from functools import cache
from importlib.util import find_spec
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from nets.render import PAPER, Conventions, Geometry
from refine.capture import Capture
from refine.engine.reference import ADAM_BETAS, ADAM_EPSILON, Objective, Progress, share_of_rate
from refine.parametrization import Parameters

COMPILING = "compiling the refinement with torch.compile; the first time this takes up to a minute"

BURST = 20
"""Iterations between two looks at the losses, each of which waits until the device has caught up."""

MOST_GRAPHS = 64
"""Graphs that a process may make: one for each set of moving maps, number of photos, number of threads and so
on, at its first size and for all others. Torch's own limit of 8 is soon reached, and then an error."""

Offsets = dict[str, Tensor]

_log = logging.getLogger(__name__)


def missing(device: str) -> str | None:
    """Return what `torch.compile` lacks on a type of device, in words; None if nothing."""
    if device == "cuda" and find_spec("triton") is None:
        return "Triton is not installed"
    if not any(shutil.which(name) for name in (os.environ.get("CXX", ""), "c++", "g++", "clang++", "cl")):
        return "there is no C++ compiler"
    return None


def descend(
    start: Parameters,
    offsets: Offsets,
    capture: Capture | Sequence[Capture],
    geometry: Geometry | Sequence[Geometry] | None = None,
    *,
    iterations: int,
    rates: dict[str, float],
    conventions: Conventions = PAPER,
    progress: Progress | None = None,
) -> tuple[Parameters, list[float]]:
    """Minimise the photo's distance as `refine.engine.reference.descend` does, which see.

    Unlike there, `progress` is told in bursts of `BURST` iterations. A graph serves photos of one size; the
    second size makes one that serves all.
    """
    objective = Objective.of(start, offsets, capture, geometry, conventions)
    paces = _paces(iterations, [rates[name] for name in offsets], start.normal)
    state = _State.at(offsets)
    step = _compiled_step()
    history: list[float] = []
    losses: list[Tensor] = []
    # The last evaluation is that after the last step; the step that it ends with does not matter.
    for iteration in range(iterations + 1):
        with torch._dynamo.config.patch(cache_size_limit=MOST_GRAPHS):
            state, loss = step(objective, state, paces[iteration])
        losses.append(loss)
        if len(losses) == BURST or iteration == iterations:
            burst = torch.stack(losses).tolist()
            losses.clear()
            if progress is not None:
                for number, told in enumerate(burst[: iterations - len(history)], start=len(history) + 1):
                    progress(number, told)
            history += burst
    return objective.moved(state.best), history


class _State(NamedTuple):
    """Offsets, Adam's moments, and the offsets of the lowest loss so far."""

    offsets: Offsets
    first: Offsets
    second: Offsets
    best: Offsets
    lowest: Float[Tensor, ""]

    @staticmethod
    def at(offsets: Offsets) -> _State:
        """Begin. No two tensors are the same one: the graph would take that for granted."""
        lowest = next(iter(offsets.values())).new_full((), torch.inf)
        now, best = ({name: offset.detach().clone() for name, offset in offsets.items()} for _ in range(2))
        first, second = ({name: torch.zeros_like(offset) for name, offset in now.items()} for _ in range(2))
        return _State(now, first, second, best, lowest)


def _paces(
    iterations: int, rates: Sequence[float], like: Tensor
) -> Float[Tensor, "{iterations}+1 {len(rates)}+1"]:
    """Return, by step, bias-corrected learning rates, and the correction of the second moment's root."""
    rows = []
    for step in range(iterations + 1):
        corrections = [1.0 - beta ** (step + 1) for beta in ADAM_BETAS]
        share = share_of_rate(step, iterations) / corrections[0]
        rows.append([*(rate * share for rate in rates), corrections[1] ** -0.5])
    return torch.tensor(rows, dtype=like.dtype, device=like.device)


def _step(
    objective: Objective, state: _State, pace: Float[Tensor, "numbers"]
) -> tuple[_State, Float[Tensor, ""]]:
    """Return the loss at a state's offsets and the state one step of Adam later."""

    def distance(offsets: Offsets) -> tuple[Tensor, Tensor]:
        loss = objective.distance(offsets)
        return loss * objective.own_pixels, loss

    gradients, (_, loss) = torch.func.grad_and_value(distance, has_aux=True)(state.offsets)
    better = loss < state.lowest
    moved: Offsets = {}
    first: Offsets = {}
    second: Offsets = {}
    best: Offsets = {}
    for rate, (name, offset) in zip(pace[:-1], state.offsets.items(), strict=True):
        gradient = gradients[name]
        first[name] = torch.lerp(state.first[name], gradient, 1.0 - ADAM_BETAS[0])
        second[name] = torch.lerp(state.second[name], gradient**2, 1.0 - ADAM_BETAS[1])
        moved[name] = offset - rate * first[name] / (second[name].sqrt() * pace[-1] + ADAM_EPSILON)
        best[name] = torch.where(better, offset, state.best[name])
    return _State(moved, first, second, best, torch.where(better, loss, state.lowest)), loss


@cache
def _compiled_step() -> Callable[..., Any]:
    _log.warning(COMPILING)
    return torch.compile(_step, fullgraph=True)
