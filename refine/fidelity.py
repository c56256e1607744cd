"""How well a material explains its photo: one number, in the encoding people look at."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nets.color import gamma_encode
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
    difference = (gamma_encode(rendering) - gamma_encode(capture.photo)).double()
    counted = capture.unsaturated.expand_as(difference)
    if not bool(counted.any()):
        return None
    return float(difference[counted].square().mean().sqrt())
