"""Map, rendering and light terms: distances between materials, all plain L1 means.

Each is a pure function of tensors. How they are weighted and combined is said in `objective.py`.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nets.generator import svbrdf_to_maps
from nets.render import Camera, PointLight, render
from nets.svbrdf import CHANNELS, MAPS, SVBRDF

LOG_OFFSET = 0.01
"""Added to linear radiance before the logarithm (Deschaintre et al. 2018, Gao et al. 2019)."""


def map_l1(estimate: SVBRDF, truth: SVBRDF) -> dict[str, Float[Tensor, ""]]:
    """Return the mean L1 distance of each map, by name, in the network's range [-1, 1] (Eq. 2)."""
    difference = (svbrdf_to_maps(estimate) - svbrdf_to_maps(truth)).abs()
    parts = torch.split(difference, [CHANNELS[name] for name in MAPS], dim=1)
    return {name: part.mean() for name, part in zip(MAPS, parts, strict=True)}


def log_l1(
    image: Float[Tensor, "*shape"], reference: Float[Tensor, "*shape"], offset: float = LOG_OFFSET
) -> Float[Tensor, ""]:
    """Return the mean of `|log(image + offset) - log(reference + offset)|` on linear radiance >= 0."""
    return (torch.log(image + offset) - torch.log(reference + offset)).abs().mean()


def rendering_log_l1(
    estimate: SVBRDF,
    truth: SVBRDF,
    lights: PointLight,
    camera: Camera | None = None,
    offset: float = LOG_OFFSET,
) -> Float[Tensor, ""]:
    """Return the log L1 distance of both materials rendered under the same lights, white from 1 on.

    Args:
        estimate: a batch of materials.
        truth: the same batch, ground truth.
        lights: as many as materials, or a multiple: light i lights material i mod batch.
        camera: shared by both renderings.
        offset: see `log_l1`; a larger one cares less for dark pixels.
    """
    repeats = lights.position.shape[0] // estimate.batch
    rendering = render(estimate.map(lambda t: t.repeat(repeats, 1, 1, 1)), lights, camera)
    with torch.no_grad():
        reference = render(truth.map(lambda t: t.repeat(repeats, 1, 1, 1)), lights, camera)
    # A picture is white from 1 on: there, brighter is not wrong, and darker only as far as one can see.
    rendering = torch.where(reference < 1.0, rendering, rendering.clamp(max=1.0))
    return log_l1(rendering, reference.clamp(max=1.0), offset)


def light_l1(estimate: Float[Tensor, "b 3"], truth: Float[Tensor, "b 3"]) -> Float[Tensor, ""]:
    """Return the mean L1 distance of standardised light positions (paper, "Light Position")."""
    return (estimate - truth).abs().mean()
