"""Where the flash was: a small least-squares fit of the light's position to the photo.

The network's light head starts it; the material stays the network's but for a few global corrections,
which are forgotten afterwards: they only keep errors of the material out of the light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor
from torch.nn import functional

from nets.color import gamma_encode
from nets.render import PointLight, render
from nets.svbrdf import SVBRDF
from refine.capture import Capture

PRIOR_WIDTHS = (1.0, 1.0, 0.5)
"""How far the light may plausibly be from the light head's guess: x and y in units of its height, log z."""

CORRECTION_WIDTHS = (0.5, 1.0, 0.3)
"""Plausible global corrections: log of the roughness, log of the specular, log of the diffuse albedo."""


@dataclass(frozen=True)
class LightFit:
    """Settings of the light fit.

    Attributes:
        size: longer side of the picture it is fitted on, pixels.
        evaluations: most steps of the solver; each also renders once per unknown for its derivatives.
        residual_scale: encoded difference where the robust loss (soft L1) turns from square to linear.
        prior_weight: of the priors against the mean residual.
    """

    size: int = 48
    evaluations: int = 40
    residual_scale: float = 0.05
    prior_weight: float = 0.02


def fit_light(svbrdf: SVBRDF, guess: PointLight, capture: Capture, settings: LightFit) -> PointLight:
    """Fit the light's position to the photo, from a guess.

    Args:
        svbrdf: the initialization, at the photo's size.
        guess: the light head's estimate; intensity and falloff are kept.
        capture: the photo and camera.
        settings: see `LightFit`.

    Returns:
        The light with the fitted position, float32.
    """
    scale = settings.size / max(svbrdf.size)
    size = [max(1, round(side * scale)) for side in svbrdf.size]

    def small(tensor: Tensor) -> Tensor:
        return functional.interpolate(tensor.double(), size=size, mode="area")

    normal = small(svbrdf.normal)
    material = svbrdf.map(small)
    material = SVBRDF(
        functional.normalize(normal, dim=1), material.diffuse, material.roughness, material.specular
    )
    target = gamma_encode(small(capture.photo))
    seen = small(capture.unsaturated.float()) > 0.5
    x0, y0, z0 = (float(v) for v in guess.position[0])
    weight = settings.prior_weight * np.sqrt(target.numel())

    def light_at(unknowns: np.ndarray) -> PointLight:
        z = z0 * np.exp(unknowns[2])
        position = torch.tensor([[x0 + unknowns[0] * z0, y0 + unknowns[1] * z0, z]], dtype=torch.float64)
        return PointLight(position, guess.intensity.double(), guess.falloff)

    def residuals(unknowns: np.ndarray) -> np.ndarray:
        roughness, specular, diffuse = np.exp(unknowns[3:])
        corrected = SVBRDF(
            material.normal,
            (material.diffuse * diffuse).clamp(max=1.0),
            (material.roughness * roughness).clamp(1e-3, 1.0),
            (material.specular * specular).clamp(max=1.0),
        )
        rendering = gamma_encode(render(corrected, light_at(unknowns), capture.camera))
        difference = torch.where(seen, rendering - target, torch.relu(target - rendering))
        prior = weight * unknowns / np.array([*PRIOR_WIDTHS, *CORRECTION_WIDTHS])
        return np.concatenate([difference.numpy().ravel(), prior * settings.residual_scale])

    solution = least_squares(
        residuals,
        np.zeros(6),
        loss="soft_l1",
        f_scale=settings.residual_scale,
        x_scale=np.array([0.1, 0.1, 0.1, 0.2, 0.3, 0.1]),
        max_nfev=settings.evaluations,
        bounds=([-3, -3, -1.5, -2, -4, -1], [3, 3, 1.5, 2, 4, 1]),
    )
    fitted = light_at(solution.x)
    return PointLight(fitted.position.float(), guess.intensity, guess.falloff)
