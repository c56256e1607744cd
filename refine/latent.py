"""Explain photos in the latent space of an auto-encoder of materials, as Gao et al. 2019 do.

Only the latent code moves, so every step is a material that the decoder can make: that takes the place of a
prior. The photos' distance and its gradient by the material come from an engine; from there to the code it is
autograd.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from nets.baselines.autoencoder import STEEPEST, Autoencoder
from nets.checkpoint import load_autoencoder
from nets.generator import svbrdf_to_maps
from nets.svbrdf import MAPS, SVBRDF
from refine.capture import Capture
from refine.engine import find_gradients
from refine.engine.reference import Progress, Stopped
from refine.parametrization import LOGIT_MARGIN, ROUGHNESS_RANGE, SLOPE_SCALE, Parameters
from refine.stages import LatentStage, Recipe

BETA2 = 0.999
"""Of Adam, as always; beta1 is the stage's."""


def require_weights(recipe: Recipe) -> None:
    """Check that the auto-encoders of a recipe are there.

    Raises:
        nets.checkpoint.CheckpointError: one is not, or is none.
    """
    for stage in recipe.stages:
        if isinstance(stage, LatentStage):
            load_autoencoder(stage.checkpoint)


def descend_latent(
    start: Parameters,
    captures: Sequence[Capture],
    stage: LatentStage,
    engine: str,
    progress: Progress | None = None,
) -> tuple[Parameters, list[float]]:
    """Minimise the photos' distance over the latent code, from the code of the material at the start.

    Args:
        start: where the code comes from. Decoding it changes the material, mostly for the worse.
        captures: the photos to explain, each with its light.
        stage: steps, rate and the auto-encoder's name.
        engine: a name in `refine.engine.ENGINES`.
        progress: told of every iteration.

    Returns:
        The parameters with the lowest loss seen, and the loss before every step and after the last.

    Raises:
        nets.checkpoint.CheckpointError: the auto-encoder cannot be loaded.
        Stopped: it was interrupted; it holds the best so far.
    """
    network = load_autoencoder(stage.checkpoint).requires_grad_(False).to(start.normal)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    size = (start.normal.shape[-2], start.normal.shape[-1])
    measure = find_gradients(engine)(start, captures)
    code = encode(network, start.svbrdf()).requires_grad_(True)
    optimizer = torch.optim.Adam([code], lr=stage.rate, betas=(stage.beta1, BETA2))

    history: list[float] = []
    best, lowest = start, math.inf
    try:
        for iteration in range(stage.iterations + 1):
            found = decode(network, code, size)
            here = found.detach()
            distance, gradients = measure(here)
            if distance < lowest:
                best, lowest = here, distance
            history.append(distance)
            if iteration == stage.iterations:
                break
            optimizer.zero_grad(set_to_none=True)
            # Engines say how each pixel's own distance changes; the code moves the mean of all.
            torch.autograd.backward(
                [getattr(found, name) for name in MAPS],
                [gradients[name] / (size[0] * size[1]) for name in MAPS],
            )
            optimizer.step()
            if progress is not None:
                progress(iteration + 1, distance)
    except KeyboardInterrupt:
        if not history:
            raise
        raise Stopped(best, history) from None
    return best, history


@torch.no_grad()
def encode(network: Autoencoder, svbrdf: SVBRDF) -> Tensor:
    """Return the latent code of a material of any size: its last pixels are repeated to a legal one."""
    height, width = svbrdf.size
    multiple = network.config.multiple
    more = (0, -width % multiple, 0, -height % multiple)
    return network.encode(functional.pad(svbrdf_to_maps(svbrdf), more, mode="replicate"))


def decode(network: Autoencoder, code: Tensor, size: tuple[int, int]) -> Parameters:
    """Return the parameters of the material of a code, cut to height and width.

    The network's maps are `tanh z`, in [-1, 1]; `(1 + tanh z) / 2` is the logistic curve of `2 z`, so the
    parameters of albedos are `2 z`. Roughness has another range, and slopes are no logits.
    """
    free = network.decode(code)[..., : size[0], : size[1]].contiguous()
    slopes, diffuse, roughness, specular = free.split([2, 3, 1, 3], dim=1)
    low, high = ROUGHNESS_RANGE
    share = (torch.sigmoid(2.0 * roughness) - low) / (high - low)
    return Parameters(
        STEEPEST * torch.tanh(slopes) / SLOPE_SCALE,
        2.0 * diffuse,
        torch.logit(share.clamp(LOGIT_MARGIN, 1.0 - LOGIT_MARGIN)),
        2.0 * specular,
    )
