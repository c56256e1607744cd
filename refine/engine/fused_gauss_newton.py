"""Fused Gauss-Newton: what `gauss_newton.py` computes, in one pass over the pixels, on all cores of a CPU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float

from nets.render import PAPER, Conventions, Geometry
from nets.svbrdf import MAPS
from refine.capture import Capture
from refine.engine import kernel, layout, newton_step, normal_equations
from refine.engine.fused import fused_problem
from refine.engine.gauss_newton import ACCEPTED, DAMPING_RANGE, FIRST_DAMPING, REJECTED, Posterior
from refine.engine.reference import Progress
from refine.engine.workers import Workers
from refine.parametrization import Parameters

NEWTON_COST = 8
"""How many times longer one of its steps takes than one of the descent's, about."""


def solve(
    start: Parameters,
    capture: Capture | Sequence[Capture],
    geometry: Geometry | Sequence[Geometry] | None = None,
    *,
    iterations: int,
    widths: Mapping[str, float],
    noise: float,
    huber: float,
    conventions: Conventions = PAPER,
    progress: Progress | None = None,
) -> Posterior:
    """Find every pixel's most probable parameters as `refine.engine.gauss_newton.solve` does, which see.

    Unlike there, `progress` is told in bursts, of the pixels that are finished.

    Raises:
        ValueError: for tensors off the CPU or of another type than float32 and float64.
    """
    problem = fused_problem(start, capture, geometry, conventions)
    real = problem.real
    prior = _prior(widths).astype(real)
    robust = np.array([noise, huber], dtype=real)
    pace = np.array([ACCEPTED, REJECTED, *DAMPING_RANGE, FIRST_DAMPING], dtype=real)
    found, deviations = ({name: torch.empty_like(getattr(start, name)) for name in MAPS} for _ in range(2))
    total, told = np.zeros((2, iterations + 1)), 0
    with Workers.of_torch() as workers:
        for span in problem.spans():
            costs = np.empty((layout.count_blocks(span), total.size))

            def work(part: slice, span: slice = span, costs: np.ndarray = costs) -> None:
                packed = problem.pack({}, layout.pixels_of(part, span))
                spread = np.empty((len(packed.counts), kernel.PARAMETERS * kernel.BLOCK), dtype=real)
                newton_step.solve_blocks(
                    packed.surface,
                    packed.photos,
                    problem.constants,
                    prior,
                    robust,
                    pace,
                    np.empty(normal_equations.NEWTON_ROWS * kernel.BLOCK, dtype=real),
                    packed.counts,
                    costs[part],
                    spread,
                )
                layout.unpack_offsets(packed.surface, packed.pixels, found)
                layout.unpack(spread, packed.pixels, deviations)

            workers.run(work, len(costs), NEWTON_COST * kernel.BLOCK * (iterations + 1))
            total += costs.sum(axis=0).reshape(total.shape)
            mark = iterations * span.stop // problem.pixels
            if progress is not None:
                for iteration in range(told, mark):
                    progress(iteration + 1, float(total[1, iteration]) * noise / (3 * span.stop))
            told = mark
    # In place, since a photo may be large.
    moved = {name: offset.add_(getattr(start, name)) for name, offset in found.items()}
    objective = [float(cost) / problem.pixels for cost in total[0]]
    history = [float(distance) * noise / (3 * problem.pixels) for distance in total[1]]
    return Posterior(Parameters(**moved), Parameters(**deviations), objective, history)


def _prior(widths: Mapping[str, float]) -> Float[np.ndarray, "4 9"]:
    """Return precisions, 0 for what does not move; the same with 1 for 0; whether it moves; zeros."""
    width = np.zeros(kernel.PARAMETERS)
    for name, value in widths.items():
        width[layout.ROWS[name]] = value
    moving = width > 0.0
    precision = np.where(moving, 1.0 / np.where(moving, width, 1.0) ** 2, 0.0)
    return np.stack([precision, np.where(moving, precision, 1.0), moving, np.zeros_like(width)])
