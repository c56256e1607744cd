"""The reference engine: eager autograd and Adam. Slow, obvious, and what every fast path is held to."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from losses.refinement import photo_distance
from nets.render import PAPER, Conventions, Geometry, shade
from nets.svbrdf import MAPS
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


Measure = Callable[[Parameters], tuple[float, dict[str, Tensor]]]
"""From parameters to the photos' distance and, by map name, its gradient; see `gradients`."""


class Stopped(KeyboardInterrupt):
    """A descent was interrupted.

    Attributes:
        parameters: the best so far.
        history: of the losses, as far as it goes.
    """

    def __init__(self, parameters: Parameters, history: list[float]) -> None:
        """Keep what was reached."""
        super().__init__()
        self.parameters, self.history = parameters, history


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

    Raises:
        Stopped: it was interrupted; it holds the best so far.
    """
    objective = Objective.of(start, offsets, capture, geometry, conventions)
    moving = {name: offset.detach().clone().requires_grad_(True) for name, offset in offsets.items()}
    groups = [{"params": [tensor], "lr": rates[name]} for name, tensor in moving.items()]
    optimizer = torch.optim.Adam(groups, betas=ADAM_BETAS, eps=ADAM_EPSILON)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: share_of_rate(step, iterations))

    history: list[float] = []
    best, best_loss = {name: value.detach().clone() for name, value in moving.items()}, float("inf")

    def keep(loss: float) -> None:
        nonlocal best, best_loss
        history.append(loss)
        if loss < best_loss:
            best_loss = loss
            best = {name: value.detach().clone() for name, value in moving.items()}

    try:
        for iteration in range(iterations):
            optimizer.zero_grad(set_to_none=True)
            loss = objective.distance(moving)
            keep(float(loss.detach()))
            (loss * objective.own_pixels).backward()
            optimizer.step()
            schedule.step()
            if progress is not None:
                progress(iteration + 1, history[-1])
        with torch.no_grad():
            keep(float(objective.distance(moving)))
    except KeyboardInterrupt:
        if not history:
            raise
        raise Stopped(objective.moved(best), history) from None
    return objective.moved(best), history


def gradients(
    start: Parameters,
    capture: Capture | Sequence[Capture],
    geometry: Geometry | Sequence[Geometry] | None = None,
    conventions: Conventions = PAPER,
) -> Measure:
    """Return a function from parameters to the photos' distance and its gradient.

    Args:
        start: parameters of the size and type of those to come.
        capture: as in `descend`.
        geometry: as there.
        conventions: as there.

    Returns:
        Of the distance, and by map name the gradient of every pixel's own distance by its parameters. Clipped
        pixels say how theirs should move, too.
    """
    captures, geometries = several(capture, geometry, conventions)

    def measure(parameters: Parameters) -> tuple[float, dict[str, Float[Tensor, "1 c h w"]]]:
        zeros = {name: torch.zeros_like(getattr(parameters, name)).requires_grad_(True) for name in MAPS}
        objective = Objective.of(parameters, zeros, captures, geometries, conventions)
        distance = replace(objective, moves=torch.ones_like(objective.moves)).distance(zeros)
        found = torch.autograd.grad(distance * objective.own_pixels, list(zeros.values()))
        return float(distance.detach()), dict(zip(zeros, found, strict=True))

    return measure


def share_of_rate(step: int, iterations: int) -> float:
    """Return which share of the learning rates is left before a step, counted from 0."""
    return FINAL_RATE + (1.0 - FINAL_RATE) * math.cos(math.pi / 2 * step / max(1, iterations))


@dataclass(frozen=True)
class Objective:
    """The photos' distance from their renderings as a function of offsets.

    Attributes:
        start: where every pixel begins.
        own: names of the maps whose offsets are each pixel's own.
        captures: the photos.
        geometries: of their lights and cameras.
        conventions: of the renderer.
        moves: where a pixel's own offsets count. A clipped pixel cannot say which of its maps is wrong: of
            itself it keeps what it had. It still counts where all pixels move together. Of several photos it
            takes one in which it is not clipped.
        own_pixels: factor of the distance whose gradient is that of a pixel's own distance, or the average
            of these over all pixels where they share one offset.
    """

    start: Parameters
    own: tuple[str, ...]
    captures: list[Capture]
    geometries: list[Geometry]
    conventions: Conventions
    moves: Bool[Tensor, "1 1 h w"]
    own_pixels: int

    @staticmethod
    def of(
        start: Parameters,
        offsets: dict[str, Tensor],
        capture: Capture | Sequence[Capture],
        geometry: Geometry | Sequence[Geometry] | None,
        conventions: Conventions,
    ) -> Objective:
        """Take the arguments of `descend`."""
        captures, geometries = several(capture, geometry, conventions)
        own = tuple(name for name, offset in offsets.items() if offset.shape[-2:] == start.normal.shape[-2:])
        own_pixels = max(offset.shape[-2] * offset.shape[-1] for offset in offsets.values())
        moves = unsaturated_somewhere(captures)
        return Objective(start, own, captures, geometries, conventions, moves, own_pixels)

    def moved(self, offsets: dict[str, Tensor]) -> Parameters:
        """Return the parameters there."""
        return self.start.shifted(
            {name: value * self.moves if name in self.own else value for name, value in offsets.items()}
        )

    def distance(self, offsets: dict[str, Tensor]) -> Float[Tensor, ""]:
        """Return the sum of the photos' distances there."""
        material = self.moved(offsets).svbrdf()
        distances = [
            photo_distance(shade(material, geometry, self.conventions), capture.photo, capture.unsaturated)
            for capture, geometry in zip(self.captures, self.geometries, strict=True)
        ]
        return torch.stack(distances).sum()


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
