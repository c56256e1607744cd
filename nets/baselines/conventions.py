"""What the three systems have in common: nine channels of maps, and photos with the flash in the middle."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nets.color import to_network_input
from nets.generator import maps_to_svbrdf
from nets.render import AUTHORS_CAMERA, PointLight
from nets.svbrdf import CHANNELS, SVBRDF

FREE_CHANNELS = sum(CHANNELS.values()) - 1
"""Channels that these networks put out: of the normal only x and y."""

CENTRED_FLASH = AUTHORS_CAMERA
"""Where the flash is taken to be by networks that say nothing of it, surface units."""


def maps_of(free: Float[Tensor, "b 9 h w"], steepest: float) -> Float[Tensor, "b 10 h w"]:
    """Turn nine channels of any size into maps in [-1, 1] in the order of `MAPS`; normals are unit vectors.

    Args:
        free: x and y of the normal, diffuse, roughness, specular, all before tanh.
        steepest: slope that x and y reach at the ends of tanh; z is 1 before the normal is normalised.
    """
    bounded = torch.tanh(free)
    slopes = steepest * bounded[:, :2]
    normal = functional.normalize(torch.cat([slopes, torch.ones_like(slopes[:, :1])], dim=1), dim=1)
    return torch.cat([normal, bounded[:, 2:]], dim=1)


class PhotoNetwork(nn.Module):
    """A network from encoded photos to maps that says nothing of the light."""

    @torch.no_grad()
    def predict(self, photo: Float[Tensor, "b 3 h w"]) -> tuple[SVBRDF, PointLight]:
        """Estimate the material of linear photos (clamped to 1 here), sides as in `forward`.

        The light is `CENTRED_FLASH`, whatever the photo: Des18 and Des19 do not estimate it.
        """
        training = self.training
        self.eval()
        try:
            maps = self(to_network_input(photo))
        finally:
            self.train(training)
        position = photo.new_tensor([CENTRED_FLASH]).expand(photo.shape[0], 3)
        return maps_to_svbrdf(maps), PointLight(position, torch.ones_like(position))
