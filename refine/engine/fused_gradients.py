"""The photos' distance and its gradient at any parameters: for searches that are not a descent of pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nets.render import PAPER, Conventions, Geometry
from nets.svbrdf import MAPS
from refine.capture import Capture
from refine.engine import kernel, layout
from refine.engine.fused import Packed, fused_problem, pack_spans
from refine.engine.reference import Measure
from refine.engine.workers import Workers
from refine.parametrization import Parameters

# offset -= rate first / (sqrt(second) correction + epsilon), with first = gradient: of rate -1 and without
# memory, a step of the descent is the gradient, and there is no second implementation that could differ.
STEP = np.array([[-1.0] * kernel.PARAMETERS + [0.0, 1.0]])
BETAS = np.array([1.0, 0.0, 1.0])


def gradients(
    start: Parameters,
    capture: Capture | Sequence[Capture],
    geometry: Geometry | Sequence[Geometry] | None = None,
    conventions: Conventions = PAPER,
) -> Measure:
    """Return a function as `refine.engine.reference.gradients` does, which see; photos are packed once.

    Raises:
        ValueError: for tensors off the CPU or of another type than float32 and float64.
    """
    problem = fused_problem(start, capture, geometry, conventions)
    # Clipped pixels say how their parameters should move, too.
    problem = replace(problem, moves=torch.ones_like(problem.moves))
    real = problem.real
    with Workers.of_torch() as workers:
        packed = pack_spans(problem, workers)
    shared = np.zeros(kernel.PARAMETERS, dtype=real)

    def measure(parameters: Parameters) -> tuple[float, dict[str, Float[Tensor, "1 c h w"]]]:
        found = {name: torch.empty_like(getattr(parameters, name)) for name in MAPS}
        sums = np.empty(len(packed))

        def evaluate(number: int, part: Packed) -> None:
            layout.restart(part.surface, parameters, part.pixels)
            losses = np.empty((len(part.surface), 2))
            kernel.descend_blocks(
                part.surface,
                part.photos,
                shared,
                problem.constants,
                BETAS.astype(real),
                STEP.astype(real),
                layout.scratch(real),
                part.counts,
                losses,
            )
            layout.unpack_offsets(part.surface, part.pixels, found)
            sums[number] = losses[:, 0].sum()

        def work(parts: slice) -> None:
            for number in range(len(packed))[parts]:
                evaluate(number, packed[number])

        with Workers.of_torch() as workers:
            workers.run(work, len(packed))
        return float(sums.sum()) / (3 * problem.pixels), found

    return measure
