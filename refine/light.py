"""Where the flash was: a small least-squares fit of the light's position to the photo.

The network starts it with a direction; the height is the camera's, where a flash is. The material stays the
network's but for three global corrections, which are forgotten afterwards: they only keep errors of the
material out of the light. What the photo cannot say, because the material does not explain it well enough,
stays as it started: a light that is wrong is paid for in albedo.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from scipy.optimize import least_squares

from nets.color import gamma_encode
from nets.render import Camera, PointLight, shade, shading_geometry, surface_points
from nets.svbrdf import SVBRDF
from refine.capture import Capture

FALLOFFS: tuple[Literal["none", "inverse_square"], ...] = ("none", "inverse_square")

FalloffChoice = Literal["none", "inverse_square", "auto"] | None
"""How a light whose position is not known falls off; None: as the model says."""

NORMAL_CONSISTENCY = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

STEP_SCALES = (0.1, 0.1, 0.1, 0.2, 0.3, 0.1)
"""Typical changes of the unknowns: x and y in units of the light's height, log height, log corrections."""

BOUNDS = (3.0, 3.0, 1.5, 2.0, 4.0, 1.0)
"""The unknowns stay within plus and minus this."""


@dataclass(frozen=True)
class LightFit:
    """Settings of the light fit.

    Attributes:
        samples: pixels along the longer side that are compared; the photo is sampled, not blurred, so that
            shading stays exact.
        flash_at_camera: start at the height of a perspective camera, in the direction the network says: its
            own height is off by a quarter, and a flash is beside the lens. Otherwise start where it says.
        evaluations: most steps of the solver; each also renders once per unknown for its derivatives. 0
            leaves the light where it starts.
        residual_scale: encoded difference where the robust loss (soft L1) turns from square to linear.
        loose_prior: weight of the prior in the first pass, which finds how well the material explains the
            photo at all.
        prior: weight of the prior in the second pass, in units of the first one's misfit, times the cube of
            the misfit in units of `trusted`.
        trusted: encoded misfit that rounding to 8 bits leaves of a material that is known.
        offset_width: how far the flash may be from the x and y it starts at, in units of its height.
        distance_width: standard deviation of the logarithm of its height around where it starts.
        roughness_width: of the logarithm of a global correction of the roughness.
        specular_width: of the specular albedo.
        diffuse_width: of the diffuse albedo.
    """

    flash_at_camera: bool = True
    samples: int = 52
    evaluations: int = 40
    residual_scale: float = 0.05
    loose_prior: float = 0.02
    prior: float = 0.25
    trusted: float = 0.002
    offset_width: float = 0.3
    distance_width: float = 0.2
    roughness_width: float = 0.5
    specular_width: float = 1.0
    diffuse_width: float = 0.3

    @property
    def widths(self) -> np.ndarray:  # [6]
        """Prior standard deviations of the six unknowns."""
        return np.array(
            [
                self.offset_width,
                self.offset_width,
                self.distance_width,
                self.roughness_width,
                self.specular_width,
                self.diffuse_width,
            ]
        )


def check_falloff(name: str | None) -> None:
    """Check that a falloff is one of `FalloffChoice`.

    Raises:
        ValueError: it is not, naming those there are.
    """
    if name not in (None, "auto", *FALLOFFS):
        known = ", ".join((*FALLOFFS, "auto"))
        raise ValueError(f"no falloff is called {name!r}; the known ones are {known}")


def fit_light(svbrdf: SVBRDF, guess: PointLight, capture: Capture, settings: LightFit) -> PointLight:
    """Fit the light's position to the photo, from a guess.

    Two passes of the same robust least squares (scipy, trust region reflective). The first nearly ignores the
    prior. Its misfit says how far the network's material is to be trusted, and so how much the second one
    leaves where the light started: a perfect material finds it to a percent, a poor one cannot drag it away.

    Args:
        svbrdf: the initialization, at the photo's size.
        guess: the network's estimate; intensity and falloff are kept.
        capture: the photo and camera.
        settings: see `LightFit`.

    Returns:
        The light with the fitted position, float32.
    """
    return _fit(svbrdf, guess, capture, settings)[0]


def fit_light_and_falloff(
    svbrdf: SVBRDF, guess: PointLight, capture: Capture, settings: LightFit
) -> PointLight:
    """Fit the position as `fit_light` does with every falloff, and keep what explains the photo best."""
    fits = [_fit(svbrdf, replace(guess, falloff=name), capture, settings) for name in FALLOFFS]
    return min(fits, key=lambda fit: fit[1])[0]


def starting_light(guess: PointLight, camera: Camera) -> PointLight:
    """Return a light in the direction of a guess, as high above the surface as a perspective camera.

    Args:
        guess: a network's estimate; intensity and falloff are kept.
        camera: of the photo. One that has no height, orthographic or at the light, leaves the guess as it is.
    """
    if camera.kind != "perspective":
        return guess
    height = guess.position.new_tensor(camera.position[2])
    return replace(guess, position=guess.position * (height / guess.position[:, 2:]))


def _fit(svbrdf: SVBRDF, guess: PointLight, capture: Capture, settings: LightFit) -> tuple[PointLight, float]:
    """Return the fitted light, and the robust misfit it leaves."""
    stride = max(1, max(svbrdf.size) // settings.samples)
    pixels = (..., slice(stride // 2, None, stride), slice(stride // 2, None, stride))
    material = svbrdf.map(lambda tensor: tensor[pixels].double().cpu())
    points = surface_points(*svbrdf.size, dtype=torch.float64)[pixels]
    target = gamma_encode(capture.photo[pixels].double().cpu())
    unsaturated = capture.unsaturated[pixels].cpu()
    intensity = guess.intensity.double().cpu()
    start = starting_light(guess, capture.camera) if settings.flash_at_camera else guess
    x, y, z = (float(value) for value in start.position[0])

    def light_at(unknowns: np.ndarray) -> PointLight:  # [6]
        position = [x + unknowns[0] * z, y + unknowns[1] * z, z * np.exp(unknowns[2])]
        return PointLight(torch.tensor([position], dtype=torch.float64), intensity, guess.falloff)

    def differences(unknowns: np.ndarray) -> np.ndarray:  # [6] -> [3 h w]
        roughness, specular, diffuse = np.exp(unknowns[3:])
        corrected = SVBRDF(
            material.normal,
            (material.diffuse * diffuse).clamp(max=1.0),
            (material.roughness * roughness).clamp(1e-3, 1.0),
            (material.specular * specular).clamp(max=1.0),
        )
        rendering = gamma_encode(
            shade(corrected, shading_geometry(points, light_at(unknowns), capture.camera))
        )
        return torch.where(unsaturated, rendering - target, (target - rendering).relu()).numpy().ravel()

    def misfit_of(unknowns: np.ndarray) -> float:
        scaled = differences(unknowns) / settings.residual_scale
        return float(np.mean(np.sqrt(1.0 + scaled**2) - 1.0))

    def solve(prior: float) -> np.ndarray:  # [6]
        weights = prior * np.sqrt(target.numel()) / settings.widths
        solution = least_squares(
            lambda unknowns: np.concatenate([differences(unknowns), weights * unknowns]),
            np.zeros(len(BOUNDS)),
            loss="soft_l1",
            f_scale=settings.residual_scale,
            x_scale=STEP_SCALES,
            max_nfev=settings.evaluations,
            bounds=(-np.array(BOUNDS), np.array(BOUNDS)),
        )
        return np.asarray(solution.x)

    if not settings.evaluations:
        return start, misfit_of(np.zeros(len(BOUNDS)))
    loose = solve(settings.loose_prior * settings.residual_scale)
    misfit = NORMAL_CONSISTENCY * float(np.median(np.abs(differences(loose))))
    solution = solve(settings.prior * misfit * (misfit / settings.trusted) ** 3)
    position = light_at(solution).position.float()
    return PointLight(position, guess.intensity.float().cpu(), guess.falloff), misfit_of(solution)
