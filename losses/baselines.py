"""What the systems compared with are trained on: Des18, Des19, and Gao19's auto-encoder. No critics."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from losses.configurations import DES18_PAIRS, LightViewPairs
from losses.reflectance import log_l1, map_l1
from nets.generator import maps_to_svbrdf, svbrdf_to_maps
from nets.render import Geometry, shade
from nets.svbrdf import SVBRDF
from nets.training import Losses, Terms, TrainingBatch


@dataclass(frozen=True)
class RenderingObjective:
    """Log-L1 of renderings, and of maps: Des18 (Sec. 4) and Des19 (Sec. 4), networks of photos.

    Attributes:
        rendering_weight: of the rendering term.
        map_weight: of the sum of the four map terms.
        offset: of the logarithm of radiance.
        pairs: of light and view that materials are rendered under.
        stride: renderings see every n-th pixel either way; shading is per pixel, so this is only cheaper.
    """

    rendering_weight: float = 1.0
    map_weight: float = 0.0
    offset: float = 0.1
    pairs: LightViewPairs = DES18_PAIRS
    stride: int = 4

    @property
    def judged(self) -> dict[str, int]:
        """No critics."""
        return {}

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for a checkpoint's header."""
        return asdict(self)

    def estimate(self, network: nn.Module, batch: TrainingBatch) -> SVBRDF:
        """Return what the network makes of the photos."""
        return maps_to_svbrdf(network(batch.network_input).float())

    def map_terms(self, estimate: SVBRDF, truth: SVBRDF) -> Terms:
        """Return each map's distance; albedos by their logarithm."""
        logarithmic = {name: log_l1(getattr(estimate, name), getattr(truth, name)) for name in ALBEDOS}
        return map_l1(estimate, truth) | logarithmic

    def __call__(
        self, network: nn.Module, critics: nn.ModuleDict, batch: TrainingBatch, generator: torch.Generator
    ) -> Losses:
        """Return the loss and its parts on one batch."""
        estimate = self.estimate(network, batch)
        terms = {"rendering": self._rendering_term(estimate, batch.truth, generator)}
        loss = self.rendering_weight * terms["rendering"]
        if self.map_weight:
            maps = self.map_terms(estimate, batch.truth)
            loss = loss + self.map_weight * torch.stack(list(maps.values())).sum()
            terms |= maps
        return Losses(loss, terms)

    def _rendering_term(
        self, estimate: SVBRDF, truth: SVBRDF, generator: torch.Generator
    ) -> Float[Tensor, ""]:
        top, left = torch.randint(self.stride, (2,), generator=generator).tolist()
        window = (..., slice(top, None, self.stride), slice(left, None, self.stride))
        few, known = (
            svbrdf.map(lambda tensor: tensor[window].repeat(self.pairs.count, 1, 1, 1))
            for svbrdf in (estimate, truth)
        )
        geometry = self.pairs.sample(truth.batch, few.size, generator)
        device = few.normal.device
        geometry = Geometry(*(getattr(geometry, field.name).to(device) for field in fields(Geometry)))
        with torch.no_grad():
            reference = shade(known, geometry)
        return log_l1(shade(few, geometry), reference, self.offset)


@dataclass(frozen=True)
class AutoencoderObjective(RenderingObjective):
    """L1 of maps, log-L1 of renderings: Gao19's auto-encoder (Sec. 4), which sees the maps themselves."""

    map_weight: float = 1.0
    offset: float = 0.01

    def estimate(self, network: nn.Module, batch: TrainingBatch) -> SVBRDF:
        """Return what the network makes of the materials."""
        return maps_to_svbrdf(network(svbrdf_to_maps(batch.truth)).float())

    def map_terms(self, estimate: SVBRDF, truth: SVBRDF) -> Terms:
        """Return each map's distance."""
        return map_l1(estimate, truth)


ALBEDOS = ("diffuse", "specular")

DES18 = RenderingObjective()
"""Renderings alone."""

DES19 = RenderingObjective(map_weight=0.1)
"""Renderings, and a tenth of the maps, as their authors' code has it."""

GAO19 = AutoencoderObjective()
"""Maps and renderings alike."""
