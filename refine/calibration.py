"""Where the flash was in several photos of one surface, and how brightly it shone: self-calibration.

Lights, exposures and a coarse material are fitted together (`refine.joint_problem`) to the means of square
blocks of pixels, for the lights' sake alone: the material of the fit is forgotten afterwards. What brightens
where against the other photos starts the lights; the distance, which shading knows least about, is started
at several values. What cannot be told is fixed: the geometric mean of the intensities is 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nets.color import gamma_encode
from nets.render import Camera, PointLight, surface_points
from nets.svbrdf import MAPS, SVBRDF
from refine.capture import Capture
from refine.joint_problem import EXPOSURE, LOG_Z, Estimate, JointProblem, MaterialPrior, X, Y
from refine.light import NORMAL_CONSISTENCY
from refine.parametrization import Parameters

BRIGHTEST = 0.95
"""Quantile of a photo's brightening from which on it counts fully."""

COARSE = 100.0
"""Times the tolerance while the lights are still on their way."""

HELD = 0.02
"""Standard deviation of the mean log distance while it is held."""

CONTRAST_POWER = 4
"""A brightening counts with this power, or the centre of the photo would win."""


@dataclass(frozen=True)
class SelfCalibration:
    """Settings of the joint fit of lights and material.

    Attributes:
        blocks: along the longer side; the material of each is a group of unknowns.
        scales: of the robust distance, from the first, under which everything fits, to the last, under which
            details count (graduated non-convexity).
        misfit_factor: the scale goes on shrinking to this many times the typical misfit.
        smallest_scale: but not below this encoded difference, which is what 8 bits leave of a block.
        distances: heights of the lights to start from, surface units.
        steps: most of every descent.
        tolerance: share of the cost that ends a descent.
        reach: how much farther out than the brightening's centre lights start: it lies inside the photo.
        offset_width: of x and y around their start, surface units.
        typical_distance: mean of the photos' log heights, before anything is known, as a height.
        distance_width: standard deviation of that mean.
        own_misfit: encoded misfit that is noise and every block's own. What is more is the reflectance
            model's and the same everywhere; so many blocks say no more than few, and that mean weighs more.
        spread_width: of a photo's log height around the mean of all.
        exposure_width: of a photo's log exposure around the mean of all.
        brightness_width: of the mean log exposure.
        prior: of the material.
    """

    blocks: int = 16
    scales: tuple[float, ...] = (0.1, 0.03, 0.01)
    misfit_factor: float = 3.0
    smallest_scale: float = 0.001
    distances: tuple[float, ...] = (2.0, 3.2, 5.0, 8.0)
    steps: int = 30
    tolerance: float = 1e-5
    reach: float = 1.1
    offset_width: float = 0.15
    typical_distance: float = 4.6
    distance_width: float = 0.35
    own_misfit: float = 0.0013
    spread_width: float = 0.05
    exposure_width: float = 0.3
    brightness_width: float = 1.0
    prior: MaterialPrior = field(default_factory=MaterialPrior)


@dataclass(frozen=True)
class Calibrated:
    """What a joint fit found.

    Attributes:
        lights: one per photo, as a batch, float32.
        cost: what it could not explain; comparable between falloffs.
    """

    lights: PointLight
    cost: float


def calibrate(
    initial: SVBRDF,
    captures: Sequence[Capture],
    falloff: Literal["none", "inverse_square"],
    settings: SelfCalibration,
    *,
    known: PointLight | None = None,
) -> Calibrated:
    """Find the lights of several photos of one surface, or only their exposures.

    Args:
        initial: a guess of the material, at the photos' size.
        captures: the photos, all of one size and with the same kind of camera.
        falloff: of the lights.
        settings: see `SelfCalibration`.
        known: one light per photo, as a batch, if positions are known: they are kept.

    Returns:
        Lights whose intensities have the geometric mean 1, grey.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # many small solves: more threads wait for each other most of the time
    try:
        return _calibrate(_problem(initial, captures, falloff, settings, known), settings, known)
    finally:
        torch.set_num_threads(threads)


def _calibrate(problem: JointProblem, settings: SelfCalibration, known: PointLight | None) -> Calibrated:
    starts = [_start(problem, height) for height in (settings.distances if known is None else [None])]

    def at(scale: float, held: Estimate | None = None) -> JointProblem:
        lights = problem.lights if held is None else _around(problem.lights, held.lights)
        weights = _light_weights(problem, settings, scale, held is not None)
        return replace(problem, scale=scale, lights=lights, light_weights=weights)

    for coarse in settings.scales[:-1]:
        # Each start keeps its distance until the material has settled, or all would run into one valley.
        starts = [
            at(coarse, start).improve(start, settings.steps, COARSE * settings.tolerance) for start in starts
        ]
    scale: float | None = settings.scales[-1]
    while scale is not None:
        last = at(scale)
        found = [last.improve(start, settings.steps, COARSE * settings.tolerance) for start in starts]
        starts = [
            last.improve(_cheapest(last, estimate, found), settings.steps, settings.tolerance)
            for estimate in found
        ]
        best = min(starts, key=lambda estimate: estimate.cost)
        scale = _finer_scale(last, best, settings)
    return Calibrated(_lights(last, best, known), best.cost)


def moving_highlights(
    photos: Float[Tensor, "photos 3 h w"], points: Float[Tensor, "3 h w"]
) -> Float[Tensor, "photos 2"]:
    """Return where each photo is brighter than the photos are on the whole: the highlight, on the surface.

    What does not move with the light, the surface's colours, is in all photos and drops out.

    Args:
        photos: linear radiance.
        points: of the surface.

    Returns:
        x and y, in surface units.
    """
    brightness = gamma_encode(photos.mean(dim=1)).log()
    more = brightness - brightness.quantile(0.5, dim=0)
    more = more - more.flatten(1).quantile(0.5, dim=1)[:, None, None]
    brightest = more.flatten(1).quantile(BRIGHTEST, dim=1).clamp(min=1e-3)
    weight = (more / brightest[:, None, None]).clamp(0.0, 1.0) ** CONTRAST_POWER + 1e-9
    return torch.einsum("phw,dhw->pd", weight, points[:2]) / weight.sum(dim=(1, 2))[:, None]


def _problem(
    initial: SVBRDF,
    captures: Sequence[Capture],
    falloff: Literal["none", "inverse_square"],
    settings: SelfCalibration,
    known: PointLight | None,
) -> JointProblem:
    side = max(1, max(initial.size) // settings.blocks)

    def blocks(tensor: Tensor) -> Tensor:
        return functional.avg_pool2d(tensor.double().cpu(), side)

    photos = blocks(torch.cat([capture.photo for capture in captures]))
    unsaturated = blocks(torch.cat([capture.unsaturated for capture in captures])) == 1.0
    points = blocks(surface_points(*initial.size)[None])[0]
    parameters = Parameters.from_svbrdf(initial)
    material = torch.cat([blocks(getattr(parameters, name)) for name in MAPS], dim=1)[0].flatten(1)
    # A network takes the flash's falloff for slopes; a surface is flat at large.
    plane = torch.stack([torch.ones_like(points[0]), points[0], points[1]]).flatten(1)
    material[:2] -= material[:2] @ torch.linalg.pinv(plane) @ plane

    lights = torch.zeros(len(captures), 4, dtype=torch.float64)
    if known is None:
        lights[:, LOG_Z] = math.log(settings.typical_distance)
        highlight = settings.reach * moving_highlights(photos, points)
        lights[:, [X, Y]] = _below_the_light(highlight, captures[0].camera, settings.typical_distance)
    else:
        lights[:, :3] = known.position.double().cpu()
        lights[:, LOG_Z] = lights[:, LOG_Z].log()
    if falloff == "inverse_square":
        lights[:, EXPOSURE] = 2.0 * lights[:, LOG_Z].mean()
    free = (EXPOSURE,) if known is not None else (X, Y, LOG_Z, EXPOSURE)
    return JointProblem(
        encoded=gamma_encode(photos).flatten(2),
        unsaturated=unsaturated.flatten(2),
        points=points.flatten(1)[:, None],
        material=material,
        prior=settings.prior,
        lights=lights,
        light_weights=torch.zeros(len(captures) * len(free), len(captures) * len(free)).double(),
        free=free,
        camera=captures[0].camera,
        falloff=falloff,
        scale=settings.scales[0],
    )


def _below_the_light(
    highlight: Float[Tensor, "photos 2"], camera: Camera, height: float
) -> Float[Tensor, "photos 2"]:
    """Return where the light is if a flat surface mirrors it there: beyond, if it is above the camera."""
    if camera.kind != "perspective":
        return highlight
    eye = torch.tensor(camera.position, dtype=highlight.dtype)
    return highlight + (highlight - eye[:2]) * height / eye[2]


def _start(problem: JointProblem, height: float | None) -> Estimate:
    """Start at a height, or where the lights are known to be."""
    lights = problem.lights.clone()
    if height is not None:
        lights[:, LOG_Z] = math.log(height)
        if problem.falloff == "inverse_square":
            lights[:, EXPOSURE] = 2.0 * math.log(height)
    return Estimate(problem.material.clone(), lights, torch.zeros(3, dtype=torch.float64))


def _around(lights: Float[Tensor, "photos 4"], start: Float[Tensor, "photos 4"]) -> Tensor:
    """Put the prior's mean distance and brightness where a start has them."""
    lights = lights.clone()
    lights[:, [LOG_Z, EXPOSURE]] = start[:, [LOG_Z, EXPOSURE]].mean(dim=0)
    return lights


def _light_weights(
    problem: JointProblem, settings: SelfCalibration, scale: float, held: bool
) -> Float[Tensor, "unknown unknown"]:
    """Return the inverse covariance of the free numbers: of each photo's, or of their mean and spread."""
    photos, free = len(problem.lights), problem.free
    eye = torch.eye(photos, dtype=torch.float64)
    mean = torch.full_like(eye, 1.0 / photos)

    def mean_and_spread(of_mean: float, of_photo: float) -> Tensor:
        return (eye - mean) / of_photo**2 + mean / photos / of_mean**2

    doubt = min(1.0, settings.own_misfit / scale)
    distance_width = HELD if held else settings.distance_width * doubt
    by_number = {
        X: eye / settings.offset_width**2,
        Y: eye / settings.offset_width**2,
        LOG_Z: mean_and_spread(distance_width, settings.spread_width * doubt),
        EXPOSURE: mean_and_spread(settings.brightness_width, settings.exposure_width),
    }
    weights = torch.zeros(photos, len(free), photos, len(free), dtype=torch.float64)
    for place, number in enumerate(free):
        weights[:, place, :, place] = by_number[number]
    return weights.reshape(photos * len(free), -1)


def _cheapest(problem: JointProblem, estimate: Estimate, others: Sequence[Estimate]) -> Estimate:
    """Give each pixel the material, of those that were found under any lights, that costs it least.

    Single pixels get stuck, each in a minimum of its own, and what they cost hides what the lights do.
    """
    materials = torch.stack([estimate.material, *(other.material for other in others)])
    costs = torch.stack([problem.cost_by_pixel(replace(estimate, material=one)) for one in materials])
    chosen = materials[costs.argmin(dim=0), :, torch.arange(materials.shape[-1])]
    return replace(estimate, material=chosen.T.contiguous())


def _finer_scale(problem: JointProblem, estimate: Estimate, settings: SelfCalibration) -> float | None:
    """Return a third of the scale, or what the misfit asks for if that is more; None if that is no gain."""
    residuals = problem.residuals(estimate.material, estimate.lights)
    typical = NORMAL_CONSISTENCY * float(residuals[problem.unsaturated.expand_as(residuals)].abs().median())
    wanted = max(settings.misfit_factor * typical, settings.smallest_scale, problem.scale / 3.0)
    return wanted if wanted < problem.scale / 1.2 else None


def _lights(problem: JointProblem, estimate: Estimate, known: PointLight | None) -> PointLight:
    found = problem.point_light(estimate.lights)
    intensity = found.intensity / found.intensity.log().mean().exp()
    position = found.position if known is None else known.position.cpu()
    return PointLight(position.float(), intensity.float(), problem.falloff)
