"""The reference engine: eager autograd and Adam. Slow, obvious, and what every fast path is held to."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from losses.refinement import photo_distance
from nets.render import PAPER, Conventions, Geometry, shade
from refine.bands import photo_geometry
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
    capture: Capture | Sequence[Capture],
    geometry: Geometry | Sequence[Geometry] | None = None,
    *,
    iterations: int,
    rates: dict[str, float],
    conventions: Conventions = PAPER,
    progress: Progress | None = None,
) -> tuple[Parameters, list[float]]:
    """Minimise the photo's distance over additive offsets to some maps' parameters.

    Args:
        start: where every pixel begins.
        offsets: zero tensors to optimise, by map name. Full-size ones move every pixel by its own
            gradient; `[1, C, 1, 1]` ones move all pixels by the gradient averaged over all of them.
        capture: the photo to explain, or several of the same surface, whose distances add.
        geometry: of the light and camera of each photo, fixed; by default what the photos say of them.
        iterations: Adam steps.
        rates: Adam's learning rate by map name, decayed along a quarter cosine to `FINAL_RATE` of it.
        conventions: of the renderer.
        progress: told of every iteration.

    Returns:
        The parameters with the lowest loss seen, and the loss before every step and after the last.
    """
    captures, geometries = several(capture, geometry, conventions)
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
    # where all pixels move together. Of several photos it takes one in which it is not clipped.
    own = {name: offset.shape[-2:] == start.normal.shape[-2:] for name, offset in offsets.items()}
    moves = unsaturated_somewhere(captures)

    def moved(values: dict[str, Tensor]) -> Parameters:
        return start.shifted({name: value * moves if own[name] else value for name, value in values.items()})

    def distance() -> Tensor:
        material = moved(moving).svbrdf()
        distances = [
            photo_distance(shade(material, geometry, conventions), capture.photo, capture.unsaturated)
            for capture, geometry in zip(captures, geometries, strict=True)
        ]
        return torch.stack(distances).sum()

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


def several(
    capture: Capture | Sequence[Capture],
    geometry: Geometry | Sequence[Geometry] | None,
    conventions: Conventions = PAPER,
) -> tuple[list[Capture], list[Geometry]]:
    """Return photos and their geometries as lists of one length, of which each may be given alone.

    Raises:
        ValueError: if there are not as many geometries as photos, or none; or no geometry and no light.
    """
    captures = [capture] if isinstance(capture, Capture) else list(capture)
    if geometry is None:
        geometry = [photo_geometry(photo, conventions) for photo in captures]
    geometries = [geometry] if isinstance(geometry, Geometry) else list(geometry)
    if not captures or len(captures) != len(geometries):
        raise ValueError(f"{len(captures)} photos and {len(geometries)} geometries do not make pairs")
    return captures, geometries


def unsaturated_somewhere(captures: Sequence[Capture]) -> Bool[Tensor, "1 1 h w"]:
    """Return where at least one photo is not clipped."""
    return torch.stack([capture.unsaturated for capture in captures]).any(dim=0)
