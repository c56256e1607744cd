"""Data terms of refinement: how far a rendering is from the photo, pixel by pixel."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from losses.reflectance import LOG_OFFSET, log_difference


def photo_distance(
    rendering: Float[Tensor, "b 3 h w"],
    photo: Float[Tensor, "b 3 h w"],
    unsaturated: Bool[Tensor, "b 1 h w"],
    offset: float = LOG_OFFSET,
) -> Float[Tensor, ""]:
    """Return the mean of `|log_residual|` over pixels and colours."""
    return log_residual(rendering, photo, unsaturated, offset).abs().mean()


def log_residual(
    rendering: Float[Tensor, "b 3 h w"],
    photo: Float[Tensor, "b 3 h w"],
    unsaturated: Bool[Tensor, "b 1 h w"],
    offset: float = LOG_OFFSET,
) -> Float[Tensor, "b 3 h w"]:
    """Return `log(rendering + offset) - log(photo + offset)` of linear radiance.

    A clipped pixel says no more than "at least 1", so there the rendering is clipped too: brighter
    renderings cost nothing and darker ones do.
    """
    return log_difference(torch.where(unsaturated, rendering, rendering.clamp(max=1.0)), photo, offset)
