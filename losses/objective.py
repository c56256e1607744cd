"""What a network is trained on: weighted sums of the terms in this package.

Each objective is a frozen dataclass of weights and a callable `(network, batch) -> (loss, terms)`, the
interface of `nets.trainer`. Here: the L1 objective of the first shipped network.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from losses.reflectance import light_l1, map_l1, rendering_log_l1
from nets.generator import Generator, light_to_output, maps_to_svbrdf
from nets.render import Camera
from nets.sampling import LightDistribution
from nets.svbrdf import MAPS
from nets.trainer import Terms, TrainingBatch


@dataclass(frozen=True)
class L1Objective:
    """Map L1 + log-L1 of renderings under random lights + light L1; no discriminator.

    Attributes:
        map_weight: of the sum of the four map terms.
        normal_factor: of the normal term within that sum; normals carry most of the error of renderings
            under new lights, yet their own L1 is the smallest of the four and hardly felt at 1.
        rendering_weight: of the rendering term.
        light_weight: of the light term.
        rendering_lights: random lights per material.
        rendering_stride: renderings see every n-th pixel; shading is per pixel, so this is only cheaper.
        rendering_offset: of the logarithm; 0.1 has nearly the slope of the gamma-encoded image.
        lights: where the random lights come from.
    """

    map_weight: float = 1.0
    normal_factor: float = 5.0
    rendering_weight: float = 10.0
    light_weight: float = 1.0
    rendering_lights: int = 3
    rendering_stride: int = 2
    rendering_offset: float = 0.1
    lights: LightDistribution = LightDistribution(max_angle=60.0, distance_range=(1.0, 8.0))

    def __call__(
        self, network: Generator, batch: TrainingBatch, generator: torch.Generator
    ) -> tuple[Tensor, Terms]:
        """Return the loss and its parts on one batch."""
        maps, light = network(batch.network_input)
        estimate = maps_to_svbrdf(maps.float())
        terms = map_l1(estimate, batch.truth)
        count = batch.truth.batch * self.rendering_lights
        offset = int(torch.randint(self.rendering_stride, (1,), generator=generator))
        pixels = (..., slice(offset, None, self.rendering_stride), slice(offset, None, self.rendering_stride))
        terms["rendering"] = rendering_log_l1(
            estimate.map(lambda tensor: tensor[pixels]),
            batch.truth.map(lambda tensor: tensor[pixels]),
            self.lights.sample(count, generator),
            Camera(),
            self.rendering_offset,
        )
        terms["light"] = light_l1(light.float(), light_to_output(batch.light.position))
        loss = (
            self.map_weight
            * (sum(terms[name] for name in MAPS) + (self.normal_factor - 1.0) * terms["normal"])
            + self.rendering_weight * terms["rendering"]
            + self.light_weight * terms["light"]
        )
        return loss, terms
