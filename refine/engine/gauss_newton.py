"""Gauss-Newton on the posterior of every pixel, with autograd and Woodbury: obvious, slow, on any device.

Shading is a function of one pixel, so a photo is H W small problems: three residuals per photo for nine
parameters. What the photo leaves open is held by a prior, a normal distribution around the initialization.
Each pixel minimises

    sum_photos sum_colours huber(log((R + e) / (I + e)) / noise) + 1/2 sum_k ((x_k - centre_k) / width_k)^2

by damped Gauss-Newton steps (Levenberg-Marquardt, Huber's weights anew in every step), and takes a step only
if it lowers its own objective. At the solution the curvature tells how well each parameter is known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from losses.refinement import log_residual
from nets.render import PAPER, Conventions, Geometry, shade
from nets.svbrdf import MAPS
from refine.capture import Capture
from refine.engine.reference import Progress, several, unsaturated_somewhere
from refine.parametrization import PARAMETER_COUNTS, Parameters

FIRST_DAMPING = 1e-3
"""Damping at the start, as a share of the prior's curvature."""

ACCEPTED, REJECTED = 0.3, 8.0
"""Factors of the damping after a step that is taken, and after one that is not."""

DAMPING_RANGE = (1e-4, 1e6)


@dataclass(frozen=True)
class Posterior:
    """Where a solver ended.

    Attributes:
        parameters: the most probable ones.
        deviations: their standard deviations, by the curvature there; 0 where a map does not move.
        objective: mean over the pixels, before every step and after the last; it never rises.
        history: the photos' distances likewise, as the other engines' (`losses.refinement.photo_distance`).
    """

    parameters: Parameters
    deviations: Parameters
    objective: list[float]
    history: list[float]


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
    """Find every pixel's most probable parameters.

    Args:
        start: where every pixel begins, and the centre of the prior.
        capture: the photo to explain, or several of the same surface.
        geometry: of the light and camera of each; by default what the photos say of them.
        iterations: steps.
        widths: standard deviation of the prior by map name; maps that are not named keep what they have.
        noise: standard deviation of the logarithm of radiance.
        huber: residuals beyond this many deviations count linearly.
        conventions: of the renderer.
        progress: told of every iteration.
    """
    captures, geometries = several(capture, geometry, conventions)
    middle = stack(start)
    offset = torch.zeros_like(middle)
    moves = unsaturated_somewhere(captures)  # a clipped pixel cannot say which of its maps is wrong
    variance = _variances(widths, middle) * moves

    def residuals(offset: Float[Tensor, "1 9 h w"]) -> Float[Tensor, "1 n h w"]:
        return _residuals(middle + offset, captures, geometries, conventions)

    def cost_of(offset: Tensor, found: Tensor) -> Float[Tensor, "1 1 h w"]:
        scaled = found.abs() / noise
        data = torch.where(scaled < huber, 0.5 * scaled**2, huber * (scaled - 0.5 * huber))
        prior = torch.where(variance > 0.0, offset**2 / variance, 0.0)
        return data.sum(dim=1, keepdim=True) + 0.5 * prior.sum(dim=1, keepdim=True)

    cost = cost_of(offset, residuals(offset))
    damping = torch.full_like(cost, FIRST_DAMPING)
    objective, history = [float(cost.double().mean())], list[float]()
    for iteration in range(iterations):
        found, jacobian = _linearised(residuals, offset)
        history.append(_distance(found))
        free = variance / (1.0 + damping)  # the damped prior's
        gain, _ = _gain(jacobian, found, free, noise, huber)
        # The step that the damped prior alone would take, corrected by what the photo says against it.
        home = -offset / (1.0 + damping)
        step = home - torch.einsum("bhwkn,bnhw->bkhw", gain, found + _apply(jacobian, home))
        trial = offset + torch.where(variance > 0.0, step, 0.0)
        new = cost_of(trial, residuals(trial))
        better = new < cost
        offset, cost = torch.where(better, trial, offset), torch.where(better, new, cost)
        damping = (damping * torch.where(better, ACCEPTED, REJECTED)).clamp(*DAMPING_RANGE)
        objective.append(float(cost.double().mean()))
        if progress is not None:
            progress(iteration + 1, history[-1])
    found, jacobian = _linearised(residuals, offset)
    history.append(_distance(found))
    deviations = _deviations(jacobian, found, variance.expand_as(offset), noise, huber)
    return Posterior(unstack(middle + offset), unstack(deviations), objective, history)


def posterior_deviations(
    parameters: Parameters,
    capture: Capture | Sequence[Capture],
    geometry: Geometry | Sequence[Geometry] | None = None,
    *,
    widths: Parameters,
    noise: float,
    huber: float,
    conventions: Conventions = PAPER,
) -> Parameters:
    """Return the standard deviations that photos leave to parameters, by the curvature where they are.

    Args:
        parameters: the most probable ones.
        capture: as in `solve`.
        geometry: as there.
        widths: standard deviation of each parameter before the photos are looked at, pixel by pixel.
        noise: as in `solve`.
        huber: as there.
        conventions: as there.
    """
    captures, geometries = several(capture, geometry, conventions)
    middle = stack(parameters)
    found, jacobian = _linearised(
        lambda offset: _residuals(middle + offset, captures, geometries, conventions),
        torch.zeros_like(middle),
    )
    return unstack(_deviations(jacobian, found, stack(widths) ** 2, noise, huber))


def stack(parameters: Parameters) -> Float[Tensor, "1 9 h w"]:
    """Return all parameters along channels, in the order of `MAPS`."""
    return torch.cat([getattr(parameters, name) for name in MAPS], dim=1)


def unstack(channels: Float[Tensor, "1 9 h w"]) -> Parameters:
    """Invert `stack`."""
    return Parameters(*torch.split(channels, [PARAMETER_COUNTS[name] for name in MAPS], dim=1))


def _variances(widths: Mapping[str, float], like: Tensor) -> Float[Tensor, "1 9 1 1"]:
    values = [widths.get(name, 0.0) ** 2 for name in MAPS for _ in range(PARAMETER_COUNTS[name])]
    return like.new_tensor(values)[None, :, None, None]


def _residuals(
    parameters: Float[Tensor, "1 9 h w"],
    captures: Sequence[Capture],
    geometries: Sequence[Geometry],
    conventions: Conventions,
) -> Float[Tensor, "1 n h w"]:
    material = unstack(parameters).svbrdf()
    return torch.cat(
        [
            log_residual(shade(material, geometry, conventions), photo.photo, photo.unsaturated)
            for photo, geometry in zip(captures, geometries, strict=True)
        ],
        dim=1,
    )


def _deviations(
    jacobian: Tensor, found: Tensor, variance: Float[Tensor, "1 9 h w"], noise: float, huber: float
) -> Float[Tensor, "1 9 h w"]:
    """Return the diagonal of the posterior's covariance, as deviations."""
    gain, told = _gain(jacobian, found, variance, noise, huber)
    known = torch.einsum("bhwkn,bnkhw->bkhw", gain, told)
    return (variance - known).clamp(min=0.0).sqrt()


def _linearised(residuals, offset: Tensor) -> tuple[Float[Tensor, "1 n h w"], Float[Tensor, "1 n 9 h w"]]:  # type: ignore[no-untyped-def]
    """Return residuals and their derivatives, one backward pass per residual: pixels do not mix."""
    with torch.enable_grad():
        leaf = offset.detach().requires_grad_(True)
        found = residuals(leaf)
        rows = [
            torch.autograd.grad(found[:, n].sum(), leaf, retain_graph=True)[0] for n in range(found.shape[1])
        ]
    return found.detach(), torch.stack(rows, dim=1)


def _gain(
    jacobian: Tensor, found: Tensor, variance: Tensor, noise: float, huber: float
) -> tuple[Float[Tensor, "1 h w 9 n"], Float[Tensor, "1 n 9 h w"]]:
    """Return Woodbury's `C J^T (J C J^T + S)^-1`, and `J C`, with Huber's weights in S.

    Where derivatives are so large that S is lost in rounding, residuals that say the same make the matrix
    singular: the smallest of all solutions is taken there, which is the limit of small S.
    """
    told = jacobian * variance[:, None]
    spread = noise**2 * (found.abs() / (noise * huber)).clamp(min=1.0)
    inner = torch.einsum("bnkhw,bmkhw->bhwnm", told, jacobian)
    inner = inner + torch.diag_embed(spread.permute(0, 2, 3, 1))
    side = told.permute(0, 3, 4, 1, 2)
    gain, failures = torch.linalg.solve_ex(inner, side)
    singular = (failures > 0) & inner.isfinite().all(dim=-1).all(dim=-1)
    if bool(singular.any()):
        rounding = inner.shape[-1] * torch.finfo(inner.dtype).eps
        inverse = torch.linalg.pinv(inner[singular].double(), rtol=rounding, hermitian=True)
        gain[singular] = (inverse @ side[singular].double()).to(gain.dtype)
    return gain.transpose(-1, -2), told


def _distance(found: Tensor) -> float:
    """Return the sum over photos of their mean distance."""
    return float(found.abs().double().mean()) * found.shape[1] / 3


def _apply(jacobian: Tensor, step: Tensor) -> Float[Tensor, "1 n h w"]:
    return (jacobian * step[:, None]).sum(dim=2)
