"""How well a material explains its photo: one number, in the encoding people look at."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nets.color import gamma_encode
from refine.bands import bands
from refine.capture import Capture


@torch.no_grad()
def rerendering_rmse(rendering: Float[Tensor, "1 3 h w"], capture: Capture) -> float | None:
    """Return the RMSE between a re-rendering and the photo, both gamma-encoded (1/2.2) and clamped to [0, 1].

    Only unsaturated pixels count: a clipped one does not say how bright the surface was.

    Args:
        rendering: linear radiance at the photo's size.
        capture: the photo.

    Returns:
        The error in [0, 1], or None if every pixel of the photo is saturated.
    """
    square, count = 0.0, 0
    for rows in bands(*rendering.shape[-2:]):
        seen, shown = (gamma_encode(image[..., rows, :]) for image in (capture.photo, rendering))
        counted = capture.unsaturated[..., rows, :]
        difference = torch.where(counted, shown - seen, 0.0).double()
        square, count = square + float(difference.square().sum()), count + int(counted.sum())
    return math.sqrt(square / (3 * count)) if count else None
