"""Gao et al. 2019: an auto-encoder of materials, in whose latent space a photo is explained.

Nothing here is normalised, and there are no skips: what a material is must pass through the latent.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nets.baselines.conventions import FREE_CHANNELS, maps_of
from nets.baselines.unet import require_multiple
from nets.generator import LEAKY_SLOPE, maps_to_svbrdf, svbrdf_to_maps
from nets.svbrdf import CHANNELS, SVBRDF

MULTIPLES = (1, 2, 4, 8, 8)
"""Channels of each encoder level as multiples of the width: 64, 128, 256, 512, 512 in the paper."""

STEEPEST = 1.0
"""Slope at the ends of tanh: normals are (x, y, 1), normalised."""


LAST_SCALE = 0.1
"""The last layer's weights begin this much smaller, so that the first materials are plain ones."""


@dataclass(frozen=True)
class AutoencoderConfig:
    """The shape of an auto-encoder.

    Attributes:
        width: channels of the first convolution; 64 in the paper.
    """

    width: int = 64

    def __post_init__(self) -> None:
        """Refuse shapes that cannot be built."""
        if self.width < 1:
            raise ValueError(f"not an auto-encoder: {self}")

    @property
    def encoder_widths(self) -> tuple[int, ...]:
        """Output channels of each encoder level."""
        return tuple(self.width * multiple for multiple in MULTIPLES)

    @property
    def multiple(self) -> int:
        """Image sides must be multiples of this."""
        return int(2 ** len(MULTIPLES))

    def as_dict(self) -> dict[str, int]:
        """Return plain values for a checkpoint's header."""
        return asdict(self)


PAPER_AUTOENCODER = AutoencoderConfig()
NARROW_AUTOENCODER = AutoencoderConfig(width=8)
"""What is trained on two CPU cores and shipped."""


class Autoencoder(nn.Module):
    """Maps to a latent code and back."""

    def __init__(self, config: AutoencoderConfig = PAPER_AUTOENCODER) -> None:
        """Build with random weights."""
        super().__init__()
        self.config = config
        widths = config.encoder_widths
        down = [
            nn.Conv2d(inputs, outputs, 4, stride=2, padding=1)
            for inputs, outputs in pairwise((sum(CHANNELS.values()), *widths))
        ]
        up = [
            nn.ConvTranspose2d(inputs, outputs, 4, stride=2, padding=1)
            for inputs, outputs in pairwise((*widths[::-1], FREE_CHANNELS))
        ]
        # As loud after a layer as before, or nothing would get through ten of them.
        for convolutions, products in ((down, 16), (up, 4)):
            for convolution in convolutions:
                fan = (1.0 + LEAKY_SLOPE**2) * products * convolution.in_channels
                nn.init.normal_(convolution.weight, std=math.sqrt(2.0 / fan))
                nn.init.zeros_(convolution.bias)  # type: ignore[arg-type]
        with torch.no_grad():
            up[-1].weight.mul_(LAST_SCALE)
        self.encoder, self.decoder = nn.ModuleList(down), nn.ModuleList(up)

    def encode(self, maps: Float[Tensor, "b 10 h w"]) -> Float[Tensor, "b c h2 w2"]:
        """Return the latent code of maps in [-1, 1], in the order of `MAPS`: a 32nd of their size.

        Raises:
            ValueError: if a side is not a multiple of `config.multiple`, naming the shape.
        """
        require_multiple(maps, self.config.multiple)
        x = self.encoder[0](maps)
        for convolution in self.encoder[1:]:
            x = convolution(functional.leaky_relu(x, LEAKY_SLOPE))
        return x

    def decode(self, latent: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 9 h2 w2"]:
        """Return the nine free channels of the maps of a latent code, before tanh; see `maps_of`."""
        for convolution in self.decoder:
            latent = convolution(functional.leaky_relu(latent, LEAKY_SLOPE))
        return latent

    def forward(self, maps: Float[Tensor, "b 10 h w"]) -> Float[Tensor, "b 10 h w"]:
        """Encode and decode maps; errors as `encode`."""
        return maps_of(self.decode(self.encode(maps)), STEEPEST)

    @torch.no_grad()
    def reconstruct(self, svbrdf: SVBRDF) -> SVBRDF:
        """Return what is left of materials after encoding and decoding; errors as `encode`."""
        return maps_to_svbrdf(self(svbrdf_to_maps(svbrdf)))
