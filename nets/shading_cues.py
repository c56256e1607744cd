"""What a flash photo says about slopes to first order: extra inputs that spare a small network the discovery.

A flash above the middle of the surface lights a point p = (x, y) from direction (-x, -y, h). A slope n_xy
changes its brightness by about -(x n_x + y n_y) / h of itself, so the local contrast c of the photo,
projected back along p, is the least slope that explains it: n_xy ~ -c p h / |p|^2. Where contrast is paint
and not slope is for the network to tell.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nets.render import surface_points

CUES = 4
"""Channels of `shading_cues`."""

NEIGHBOURHOOD = 1 / 8
"""Side of the square that a pixel is compared with, as a share of the photo's longer side."""

CONTRAST_FLOOR = 0.05
"""Added to the neighbourhood's encoded brightness: contrast of black is noise."""

LARGEST_CONTRAST = 2.0


def shading_cues(photo: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 4 h w"]:
    """Return x, y and the local contrast times -x and -y of photos encoded to [-1, 1].

    Args:
        photo: gamma-encoded, in [-1, 1]; the whole photo, whose longer side spans [-1, 1] of the surface.

    Returns:
        The four channels, of the photo's size; surface units, x right and y up.
    """
    height, width = photo.shape[-2:]
    points = surface_points(height, width, dtype=photo.dtype, device=photo.device)
    plane = points[:2].expand(photo.shape[0], -1, -1, -1)
    return torch.cat([plane, -local_contrast(photo) * plane], dim=1)


def local_contrast(photo: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
    """Return how much brighter each pixel is than its neighbourhood, relative to it, within +-2."""
    brightness = (photo.mean(dim=1, keepdim=True) + 1.0) / 2.0
    radius = max(1, round(NEIGHBOURHOOD * max(photo.shape[-2:]) / 2))
    mean = brightness
    for kernel, padding in (((1, 2 * radius + 1), (0, radius)), ((2 * radius + 1, 1), (radius, 0))):
        mean = functional.avg_pool2d(mean, kernel, stride=1, padding=padding, count_include_pad=False)
    return ((brightness - mean) / (mean + CONTRAST_FLOOR)).clamp(-LARGEST_CONTRAST, LARGEST_CONTRAST)
