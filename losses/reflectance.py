"""Map, rendering and light terms: distances between materials, all plain L1 means.

Each is a pure function of tensors. How they are weighted and combined is said in `objective.py`.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nets.color import gamma_encode_from_floor
from nets.generator import svbrdf_to_maps
from nets.render import Camera, PointLight, render
from nets.svbrdf import CHANNELS, MAPS, SVBRDF

LOG_OFFSET = 0.01
"""Added to linear radiance before the logarithm (Deschaintre et al. 2018, Gao et al. 2019)."""


def map_l1(estimate: SVBRDF, truth: SVBRDF) -> dict[str, Float[Tensor, ""]]:
    """Return the mean L1 distance of each map, by name, in the network's range [-1, 1] (Eq. 2)."""
    found, expected = network_maps(estimate), network_maps(truth)
    return {name: (found[name] - expected[name]).abs().mean() for name in MAPS}


def network_maps(svbrdf: SVBRDF) -> dict[str, Float[Tensor, "b _ h w"]]:
    """Return each map in the network's range [-1, 1], by name; normals are of unit length."""
    parts = torch.split(svbrdf_to_maps(svbrdf), [CHANNELS[name] for name in MAPS], dim=1)
    return dict(zip(MAPS, parts, strict=True))


def log_difference(
    image: Float[Tensor, "*shape"], reference: Float[Tensor, "*shape"], offset: float = LOG_OFFSET
) -> Float[Tensor, "*shape"]:
    """Return `log(image + offset) - log(reference + offset)` of linear radiance >= 0."""
    return torch.log(image + offset) - torch.log(reference + offset)


def encoded_difference(
    image: Float[Tensor, "*shape"], reference: Float[Tensor, "*shape"]
) -> Float[Tensor, "*shape"]:
    """Return the difference of gamma-encoded pictures; radiance above 1 is not clipped here."""
    return gamma_encode_from_floor(image) - gamma_encode_from_floor(reference)


def log_l1(
    image: Float[Tensor, "*shape"], reference: Float[Tensor, "*shape"], offset: float = LOG_OFFSET
) -> Float[Tensor, ""]:
    """Return the mean of `|log(image + offset) - log(reference + offset)|` on linear radiance >= 0."""
    return log_difference(image, reference, offset).abs().mean()


def rendering_pair(
    estimate: SVBRDF, truth: SVBRDF, lights: PointLight, camera: Camera | None = None
) -> tuple[Float[Tensor, "n 3 h w"], Float[Tensor, "n 3 h w"]]:
    """Render both materials under the same lights, white from 1 on.

    Args:
        estimate: a batch of materials.
        truth: the same batch, ground truth; nothing flows back through it.
        lights: as many as materials, or a multiple: light i lights material i mod batch.
        camera: shared by both renderings.

    Returns:
        Linear radiance of the estimate, and of the truth in [0, 1].
    """
    repeats = lights.position.shape[0] // estimate.batch
    rendering = render(estimate.map(lambda t: t.repeat(repeats, 1, 1, 1)), lights, camera)
    with torch.no_grad():
        reference = render(truth.map(lambda t: t.repeat(repeats, 1, 1, 1)), lights, camera)
    return white_from_one(rendering, reference)


def white_from_one(
    rendering: Float[Tensor, "n 3 h w"], reference: Float[Tensor, "n 3 h w"]
) -> tuple[Float[Tensor, "n 3 h w"], Float[Tensor, "n 3 h w"]]:
    """Clip two pictures as a camera would, the estimate only where clipping hides nothing.

    Where the reference is white, brighter is not wrong, and darker only as far as one can see. Elsewhere a
    rendering above 1 keeps its value, and with it its gradient.
    """
    shown = torch.where(reference < 1.0, rendering, rendering.clamp(max=1.0))
    return shown, reference.clamp(max=1.0)


def rendering_log_l1(
    estimate: SVBRDF,
    truth: SVBRDF,
    lights: PointLight,
    camera: Camera | None = None,
    offset: float = LOG_OFFSET,
) -> Float[Tensor, ""]:
    """Return the log L1 distance of both materials' renderings; arguments as `rendering_pair`.

    Args:
        estimate: a batch of materials.
        truth: the same batch, ground truth.
        lights: as many as materials, or a multiple.
        camera: shared by both renderings.
        offset: see `log_l1`; a larger one cares less for dark pixels.
    """
    return log_l1(*rendering_pair(estimate, truth, lights, camera), offset)


def light_l1(estimate: Float[Tensor, "b 3"], truth: Float[Tensor, "b 3"]) -> Float[Tensor, ""]:
    """Return the mean L1 distance of standardised light positions (paper, "Light Position")."""
    return (estimate - truth).abs().mean()
