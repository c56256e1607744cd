"""The fused engine: what `reference.py` computes, in one pass over the pixels, on all cores of a CPU.

Pixels that move by their own gradient do not depend on each other, so each block of them runs through *all*
iterations while it stays in the first level of cache (`kernel.py`); nothing but parameters and loss sums ever
reaches memory. Offsets that all pixels share need one pass and one small sum per iteration, over no more
pixels than make the mean gradient certain.

The results do not depend on the number of threads: blocks are fixed, and their sums are added in their order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nets.render import PAPER, Conventions, Geometry
from nets.svbrdf import MAPS
from refine.capture import Capture
from refine.engine import kernel, layout
from refine.engine.compilation import prepare
from refine.engine.reference import (
    ADAM_BETAS,
    ADAM_EPSILON,
    FINAL_RATE,
    Progress,
    several,
    unsaturated_somewhere,
)
from refine.engine.workers import Workers
from refine.parametrization import Parameters

SPAN_BLOCKS = 1024
"""Blocks that are dealt out to the threads together: 65,536 pixels. Each thread packs, runs and unpacks the
parts it gets, which are small enough for torch to compute their geometry without threads of its own: how it
divides the work among them shows in the last bits."""

SHARED_PIXELS = 2**18
"""Most pixels that offsets shared by all of them are found from; of a larger photo, as many are drawn."""


def descend(
    start: Parameters,
    offsets: dict[str, Tensor],
    capture: Capture | Sequence[Capture],
    geometry: Geometry | Sequence[Geometry] | None = None,
    *,
    iterations: int,
    rates: dict[str, float],
    conventions: Conventions = PAPER,
    progress: Progress | None = None,
) -> tuple[Parameters, list[float]]:
    """Minimise the photo's distance as `refine.engine.reference.descend` does, which see.

    Unlike there, offsets are either all full-size or all `[1, C, 1, 1]`, and `progress` is told in bursts: of
    photos of more than one span, with losses over the pixels that are finished. Offsets that all pixels share
    are found from `SHARED_PIXELS` of them, and their losses are over these.

    Raises:
        ValueError: for tensors off the CPU or of another type than float32 and float64, or mixed offsets.
    """
    problem = fused_problem(start, capture, geometry, conventions)
    own = {offset.shape[-2:] == start.normal.shape[-2:] for offset in offsets.values()}
    if len(own) != 1:
        raise ValueError("offsets must be all per pixel or all shared by the pixels")
    steps = _steps(iterations, rates)
    run = _descend_pixels if own.pop() else _descend_together
    with Workers.of_torch() as workers:
        return run(problem, offsets, steps, workers, progress)


@dataclass(frozen=True)
class Problem:
    """What is fixed during a descent."""

    start: Parameters
    captures: list[Capture]
    geometries: list[layout.GeometryAt]
    moves: Bool[Tensor, "1 1 h w"]
    constants: Float[np.ndarray, "constants"]

    @property
    def real(self) -> np.dtype:
        """Type of the numbers."""
        return self.constants.dtype

    @property
    def pixels(self) -> int:
        """How many there are."""
        return self.moves.numel()

    def spans(self) -> list[slice]:
        """Cut the pixels into ranges that are packed together."""
        size = SPAN_BLOCKS * kernel.BLOCK
        return [slice(first, min(first + size, self.pixels)) for first in range(0, self.pixels, size)]

    def drawn(self) -> Problem:
        """Return this problem on `SHARED_PIXELS` or somewhat fewer, if it has more.

        They are one pixel of every run of so many, at a place drawn from a fixed seed: an even distance
        would see the same thread of every stitch.
        """
        run = -(-self.pixels // SHARED_PIXELS)
        if run == 1:
            return self
        begin = torch.arange(0, self.pixels - run + 1, run)
        chosen = (begin + torch.randint(run, begin.shape, generator=torch.Generator().manual_seed(0)))[None]

        def choose(tensor: Tensor) -> Tensor:
            return layout.at_pixels(tensor, chosen)

        def geometry_at(whole: layout.GeometryAt) -> layout.GeometryAt:
            return lambda pixels: whole(chosen[:, pixels[0]])

        return Problem(
            Parameters(*(choose(getattr(self.start, name)) for name in MAPS)),
            [replace(c, photo=choose(c.photo), unsaturated=choose(c.unsaturated)) for c in self.captures],
            [geometry_at(whole) for whole in self.geometries],
            choose(self.moves),
            self.constants,
        )

    def pack(self, offsets: dict[str, Tensor], pixels: slice) -> Packed:
        """Pack a range of pixels for the compiled loops."""
        return Packed(
            pixels,
            layout.pack_surface(self.start, offsets, self.moves, pixels),
            layout.pack_photos(self.captures, self.geometries, pixels, self.start.normal.dtype),
            layout.count_pixels(pixels),
        )


@dataclass(frozen=True)
class Packed:
    """A range of pixels as the compiled loops read it."""

    pixels: slice
    surface: Float[np.ndarray, "blocks surface"]
    photos: Float[np.ndarray, "blocks photos"]
    counts: Int[np.ndarray, "blocks"]


def fused_problem(
    start: Parameters,
    capture: Capture | Sequence[Capture],
    geometry: Geometry | Sequence[Geometry] | None,
    conventions: Conventions,
) -> Problem:
    """Return what a fused engine works on.

    Raises:
        ValueError: for tensors off the CPU or of another type than float32 and float64.
    """
    dtype, device = start.normal.dtype, start.normal.device
    if device.type != "cpu" or dtype not in (torch.float32, torch.float64):
        raise ValueError(f"the fused engine takes float32 or float64 on the CPU, not {dtype} on {device}")
    if geometry is None:
        captures = [capture] if isinstance(capture, Capture) else list(capture)
        size = (start.normal.shape[-2], start.normal.shape[-1])
        geometries = [layout.computed_geometry(photo, size, conventions, dtype) for photo in captures]
    else:
        captures, given = several(capture, geometry)
        geometries = [layout.given_geometry(whole) for whole in given]
    prepare(dtype)
    constants = layout.constants(conventions, dtype)
    return Problem(start, captures, geometries, unsaturated_somewhere(captures), constants)


def _steps(iterations: int, rates: dict[str, float]) -> Float[np.ndarray, "iterations numbers"]:
    # Bias-corrected rates, correction of the second moment, epsilon: all of Adam that changes with time.
    number = np.arange(iterations)[:, None]
    schedule = FINAL_RATE + (1.0 - FINAL_RATE) * np.cos(math.pi / 2 * number / max(1, iterations))
    steps = np.zeros((iterations, kernel.PARAMETERS + 2))
    for name, rate in rates.items():
        steps[:, layout.ROWS[name]] = rate * schedule / (1.0 - ADAM_BETAS[0] ** (number + 1))
    steps[:, kernel.PARAMETERS] = 1.0 / np.sqrt(1.0 - ADAM_BETAS[1] ** (number[:, 0] + 1))
    steps[:, kernel.PARAMETERS + 1] = ADAM_EPSILON
    return steps


def _best(history: list[float]) -> int:
    # The first of the lowest; the start if there is none, as the reference has it.
    return int(np.argmin(np.nan_to_num(np.array(history), nan=np.inf)))


def _descend_pixels(
    problem: Problem,
    offsets: dict[str, Tensor],
    steps: Float[np.ndarray, "iterations numbers"],
    workers: Workers,
    progress: Progress | None,
) -> tuple[Parameters, list[float]]:
    steps = steps.copy()
    still = [name for name in MAPS if name not in offsets]
    for name in still:
        steps[:, layout.ROWS[name]] = 0.0
    found, history = _run_pixels(problem, offsets, steps, ADAM_BETAS, workers, progress)
    if (best := _best(history)) < len(steps):
        # Pixels do not know of each other, so only now is it known when to stop: go there again.
        found, _ = _run_pixels(problem, offsets, steps[:best], ADAM_BETAS, workers, None)
    # In place, since a photo may be large.
    moved = {name: offset.add_(getattr(problem.start, name)) for name, offset in found.items()}
    return replace(problem.start, **moved), history


def _run_pixels(
    problem: Problem,
    offsets: dict[str, Tensor],
    steps: Float[np.ndarray, "iterations numbers"],
    betas: tuple[float, float],
    workers: Workers,
    progress: Progress | None,
) -> tuple[dict[str, Tensor], list[float]]:
    real, count = problem.real, len(steps)
    steps_, betas_ = steps.astype(real), np.array([1.0 - betas[0], betas[1], 1.0 - betas[1]], dtype=real)
    shared = np.zeros(kernel.PARAMETERS, dtype=real)
    found = {name: offset.new_empty(offset.shape) for name, offset in offsets.items()}
    total, finished, told = np.zeros(count + 1), 0, 0
    for span in problem.spans():
        losses = np.empty((layout.count_blocks(span), count + 1))

        def work(part: slice, span: slice = span, losses: np.ndarray = losses) -> None:
            packed = problem.pack(offsets, layout.pixels_of(part, span))
            kernel.descend_blocks(
                packed.surface,
                packed.photos,
                shared,
                problem.constants,
                betas_,
                steps_,
                layout.scratch(real),
                packed.counts,
                losses[part],
            )
            layout.unpack_offsets(packed.surface, packed.pixels, found)

        workers.run(work, len(losses), kernel.BLOCK * (count + 1))
        total += losses.sum(axis=0)
        finished = span.stop
        mark = count * finished // problem.pixels
        if progress is not None:
            for iteration in range(told, mark):
                progress(iteration + 1, float(total[iteration]) / (3 * finished))
        told = mark
    return found, [float(loss) / (3 * problem.pixels) for loss in total]


def pack_spans(problem: Problem, workers: Workers) -> list[Packed]:
    """Pack all pixels, in parts of a span as `_run_pixels` does."""
    packed: list[Packed] = []
    for span in problem.spans():

        def work(part: slice, span: slice = span) -> None:
            packed.append(problem.pack({}, layout.pixels_of(part, span)))

        workers.run(work, layout.count_blocks(span))
    return packed


def _descend_together(
    whole: Problem,
    offsets: dict[str, Tensor],
    steps: Float[np.ndarray, "iterations numbers"],
    workers: Workers,
    progress: Progress | None,
) -> tuple[Parameters, list[float]]:
    problem = whole.drawn()
    real = problem.real
    packed = pack_spans(problem, workers)
    sums = np.empty((sum(len(part.counts) for part in packed), kernel.PARAMETERS + 1))
    shared = np.zeros(kernel.PARAMETERS)
    moving = np.zeros(kernel.PARAMETERS, dtype=bool)
    for name, offset in offsets.items():
        shared[layout.ROWS[name]] = offset.detach().reshape(-1).numpy()
        moving[layout.ROWS[name]] = True
    first, second = np.zeros_like(shared), np.zeros_like(shared)
    history: list[float] = []
    best, lowest = shared.copy(), math.inf

    def evaluate() -> Float[np.ndarray, "9"]:
        nonlocal lowest
        now = shared.astype(real)

        def work(parts: slice) -> None:
            for part in packed[parts]:
                first = part.pixels.start // kernel.BLOCK
                kernel.sum_blocks(
                    part.surface,
                    part.photos,
                    now,
                    problem.constants,
                    layout.scratch(real),
                    part.counts,
                    sums[first : first + len(part.counts)],
                )

        workers.run(work, len(packed))
        total = sums.sum(axis=0)
        history.append(float(total[-1]) / (3 * problem.pixels))
        if history[-1] < lowest:  # the first of the lowest, as the reference has it; never NaN
            best[:], lowest = shared, history[-1]
        return np.asarray(total[:-1] / problem.pixels)

    for iteration, step in enumerate(steps):
        gradient = np.where(moving, evaluate(), 0.0)
        first += (gradient - first) * (1.0 - ADAM_BETAS[0])
        second += (gradient**2 - second) * (1.0 - ADAM_BETAS[1])
        shared -= step[:-2] * first / (np.sqrt(second) * step[-2] + step[-1])
        if progress is not None:
            progress(iteration + 1, history[-1])
    evaluate()
    found = {}
    for name, offset in offsets.items():
        found[name] = torch.from_numpy(best[layout.ROWS[name]]).to(offset.dtype).reshape(offset.shape)
    return whole.start.shifted(found), history
