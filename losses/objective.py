"""What a network is trained on: weighted sums of the terms in this package (paper, Eq. 1 to 5).

Each objective is a frozen dataclass of weights and a callable `(network, critics, batch, generator) ->
Losses`, the interface of `nets.trainer`. Presets are in `presets.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch
from torch import Tensor, nn

from losses.reflectance import (
    encoded_difference,
    light_l1,
    log_difference,
    map_l1,
    network_maps,
    rendering_log_l1,
    rendering_pair,
    white_from_one,
)
from losses.score import Perceptual, Score, TermWeights, exposure_gain, random_window
from nets.color import gamma_encode
from nets.generator import Generator, maps_to_svbrdf
from nets.light_head import light_from_output, light_to_output
from nets.render import Camera, PointLight, render
from nets.sampling import LightDistribution
from nets.svbrdf import CHANNELS, MAPS, SVBRDF
from nets.training import Losses, TrainingBatch

TRAINING_LIGHTS = LightDistribution(max_angle=60.0, distance_range=(1.0, 8.0))
"""Lights that renderings are compared under, as those of the training photos."""


@dataclass(frozen=True)
class L1Objective:
    """Map L1 + log-L1 of renderings under random lights + light L1; no critics.

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
    lights: LightDistribution = TRAINING_LIGHTS

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
        maps, light = network(batch.network_input)
        return self.of(maps_to_svbrdf(maps.float()), light, batch, generator)

    def of(self, estimate: SVBRDF, light: Tensor, batch: TrainingBatch, generator: torch.Generator) -> Losses:
        """Return the loss of an estimated material and (standardised) light."""
        terms = map_l1(estimate, batch.truth)
        count = batch.truth.batch * self.rendering_lights
        offset = int(torch.randint(self.rendering_stride, (1,), generator=generator))
        every = slice(offset, None, self.rendering_stride)
        terms["rendering"] = rendering_log_l1(
            estimate.map(lambda tensor: tensor[..., every, every]),
            batch.truth.map(lambda tensor: tensor[..., every, every]),
            self.lights.sample(count, generator).to(batch.photo.device),
            Camera(),
            self.rendering_offset,
        )
        terms["light"] = light_l1(light.float(), light_to_output(batch.light.position))
        weight = {"rendering": self.rendering_weight, "light": self.light_weight}
        weight |= dict.fromkeys(MAPS, self.map_weight) | {"normal": self.map_weight * self.normal_factor}
        loss = torch.stack([weight[name] * term for name, term in terms.items()]).sum()
        return Losses(loss, terms)


@dataclass(frozen=True)
class SyntheticObjective:
    """Eq. 1: `E_syn = sum_i E_i + lambda_r E_ren + lambda_l E_l`; a critic per map and one for renderings.

    Attributes:
        maps: within E_i (Eq. 2).
        normal_factor: of the normals' L1 and L2; 1 in the paper.
        rendering: within E_ren (Eq. 3).
        rendering_weight: lambda_r; 0 leaves the rendering and its critic out, as the first stage does.
        light_weight: lambda_l.
        more_lights: lights per material that only the L1 distance sees, every second pixel; 0 in the paper.
        log_offset: compare logarithms of `radiance + offset` in the L1 of renderings; 0 compares encoded
            images, in [0, 1].
        lights: where the random lights come from.
        told_share: of photos whose true lights are told to the network's revision; 0 in the paper.
        window: critics and VGG see a random square of this side; 0 shows them everything.
        perceptual_samples: so many of a batch go through VGG; 0 shows it all.
        perceptual_layers: so many of its layers are compared, the shallowest; 0 compares all.
        perceptual: the VGG distance; needed if its weight is not 0.
    """

    maps: TermWeights = TermWeights()
    normal_factor: float = 1.0
    rendering: TermWeights = TermWeights(l1=50.0, perceptual=10.0)
    rendering_weight: float = 5.0
    light_weight: float = 10.0
    more_lights: int = 0
    log_offset: float = 0.0
    lights: LightDistribution = TRAINING_LIGHTS
    told_share: float = 0.0
    window: int = 0
    perceptual_samples: int = 0
    perceptual_layers: int = 0
    perceptual: Perceptual | None = field(default=None, repr=False, compare=False)

    @property
    def judged(self) -> dict[str, int]:
        """Return the critics this needs: what each judges, and its channels."""
        rendering = bool(self.rendering_weight) and self.rendering.need_critic
        return {**(CHANNELS if self.maps.need_critic else {}), **({"rendering": 3} if rendering else {})}

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for a checkpoint's header."""
        return _weights_of(self)

    def __call__(
        self, network: Generator, critics: nn.ModuleDict, batch: TrainingBatch, generator: torch.Generator
    ) -> Losses:
        """Return both players' losses and their parts on one batch."""
        condition = batch.network_input
        if self.told_share:
            maps, light = network(condition, self._told(network, condition, batch.light, generator))
        else:
            maps, light = network(condition)
        estimate = maps_to_svbrdf(maps.float())
        parts, truths = network_maps(estimate), network_maps(batch.truth)
        seen = random_window(self.window, condition, generator)
        score = Score()
        score.add("light", self.light_weight, light_l1(light.float(), light_to_output(batch.light.position)))
        for name in MAPS:
            factor = self.normal_factor if name == "normal" else 1.0
            score.measure(name, parts[name] - truths[name], self.maps, factor)
            score.judge(name, critics, seen(condition), seen(parts[name]), seen(truths[name]), self.maps)
        if self.rendering_weight:
            self._add_renderings(score, critics, estimate, batch, condition, seen, generator)
        return score.losses()

    @torch.no_grad()
    def _told(
        self, network: Generator, condition: Tensor, light: PointLight, generator: torch.Generator
    ) -> PointLight:
        """Return the true lights of some photos and the network's guesses of the others."""
        guess = light_from_output(network.estimate_light(condition).float())
        told = torch.rand(len(condition), 1, generator=generator) < self.told_share
        return PointLight(
            torch.where(told.to(condition.device), light.position, guess.position), guess.intensity
        )

    def _add_renderings(
        self,
        score: Score,
        critics: nn.ModuleDict,
        estimate: SVBRDF,
        batch: TrainingBatch,
        condition: Tensor,
        seen: Callable[[Tensor], Tensor],
        generator: torch.Generator,
    ) -> None:
        lights = self.lights.sample(batch.truth.batch, generator).to(condition.device)
        rendering, reference = rendering_pair(estimate, batch.truth, lights)
        difference = self._difference(rendering, reference)
        if self.more_lights:
            lights = self.lights.sample(batch.truth.batch * self.more_lights, generator).to(condition.device)
            sparse, truth = (m.map(lambda t: t[..., ::2, ::2]) for m in (estimate, batch.truth))
            more = self._difference(*rendering_pair(sparse, truth, lights))
            # All lights weigh alike: a picture of every second pixel has a quarter of them.
            difference = torch.cat([difference.flatten(), more.flatten().repeat(4)])
        score.measure("rendering", difference, self.rendering, self.rendering_weight)
        shown, real = gamma_encode(rendering), gamma_encode(reference)
        score.judge(
            "rendering",
            critics,
            seen(condition),
            2.0 * seen(shown) - 1.0,
            2.0 * seen(real) - 1.0,
            self.rendering,
            self.rendering_weight,
        )
        count = self.perceptual_samples or batch.truth.batch
        score.perceive(
            "rendering",
            self.perceptual,
            seen(shown)[:count],
            seen(real)[:count],
            self.rendering,
            self.rendering_weight,
        )

    def _difference(self, rendering: Tensor, reference: Tensor) -> Tensor:
        if self.log_offset:
            return log_difference(rendering, reference, self.log_offset)
        return encoded_difference(rendering, reference)


@dataclass(frozen=True)
class RealObjective:
    """Eq. 4: maps from photo a, the light from photo b, their rendering compared with b by its own critic.

    Attributes:
        rendering: weights within it; 50 for L1, no VGG.
        camera: that sees both photos; `collocated` for a flash on the camera.
        match_exposure: scale each rendering to its photo (least squares, no gradient): neither exposure nor
            falloff of a real flash is known. The paper does not mention them.
        window: see `SyntheticObjective`.
        perceptual_layers: see `SyntheticObjective`.
        perceptual: see `SyntheticObjective`.
    """

    rendering: TermWeights = TermWeights(l1=50.0)
    camera: Camera = Camera()
    match_exposure: bool = True
    window: int = 0
    perceptual_layers: int = 0
    perceptual: Perceptual | None = field(default=None, repr=False, compare=False)

    @property
    def judged(self) -> dict[str, int]:
        """Return the critic this needs, and its channels."""
        return {"real": 3} if self.rendering.need_critic else {}

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for a checkpoint's header."""
        return _weights_of(self)

    def __call__(
        self, network: Generator, critics: nn.ModuleDict, batch: TrainingBatch, generator: torch.Generator
    ) -> Losses:
        """Return both players' losses and their parts on the real pairs of a batch.

        Raises:
            ValueError: the batch has none.
        """
        if batch.pairs is None:
            raise ValueError("the batch holds no real pairs; give the training a folder of them")
        condition, reference = batch.pairs.network_input, batch.pairs.b
        maps, _ = network(condition)
        light = light_from_output(network.estimate_light(batch.pairs.network_input_b).float())
        rendering = render(maps_to_svbrdf(maps.float()), light, self.camera)
        if self.match_exposure:
            rendering = rendering * exposure_gain(rendering.detach(), reference)
        rendering, reference = white_from_one(rendering, reference)
        shown, truth = gamma_encode(rendering), gamma_encode(reference)
        seen = random_window(self.window, condition, generator)
        score = Score()
        score.measure("real", encoded_difference(rendering, reference), self.rendering)
        score.judge(
            "real", critics, seen(condition), 2 * seen(shown) - 1, 2 * seen(truth) - 1, self.rendering
        )
        score.perceive("real", self.perceptual, seen(shown), seen(truth), self.rendering)
        return score.losses()


@dataclass(frozen=True)
class HybridObjective:
    """Eq. 5: `E = E_syn + lambda E_real`.

    Attributes:
        synthetic: on known materials.
        real: on real pairs.
        real_weight: lambda.
    """

    synthetic: SyntheticObjective = SyntheticObjective()
    real: RealObjective = RealObjective()
    real_weight: float = 5.0

    @property
    def judged(self) -> dict[str, int]:
        """Return the critics of both."""
        return {**self.synthetic.judged, **self.real.judged}

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for a checkpoint's header."""
        return {
            "synthetic": self.synthetic.as_dict(),
            "real": self.real.as_dict(),
            "real_weight": self.real_weight,
        }

    def __call__(
        self, network: Generator, critics: nn.ModuleDict, batch: TrainingBatch, generator: torch.Generator
    ) -> Losses:
        """Return both players' losses and their parts on one batch of both kinds."""
        synthetic = self.synthetic(network, critics, batch, generator)
        real = self.real(network, critics, batch, generator)
        told = [part.critics for part in (synthetic, real) if part.critics is not None]
        return Losses(
            synthetic.generator + self.real_weight * real.generator,
            {**synthetic.terms, **real.terms},
            torch.stack(told).sum() if told else None,
        )


def _weights_of(objective: SyntheticObjective | RealObjective) -> dict[str, Any]:
    return asdict(replace(objective, perceptual=None)) | {"perceptual": None}
