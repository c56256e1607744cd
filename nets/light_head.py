"""Where the flash was, as networks say it: the paper's light head, and a light encoder of its own.

Both answer with a standardised position; `light_from_output` and `light_to_output` translate.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nets.render import AUTHORS_CAMERA, PointLight

LEAKY_SLOPE = 0.2

LIGHT_HEAD_WIDTHS = (256, 128, 64, 32, 16, 3)

LIGHT_MEAN = (-0.0012, 0.0018, 3.0988)
LIGHT_DEVIATION = (1.6891, 1.6833, 2.7202)
"""Networks predict a standardised position: position = output x deviation + mean (surface units)."""

MIN_LIGHT_Z = 0.2
"""Predicted lights are kept this far above the surface, surface units."""

LIGHT_SIZE = 128
"""Side of the picture that `LightEncoder` looks at, pixels."""

LIGHT_ENCODER_WIDTHS = (1, 2, 4, 4, 6)
"""Channels of its convolutions, as multiples of the first's."""

LIGHT_PLACES = 4
"""Its last features are averaged over this many by this many places."""

LIGHT_ENCODER_LAYERS = (256, 128, 2)
"""Widths of the fully connected layers behind them."""

LIGHT_HEIGHT = AUTHORS_CAMERA[2]
"""Height of the flash that it takes for granted, surface units: that of the camera, where flashes are."""

LIGHT_SLOPE = 0.5
"""The light's x and y are its outputs times this and that height."""


class LightHead(nn.Module):
    """Six fully connected layers from the bottleneck to a standardised light position (paper Sec. 5.1)."""

    def __init__(self, inputs: int) -> None:
        """Build for a bottleneck of `inputs` channels."""
        super().__init__()
        widths = (inputs, *LIGHT_HEAD_WIDTHS)
        self.layers = nn.ModuleList(nn.Linear(inputs, outputs) for inputs, outputs in pairwise(widths))

    def forward(self, bottleneck: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 3"]:
        """Return the standardised position; a bottleneck larger than 1x1 is averaged first."""
        x = bottleneck.mean(dim=(2, 3))
        for layer in self.layers[:-1]:
            x = functional.leaky_relu(layer(x), LEAKY_SLOPE)
        light: Tensor = self.layers[-1](x)
        return light


class LightEncoder(nn.Module):
    """A small network of its own from the photo to a standardised light position; not in the paper.

    The bottleneck of a narrow generator is made for maps and forgets where in the photo things are. This sees
    the photo at 128 px with the coordinates of its pixels, and is trained by itself at a hundredth of a
    generator's cost. It says where the highlight is and no more: which of the lights behind one highlight it
    is, near or far, photos of unknown materials hardly tell (docs/training-log.md), so it puts the flash at
    the camera's height.
    """

    def __init__(self, channels: int) -> None:
        """Build five convolutions of stride 2, the first with `channels` channels, and three dense layers."""
        super().__init__()
        widths = (5, *(channels * factor for factor in LIGHT_ENCODER_WIDTHS))
        self.convolutions = nn.ModuleList(
            nn.Conv2d(inputs, outputs, side, stride=2, padding=side // 2)
            for (inputs, outputs), side in zip(pairwise(widths), (5, 3, 3, 3, 3), strict=True)
        )
        # Not the first: it carries absolute levels.
        self.norms = nn.ModuleList(nn.GroupNorm(1, width) for width in widths[2:])
        dense = (widths[-1] * LIGHT_PLACES**2, *LIGHT_ENCODER_LAYERS)
        self.layers = nn.ModuleList(nn.Linear(inputs, outputs) for inputs, outputs in pairwise(dense))

    def forward(self, photo: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3"]:
        """Return the standardised position of the light of an encoded photo in [-1, 1]."""
        x = functional.adaptive_avg_pool2d(photo, LIGHT_SIZE)
        along = torch.linspace(-1.0, 1.0, LIGHT_SIZE, dtype=x.dtype, device=x.device)
        across = along.expand(len(x), 1, LIGHT_SIZE, LIGHT_SIZE)
        x = torch.cat([x, across, -across.transpose(2, 3)], dim=1)
        for level, convolution in enumerate(self.convolutions):
            x = convolution(x)
            x = functional.leaky_relu(self.norms[level - 1](x) if level else x, LEAKY_SLOPE)
        x = functional.adaptive_avg_pool2d(x, LIGHT_PLACES).flatten(1)
        for layer in self.layers[:-1]:
            x = functional.leaky_relu(layer(x), LEAKY_SLOPE)
        aside = self.layers[-1](x).float() * (LIGHT_SLOPE * LIGHT_HEIGHT)
        return light_to_output(torch.cat([aside, torch.full_like(aside[:, :1], LIGHT_HEIGHT)], dim=1))


def light_from_output(output: Float[Tensor, "b 3"]) -> PointLight:
    """Turn a network's standardised output into a white unit light above the surface."""
    position = output * output.new_tensor(LIGHT_DEVIATION) + output.new_tensor(LIGHT_MEAN)
    position = torch.cat([position[:, :2], position[:, 2:].clamp(min=MIN_LIGHT_Z)], dim=1)
    return PointLight(position, torch.ones_like(position))


def light_to_output(position: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
    """Standardise a light position: the light head's target."""
    return (position - position.new_tensor(LIGHT_MEAN)) / position.new_tensor(LIGHT_DEVIATION)


def at_height(
    position: Float[Tensor, "b 3"], height: Float[Tensor, "b"], camera_height: float = AUTHORS_CAMERA[2]
) -> Float[Tensor, "b 3"]:
    """Return lights moved to other heights, with a flat mirror's highlights where they were.

    A camera at height c over the centre sees the highlight at `c / (c + z)` of the light's x and y: one
    highlight, many lights.

    Args:
        position: of the lights, surface units.
        height: the z that each is moved to.
        camera_height: the camera's z.
    """
    share = (camera_height + height) / (camera_height + position[:, 2])
    return torch.cat([position[:, :2] * share[:, None], height[:, None]], dim=1)
