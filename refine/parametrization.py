"""Unconstrained parameters of a material, so that any optimizer step is a legal material.

Normals are slopes: `n ~ (SLOPE_SCALE p, SLOPE_SCALE q, 1)`. The other maps are logits of their range.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nets.svbrdf import CHANNELS, MAPS, SVBRDF

SLOPE_SCALE = 0.25
"""Slope of one unit of a normal parameter: makes one step move normals about as visibly as albedo."""

MAX_SLOPE = 5.0
"""Slopes of an initialization are clipped here: 79 degrees."""

ALBEDO_RANGE = (0.0, 1.0)
ROUGHNESS_RANGE = (0.03, 1.0)
"""The floor is the renderer's: a smoother lobe would not be shaded any differently."""

LOGIT_MARGIN = 2e-3
"""Values closer to the ends of their range than this share of it start this far from them."""


PARAMETER_COUNTS = {**CHANNELS, "normal": 2}
"""Free numbers per pixel of each map: a unit normal has two, its slopes."""


@dataclass(frozen=True)
class Parameters:
    """Free tensors, one per map, in the order of `MAPS`; normal has two channels."""

    normal: Float[Tensor, "b 2 h w"]
    diffuse: Float[Tensor, "b 3 h w"]
    roughness: Float[Tensor, "b 1 h w"]
    specular: Float[Tensor, "b 3 h w"]

    @staticmethod
    def from_svbrdf(svbrdf: SVBRDF) -> Parameters:
        """Invert `svbrdf`, after moving values off the ends of their ranges."""
        slope = svbrdf.normal[:, :2] / svbrdf.normal[:, 2:].clamp(min=1e-3)
        return Parameters(
            slope.clamp(-MAX_SLOPE, MAX_SLOPE) / SLOPE_SCALE,
            _logit(svbrdf.diffuse, ALBEDO_RANGE),
            _logit(svbrdf.roughness, ROUGHNESS_RANGE),
            _logit(svbrdf.specular, ALBEDO_RANGE),
        )

    def svbrdf(self) -> SVBRDF:
        """Return the material these parameters mean."""
        slope = self.normal * SLOPE_SCALE
        up = torch.rsqrt(1.0 + (slope**2).sum(dim=1, keepdim=True))
        return SVBRDF(
            torch.cat([slope * up, up], dim=1),
            _from_logit(self.diffuse, ALBEDO_RANGE),
            _from_logit(self.roughness, ROUGHNESS_RANGE),
            _from_logit(self.specular, ALBEDO_RANGE),
        )

    def detach(self) -> Parameters:
        """Drop the autograd graph of all tensors."""
        return Parameters(*(getattr(self, name).detach() for name in MAPS))

    def shifted(self, offsets: dict[str, Tensor]) -> Parameters:
        """Add offsets to some maps, by name; they broadcast over pixels or not."""
        return Parameters(
            *(
                getattr(self, name) + offsets[name] if name in offsets else getattr(self, name)
                for name in MAPS
            )
        )


def _logit(value: Tensor, interval: tuple[float, float]) -> Tensor:
    low, high = interval
    return torch.logit(((value - low) / (high - low)).clamp(LOGIT_MARGIN, 1.0 - LOGIT_MARGIN))


def _from_logit(parameter: Tensor, interval: tuple[float, float]) -> Tensor:
    low, high = interval
    return low + (high - low) * torch.sigmoid(parameter)
