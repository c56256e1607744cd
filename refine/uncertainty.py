"""How well each map is known: the deviations that the photo leaves, in the units of the maps.

Before the photo is looked at, a pixel's maps are as doubtful as such maps are on the whole
(`refine.expected_error`). The photo narrows that along the few directions that change what it shows: the
posterior of Gauss and Newton (`refine.engine.gauss_newton`), whose curvature at the refined maps is turned
into standard deviations here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nets.svbrdf import MAPS, SVBRDF
from refine.bands import bands, cut, rows_geometry
from refine.capture import Capture
from refine.engine.gauss_newton import posterior_deviations
from refine.expected_error import ErrorModel, expected_errors
from refine.parametrization import ALBEDO_RANGE, PARAMETER_COUNTS, ROUGHNESS_RANGE, SLOPE_SCALE, Parameters

NOISE = 0.1
"""Standard deviation of the logarithm of radiance: what reflectance model, camera and light get wrong."""

HUBER = 3.0
"""Residuals beyond this many deviations tell less."""

FLATTEST = 2e-3
"""Smallest slope of a logistic curve that doubts are divided by: at its ends nothing would be doubtful."""

WIDEST = 4.0
"""Doubts are cut off at this many units of a parameter; beyond it the maps are at the ends of their range."""


def deviations(
    initial: SVBRDF,
    refined: SVBRDF,
    captures: Capture | Sequence[Capture],
    model: ErrorModel | None = None,
) -> dict[str, Float[Tensor, "1 1 h w"]]:
    """Return how far each map is likely to be off, pixel by pixel.

    Args:
        initial: where refinement began.
        refined: where it ended.
        captures: the photo that was explained, or several of one surface, each with its light.
        model: of the errors expected beforehand; by default that of the shipped network.

    Returns:
        By map name the root mean square over channels of the standard deviation, in the units of the map:
        components of the unit normal, linear albedo in [0, 1], roughness in [0, 1].
    """
    model = model or ErrorModel.shipped()
    photos = [captures] if isinstance(captures, Capture) else list(captures)
    expected = expected_errors(initial, refined, photos[0], model)
    found = {name: torch.empty_like(refined.roughness) for name in MAPS}
    for rows in bands(*refined.size):
        parameters = Parameters.from_svbrdf(cut(refined, rows))
        slopes = _slopes(parameters)
        widths = Parameters(
            *(
                (expected[:, [number], rows] * PER_COMPONENT.get(name, 1.0) / getattr(slopes, name)).clamp(
                    max=WIDEST
                )
                for number, name in enumerate(MAPS)
            )
        )
        parts = [_rows(photo, rows) for photo in photos]
        geometries = [rows_geometry(refined, rows, photo.light, photo.camera) for photo in photos]
        narrowed = posterior_deviations(
            parameters, parts, geometries, widths=widths, noise=NOISE, huber=HUBER
        )
        for name in MAPS:
            by_channel = getattr(narrowed, name) * getattr(slopes, name) / PER_COMPONENT.get(name, 1.0)
            rms = by_channel.square().mean(dim=1, keepdim=True).sqrt()
            found[name][..., rows, :] = rms * model.scale[name]
    return found


PER_COMPONENT = {"normal": 1.5**0.5}
"""A normal's error is a mean over three components, of which a normal that points up can move two."""


def _rows(photo: Capture, rows: slice) -> Capture:
    return replace(photo, photo=photo.photo[..., rows, :], unsaturated=photo.unsaturated[..., rows, :])


def _slopes(parameters: Parameters) -> Parameters:
    """Return how much each map changes with its parameter."""

    def logistic(name: str, interval: tuple[float, float]) -> Tensor:
        share = torch.sigmoid(getattr(parameters, name))
        return (interval[1] - interval[0]) * (share * (1.0 - share)).clamp(min=FLATTEST)

    slope = parameters.normal * SLOPE_SCALE
    up = torch.rsqrt(1.0 + slope.square().sum(dim=1, keepdim=True))
    return Parameters(
        (SLOPE_SCALE * up).expand(-1, PARAMETER_COUNTS["normal"], -1, -1),
        logistic("diffuse", ALBEDO_RANGE),
        logistic("roughness", ROUGHNESS_RANGE),
        logistic("specular", ALBEDO_RANGE),
    )
