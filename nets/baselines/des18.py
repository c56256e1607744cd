"""Deschaintre et al. 2018: a U-Net with a global track and one decoder for all maps."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from nets.baselines.conventions import FREE_CHANNELS, PhotoNetwork, maps_of
from nets.baselines.unet import UNet, UNetConfig

STEEPEST = 3.0
"""Slopes reach this at the ends of tanh, for normals beyond 45 degrees: as the authors' later code has it."""


class Des18Config(UNetConfig):
    """The shape of a `Des18`, by default the paper's; fields as of `UNetConfig`."""


PAPER_DES18 = Des18Config()
NARROW_DES18 = Des18Config(width=16, levels=7, deep_multiplier=4)
"""What is trained on two CPU cores and shipped."""


class Des18(PhotoNetwork):
    """Photo to maps."""

    def __init__(self, config: Des18Config = PAPER_DES18) -> None:
        """Build with random weights."""
        super().__init__()
        self.config = config
        self.unet = UNet(config, 3, FREE_CHANNELS, open_end=False)

    def forward(self, photo: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 10 h w"]:
        """Map encoded photos in [-1, 1] to maps in [-1, 1], in the order of `MAPS`.

        Raises:
            ValueError: if a side is not a multiple of `config.multiple`, naming the shape.
        """
        free, _ = self.unet(photo)
        return maps_of(free, STEEPEST)
