"""From a photo of any size to a starting material: the network sees a square, nothing is cropped away."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nets.ensemble import Predictor
from nets.render import PointLight
from nets.svbrdf import MAPS, SVBRDF

NETWORK_SIZE = 256
"""Side of the square the network sees, pixels (paper Sec. 5.1)."""

Predict = Callable[[Float[Tensor, "1 3 256 256"]], tuple[SVBRDF, PointLight]]
"""Linear square photo to material and light: all that refinement asks of a model."""


def initialize(model: Predict | Predictor, photo: Float[Tensor, "1 3 h w"]) -> tuple[SVBRDF, PointLight]:
    """Let the model guess the material of a whole photo.

    A photo that is not square is continued by mirroring, not squashed or cropped: the longer side spans
    [-1, 1] for the network as it does for the renderer.

    Args:
        model: `predict`, or an object that has it.
        photo: linear radiance of any size.

    Returns:
        A legal material at the photo's size, and the model's light.

    Raises:
        ValueError: if the model returns anything but a legal `SVBRDF` of the square's size and a light.
    """
    predict = model.predict if isinstance(model, Predictor) else model
    height, width = photo.shape[-2:]
    longer = max(height, width)
    top, left = (longer - height) // 2, (longer - width) // 2
    square = _mirror_pad(photo, top, longer - height - top, left, longer - width - left)
    with torch.no_grad():
        svbrdf, light = _checked(predict(_resize(square, NETWORK_SIZE)))
    whole = svbrdf.detach().map(lambda tensor: _resize(tensor, longer))
    window = (..., slice(top, top + height), slice(left, left + width))
    return legal(whole.map(lambda tensor: tensor[window].contiguous())).validate(), light


def legal(svbrdf: SVBRDF) -> SVBRDF:
    """Return the nearest legal material: normals unit length, values in range (after resampling)."""
    normal, diffuse, roughness, specular = (getattr(svbrdf, name) for name in MAPS)
    return SVBRDF(
        functional.normalize(normal, dim=1),
        diffuse.clamp(0.0, 1.0),
        roughness.clamp(1e-3, 1.0),
        specular.clamp(0.0, 1.0),
    )


def _checked(answer: object) -> tuple[SVBRDF, PointLight]:
    if not isinstance(answer, tuple) or [type(part) for part in answer] != [SVBRDF, PointLight]:
        raise ValueError(f"the model returned {type(answer).__name__}, expected an SVBRDF and a PointLight")
    svbrdf, light = answer
    try:
        svbrdf.validate()
    except ValueError as error:
        raise ValueError(f"the model returned an illegal material: {error}") from None
    if (svbrdf.batch, *svbrdf.size) != (1, NETWORK_SIZE, NETWORK_SIZE):
        found, expected = tuple(svbrdf.normal.shape), (1, 3, NETWORK_SIZE, NETWORK_SIZE)
        raise ValueError(f"the model returned normals of shape {found}, expected {expected}")
    for name in ("position", "intensity"):
        values = getattr(light, name)
        if tuple(values.shape) != (1, 3) or not bool(torch.isfinite(values).all()):
            raise ValueError(
                f"the model returned the light's {name} {values.tolist()}, expected [1, 3] numbers"
            )
    return svbrdf, light


def _resize(tensor: Tensor, side: int) -> Tensor:
    if tensor.shape[-1] == side:
        return tensor
    smaller = side < tensor.shape[-1]
    return functional.interpolate(
        tensor, size=(side, side), mode="bilinear", align_corners=False, antialias=smaller
    )


def _mirror_pad(photo: Tensor, top: int, bottom: int, left: int, right: int) -> Tensor:
    rows = _mirrored(photo.shape[-2], top, bottom)
    columns = _mirrored(photo.shape[-1], left, right)
    return photo[..., rows, :][..., columns]


def _mirrored(count: int, before: int, after: int) -> Tensor:
    # Indices of a mirrored continuation of any length: 2 1 0 | 0 1 2 | 2 1 0 ...
    index = torch.arange(-before, count + after) % (2 * count)
    return torch.where(index < count, index, 2 * count - 1 - index)
