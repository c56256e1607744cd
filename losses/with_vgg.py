"""Give objectives their VGG: weights are files of the user's machine, objectives are plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TypeVar

from torch import Tensor

from losses.objective import HybridObjective, RealObjective, SyntheticObjective
from losses.presets import AnyObjective
from losses.score import Perceptual
from losses.vgg import CK17, VGGFeatures, perceptual_distance

T = TypeVar("T", bound=AnyObjective | RealObjective)


def needs_vgg(objective: AnyObjective | RealObjective) -> bool:
    """Return whether the objective weighs a VGG distance."""
    match objective:
        case HybridObjective():
            return needs_vgg(objective.synthetic) or needs_vgg(objective.real)
        case SyntheticObjective():
            return bool(objective.rendering_weight and objective.rendering.perceptual)
        case RealObjective():
            return bool(objective.rendering.perceptual)
        case _:
            return False


def give_vgg(objective: T, state: Mapping[str, Tensor]) -> T:
    """Return the objective with the VGG distance in place wherever it has a weight.

    Args:
        objective: any; returned as it is if it needs no VGG.
        state: weights of VGG-16, see `losses.vgg_weights`.
    """
    if not needs_vgg(objective):
        return objective
    if isinstance(objective, HybridObjective):
        return replace(
            objective,
            synthetic=give_vgg(objective.synthetic, state),
            real=give_vgg(objective.real, state),
        )
    assert isinstance(objective, SyntheticObjective | RealObjective)
    return replace(objective, perceptual=vgg_distance(state, objective.perceptual_layers))


def vgg_distance(state: Mapping[str, Tensor], layers: int = 0) -> Perceptual:
    """Return the VGG distance on the first `layers` of its layers, all if 0."""
    loss = CK17.first(layers) if layers else CK17
    features = VGGFeatures(state, loss.layers).to(next(iter(state.values())).device)
    return partial(perceptual_distance, features=features, loss=loss)
