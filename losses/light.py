"""What the light encoder is trained on, alone: direction and height of the flash."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nets.generator import Generator
from nets.light_head import at_height, light_from_output
from nets.training import Losses, TrainingBatch


@dataclass(frozen=True)
class LightObjective:
    """Angle between true and estimated direction at one height, and the difference of heights' logarithms.

    Eq. 1's L1 of positions is led by far lights, which look alike. What a photo shows is its highlight, so
    directions are compared once the true light is moved to the estimate's height (`at_height`).

    Attributes:
        height_weight: of the heights' term; the angle, in radians, weighs 1.
    """

    height_weight: float = 0.3

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
        height, truth = estimate[:, 2], batch.light.position
        terms = {
            "direction": angle_between(estimate, at_height(truth, height.detach())).mean(),
            "height": (height.log() - truth[:, 2].log()).abs().mean(),
        }
        return Losses(terms["direction"] + self.height_weight * terms["height"], terms)


def angle_between(a: Float[Tensor, "b 3"], b: Float[Tensor, "b 3"]) -> Float[Tensor, "b"]:
    """Return the angles between vectors, radians; gradients are finite at any angle but 0 and pi."""
    return torch.atan2(torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=1), (a * b).sum(dim=1))
