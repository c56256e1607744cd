"""The reference engine: eager autograd and Adam. Slow, obvious, and what every fast path is held to."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from losses.refinement import photo_distance
from nets.render import Geometry, shade
from refine.capture import Capture
from refine.parametrization import Parameters

ADAM_BETAS = (0.9, 0.999)

ADAM_EPSILON = 0.1
"""Adam steps by g / (|g| + epsilon). A pixel's distance changes by about 1 per unit of its diffuse logit and
by far less per unit of a normal, or of a roughness outside the highlight. With Adam's usual 1e-8 all of them
would move alike, and maps the photo hardly depends on would drift: quadrants in normals, roughness noise."""

FINAL_RATE = 0.1
"""Share of the learning rates that is left at the last iteration."""

Progress = Callable[[int, float], None]
"""Called after every iteration with its number (from 1) and loss."""


def descend(
    start: Parameters,
    offsets: dict[str, Tensor],
    capture: Capture,
    geometry: Geometry,
    *,
    iterations: int,
    rates: dict[str, float],
    progress: Progress | None = None,
) -> tuple[Parameters, list[float]]:
    """Minimise the photo's distance over additive offsets to some maps' parameters.

    Args:
        start: where every pixel begins.
        offsets: zero tensors to optimise, by map name. Full-size ones move every pixel by its own
            gradient; `[1, C, 1, 1]` ones move all pixels by the gradient averaged over all of them.
        capture: the photo to explain.
        geometry: of the light and camera, fixed.
        iterations: Adam steps.
        rates: Adam's learning rate by map name, decayed along a quarter cosine to `FINAL_RATE` of it.
        progress: told of every iteration.

    Returns:
        The parameters with the lowest loss seen, and the loss before every step and after the last.
    """
    moving = {name: offset.detach().clone().requires_grad_(True) for name, offset in offsets.items()}
    # The gradient of a pixel's own distance, or its average over all pixels where they share one offset.
    own_pixels = max(offset.shape[-2] * offset.shape[-1] for offset in offsets.values())
    groups = [{"params": [tensor], "lr": rates[name]} for name, tensor in moving.items()]
    optimizer = torch.optim.Adam(groups, betas=ADAM_BETAS, eps=ADAM_EPSILON)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer,
        lambda step: FINAL_RATE + (1.0 - FINAL_RATE) * math.cos(math.pi / 2 * step / max(1, iterations)),
    )

    # A clipped pixel cannot say which of its maps is wrong: of itself it keeps what it had. It still counts
    # where all pixels move together.
    own = {name: offset.shape[-2:] == capture.photo.shape[-2:] for name, offset in offsets.items()}

    def moved(values: dict[str, Tensor]) -> Parameters:
        return start.shifted(
            {name: value * capture.unsaturated if own[name] else value for name, value in values.items()}
        )

    def distance() -> Tensor:
        rendering = shade(moved(moving).svbrdf(), geometry)
        return photo_distance(rendering, capture.photo, capture.unsaturated)

    history: list[float] = []
    best, best_loss = {name: value.detach().clone() for name, value in moving.items()}, float("inf")

    def keep(loss: float) -> None:
        nonlocal best, best_loss
        history.append(loss)
        if loss < best_loss:
            best_loss = loss
            best = {name: value.detach().clone() for name, value in moving.items()}

    for iteration in range(iterations):
        optimizer.zero_grad(set_to_none=True)
        loss = distance()
        keep(float(loss.detach()))
        (loss * own_pixels).backward()
        optimizer.step()
        schedule.step()
        if progress is not None:
            progress(iteration + 1, history[-1])
    with torch.no_grad():
        keep(float(distance()))
    return moved(best), history
