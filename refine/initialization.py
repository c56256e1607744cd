"""From a photo of any size to a starting material: the network sees a square, nothing is cropped away.

How the network's maps come to the pixels of a larger photo is the business of `upsampling.py`.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nets.ensemble import Predictor, predict_under
from nets.render import Camera, PointLight
from nets.svbrdf import SVBRDF
from refine.upsampling import Box, legal, upsample

NETWORK_SIZE = 256
"""Side of the square the network sees, pixels (paper Sec. 5.1)."""

Predict = Callable[[Float[Tensor, "1 3 256 256"]], tuple[SVBRDF, PointLight]]
"""Linear square photo to material and light: all that refinement asks of a model."""


def initialize(
    model: Predict | Predictor,
    photo: Float[Tensor, "1 3 h w"],
    light: PointLight | None = None,
    camera: Camera | None = None,
) -> tuple[SVBRDF, PointLight]:
    """Let the model guess the material of a whole photo.

    A photo that is not square is continued by mirroring, not squashed or cropped: the longer side spans
    [-1, 1] for the network as it does for the renderer.

    Args:
        model: `predict`, or an object that has it.
        photo: linear radiance of any size.
        light: of the photo, if known; a network with a revision makes use of it, and large photos need it,
            to tell slopes from paint.
        camera: of the photo, likewise; as in `nets.render.render`.

    Returns:
        A legal material at the photo's size, and the model's light.

    Raises:
        ValueError: if the model returns anything but a legal `SVBRDF` of the square's size and a light.
    """
    height, width = photo.shape[-2:]
    longer = max(height, width)
    top, left = (longer - height) // 2, (longer - width) // 2
    with torch.no_grad():
        seen = _square(photo, top, left)
        svbrdf, guess = _checked(_ask(model, seen, light, camera))
        svbrdf = svbrdf.detach()
        if longer > NETWORK_SIZE:
            place = Box(top / longer, left / longer, height / longer, width / longer)
            whole = upsample(svbrdf, seen, photo, place, light or guess, camera)
        else:
            window = (..., slice(top, top + height), slice(left, left + width))
            whole = legal(svbrdf.map(lambda tensor: _resize(tensor, (longer, longer))[window].contiguous()))
    return whole.validate(), guess


def _ask(model: Predict | Predictor, seen: Tensor, light: PointLight | None, camera: Camera | None) -> object:
    return predict_under(model, seen, light, camera) if isinstance(model, Predictor) else model(seen)


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


def _square(photo: Float[Tensor, "1 3 h w"], top: int, left: int) -> Float[Tensor, "1 3 256 256"]:
    """Continue a photo by mirroring to a square and resize that; its longer side first, to hold little."""
    height, width = photo.shape[-2:]
    if width >= height:
        narrow = _resize(photo, (height, NETWORK_SIZE))
        square = narrow[..., _mirrored(height, top, width - height - top), :]
    else:
        narrow = _resize(photo, (NETWORK_SIZE, width))
        square = narrow[..., _mirrored(width, left, height - width - left)]
    return _resize(square, (NETWORK_SIZE, NETWORK_SIZE))


def _resize(tensor: Tensor, size: tuple[int, int]) -> Tensor:
    if tuple(tensor.shape[-2:]) == size:
        return tensor
    smaller = size[0] < tensor.shape[-2] or size[1] < tensor.shape[-1]
    return functional.interpolate(tensor, size=size, mode="bilinear", align_corners=False, antialias=smaller)


def _mirrored(count: int, before: int, after: int) -> Tensor:
    # Indices of a mirrored continuation of any length: 2 1 0 | 0 1 2 | 2 1 0 ...
    index = torch.arange(-before, count + after) % (2 * count)
    return torch.where(index < count, index, 2 * count - 1 - index)
