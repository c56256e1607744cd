"""Simulated flash photos of known materials: the network's training inputs (paper Sec. 5.2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nets.color import gamma_decode, gamma_encode
from nets.render import Camera, PointLight, render
from nets.sampling import LightDistribution
from nets.svbrdf import SVBRDF


@dataclass(frozen=True)
class FlashPhotography:
    """How training photos are taken.

    Attributes:
        centred_share: share of photos with the flash near the middle, as people hold it.
        centred_offset: standard deviation of that flash's x and y, surface units.
        centred_distance: its height is drawn log-uniformly from this range, surface units.
        lights: the paper's distribution for the rest.
        exposure_share: share of photos whose exposure and white balance are off.
        exposure_deviation: standard deviation of the logarithm of the exposure.
        balance_deviation: the same for each colour channel.
        falloff_share: share of photos whose flash falls off with the inverse square.
        noise_range: standard deviation of sensor noise on the encoded image, drawn uniformly.
        camera: sees the surface.
    """

    centred_share: float = 0.6
    centred_offset: float = 0.25
    centred_distance: tuple[float, float] = (1.2, 4.0)
    lights: LightDistribution = LightDistribution(max_angle=60.0, distance_range=(1.0, 8.0))
    exposure_share: float = 0.3
    exposure_deviation: float = 0.15
    balance_deviation: float = 0.05
    falloff_share: float = 0.3
    noise_range: tuple[float, float] = (0.0, 0.01)
    camera: Camera = Camera()

    def sample_lights(self, count: int, generator: torch.Generator) -> PointLight:
        """Draw the flash positions of `count` photos."""
        light = self.lights.sample(count, generator)
        x, y = torch.randn(2, count, generator=generator) * self.centred_offset
        low, high = torch.tensor(self.centred_distance).log()
        z = torch.exp(low + (high - low) * torch.rand(count, generator=generator))
        centred = torch.rand(count, 1, generator=generator) < self.centred_share
        position = torch.where(centred, torch.stack([x, y, z], dim=1), light.position)
        return PointLight(position, light.intensity)

    def take(self, svbrdf: SVBRDF, generator: torch.Generator) -> tuple[Float[Tensor, "b 3 h w"], PointLight]:
        """Photograph each material once.

        Returns:
            Linear photos, clipped at 1 and quantised to 8 bits as a file would be, and the lights that
            lit them (unit intensity: exposure is part of the photo's error, not of the light).
        """
        count = svbrdf.batch
        light = self.sample_lights(count, generator)
        photo = render(svbrdf, light, self.camera)
        falls = torch.rand(count, 1, 1, 1, generator=generator) < self.falloff_share
        if bool(falls.any()):
            falling = PointLight(light.position, light.intensity, falloff="inverse_square")
            photo = torch.where(falls, render(svbrdf, falling, self.camera), photo)
        off = torch.rand(count, 1, 1, 1, generator=generator) < self.exposure_share
        deviation = self.exposure_deviation * torch.randn(count, 1, 1, 1, generator=generator)
        deviation = deviation + self.balance_deviation * torch.randn(count, 3, 1, 1, generator=generator)
        encoded = gamma_encode(photo * torch.exp(off * deviation))
        low, high = self.noise_range
        sigma = low + (high - low) * torch.rand(count, 1, 1, 1, generator=generator)
        encoded = encoded + sigma * torch.randn(encoded.shape, generator=generator)
        return gamma_decode((encoded.clamp(0.0, 1.0) * 255.0).round() / 255.0), light
