"""Explain photos in the latent space of an auto-encoder of materials, as Gao et al. 2019 do.

Only the latent code moves, so every step is a material that the decoder can make: that takes the place of a
prior. The photos' distance and its gradient by the material come from an engine; from there to the code it is
autograd.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from nets.baselines.autoencoder import Autoencoder
from nets.checkpoint import load_autoencoder
from nets.generator import maps_to_svbrdf, svbrdf_to_maps
from nets.svbrdf import MAPS, SVBRDF
from refine.bands import photo_geometry
from refine.capture import Capture
from refine.engine import find_gradients
from refine.engine.reference import Progress
from refine.parametrization import Parameters
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
    """
    network = load_autoencoder(stage.checkpoint).requires_grad_(False).to(start.normal)
    size = (start.normal.shape[-2], start.normal.shape[-1])
    measure = find_gradients(engine)
    geometries = [photo_geometry(capture) for capture in captures]
    code = encode(network, start.svbrdf()).requires_grad_(True)
    optimizer = torch.optim.Adam([code], lr=stage.rate, betas=(stage.beta1, BETA2))

    history: list[float] = []
    best, lowest = start, float("inf")
    for iteration in range(stage.iterations + 1):
        found = Parameters.from_svbrdf(decode(network, code, size))
        here = found.detach()
        distance, gradients = measure(here, captures, geometries)
        history.append(distance)
        if distance < lowest:
            best, lowest = here, distance
        if iteration == stage.iterations:
            break
        optimizer.zero_grad(set_to_none=True)
        # Engines say how each pixel's own distance changes; the code moves the mean of all.
        torch.autograd.backward(
            [getattr(found, name) for name in MAPS], [gradients[name] / (size[0] * size[1]) for name in MAPS]
        )
        optimizer.step()
        if progress is not None:
            progress(iteration + 1, distance)
    return best, history


@torch.no_grad()
def encode(network: Autoencoder, svbrdf: SVBRDF) -> Tensor:
    """Return the latent code of a material of any size: its last pixels are repeated to a legal one."""
    height, width = svbrdf.size
    multiple = network.config.multiple
    more = (0, -width % multiple, 0, -height % multiple)
    return network.encode(functional.pad(svbrdf_to_maps(svbrdf), more, mode="replicate"))


def decode(network: Autoencoder, code: Tensor, size: tuple[int, int]) -> SVBRDF:
    """Return the material of a code, cut to height and width."""
    return maps_to_svbrdf(network.decode(code)[..., : size[0], : size[1]])
