"""Deschaintre et al. 2019: a U-Net for each photo, the strongest of their features, a few last convolutions.

Taking the maximum over photos makes the answer the same in whatever order they come, and lets there be any
number of them. Here it is trained on one.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nets.baselines.conventions import FREE_CHANNELS, PhotoNetwork, maps_of
from nets.baselines.des18 import STEEPEST
from nets.baselines.unet import TrackedLayer, UNet, UNetConfig
from nets.light_head import LEAKY_SLOPE
from nets.render import surface_points


class Des19Config(UNetConfig):
    """The shape of a `Des19`, by default the paper's; fields as of `UNetConfig`."""


PAPER_DES19 = Des19Config()
NARROW_DES19 = Des19Config(width=16, levels=7, deep_multiplier=4)
"""What is trained on two CPU cores and shipped."""


class Des19(PhotoNetwork):
    """Photos to maps."""

    def __init__(self, config: Des19Config = PAPER_DES19) -> None:
        """Build with random weights."""
        super().__init__()
        self.config = config
        wide, narrow = config.width, config.width // 2
        self.unet = UNet(config, 5, wide, open_end=True)
        self.fused = nn.ModuleList(
            [
                TrackedLayer(nn.Conv2d(wide, wide, 3, padding=1, bias=False), wide, wide, narrow),
                TrackedLayer(nn.Conv2d(wide, narrow, 3, padding=1, bias=False), narrow, narrow),
            ]
        )
        self.last = nn.Conv2d(narrow, FREE_CHANNELS, 3, padding=1)

    def forward(self, photo: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 10 h w"]:
        """Map encoded photos in [-1, 1], one of each surface, to maps in [-1, 1]; errors as `fuse`."""
        return self.fuse(photo[:, None])

    def fuse(self, photos: Float[Tensor, "b n 3 h w"]) -> Float[Tensor, "b 10 h w"]:
        """Map several encoded photos of each surface, pixel on pixel, to its maps in the order of `MAPS`.

        Raises:
            ValueError: if a side is not a multiple of `config.multiple`, naming the shape.
        """
        surfaces, count, _, height, width = photos.shape
        flat = photos.flatten(0, 1)
        plane = surface_points(height, width, dtype=flat.dtype, device=flat.device)[:2]
        features, state = self.unet(torch.cat([flat, plane.expand(len(flat), -1, -1, -1)], dim=1))
        x = features.unflatten(0, (surfaces, count)).amax(dim=1)
        state = state.unflatten(0, (surfaces, count)).amax(dim=1)
        for layer in self.fused:
            x, state = layer(x, state)
            x = functional.leaky_relu(x, LEAKY_SLOPE)
        return maps_of(self.last(x), STEEPEST)
