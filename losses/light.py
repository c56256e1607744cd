"""What the light encoder is trained on, alone: direction and distance of the flash."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nets.generator import Generator
from nets.light_head import light_from_output
from nets.training import Losses, TrainingBatch


@dataclass(frozen=True)
class LightObjective:
    """Angle between true and estimated direction, and the difference of the logarithms of distances.

    Eq. 1's L1 of positions is led by far lights, which look alike; how a surface is shaded depends on the
    direction first.

    Attributes:
        distance_weight: of the distances' term; the angle, in radians, weighs 1.
    """

    distance_weight: float = 0.3

    @property
    def judged(self) -> dict[str, int]:
        """No critics."""
        return {}

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for a checkpoint's header."""
        return asdict(self)

    def __call__(
        self, network: Generator, critics: nn.ModuleDict, batch: TrainingBatch, generator: torch.Generator
    ) -> Losses:
        """Return the loss and its parts on one batch."""
        estimate = light_from_output(network.estimate_light(batch.network_input).float()).position
        terms = {
            "direction": angle_between(estimate, batch.light.position).mean(),
            "distance": log_ratio(estimate, batch.light.position).mean(),
        }
        return Losses(terms["direction"] + self.distance_weight * terms["distance"], terms)


def angle_between(a: Float[Tensor, "b 3"], b: Float[Tensor, "b 3"]) -> Float[Tensor, "b"]:
    """Return the angles between vectors, radians; gradients are finite at any angle but 0 and pi."""
    return torch.atan2(torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=1), (a * b).sum(dim=1))


def log_ratio(a: Float[Tensor, "b 3"], b: Float[Tensor, "b 3"]) -> Float[Tensor, "b"]:
    """Return how far apart the logarithms of vectors' lengths are."""
    lengths = (torch.linalg.vector_norm(vector, dim=1) for vector in (a, b))
    first, second = (length.log() for length in lengths)
    return (first - second).abs()
