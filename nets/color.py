"""Transfer curves between linear light and encoded images, and nothing else.

Two curves live here. `srgb_*` is the piecewise curve of image files. `gamma_encode` is the plain
1/2.2 power the paper's network and its metrics use; the two are never mixed silently.
"""

import torch
from jaxtyping import Float
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

GAMMA = 2.2
"""Exponent of the network's and the metrics' encoding (paper Sec. 5.2: "gamma correct")."""

ENCODING_FLOOR = 1e-3
"""Radiance below this is black in `gamma_encode_from_floor`: the slope grows without bound towards 0."""

GAMMA_FLOOR = 1e-6
"""Linear value below which the 1/2.2 power is not followed: its slope is infinite at 0."""


def srgb_to_linear(image: Float[Tensor, "*batch 3 h w"]) -> Float[Tensor, "*batch 3 h w"]:
    """Decode sRGB-encoded values in [0, 1] to linear light (IEC 61966-2-1)."""
    linear: Tensor = rgb_to_linear_rgb(image)
    return linear


def linear_to_srgb(image: Float[Tensor, "*batch 3 h w"]) -> Float[Tensor, "*batch 3 h w"]:
    """Encode linear light in [0, 1] with the sRGB curve (IEC 61966-2-1). Does not clamp above 1."""
    encoded: Tensor = linear_rgb_to_rgb(image.clamp(min=0.0))
    return encoded


def gamma_encode(image: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Clamp linear light to [0, 1] and encode it with gamma 1/2.2, as networks and metrics see it."""
    return image.clamp(GAMMA_FLOOR, 1.0) ** (1.0 / GAMMA)


def gamma_decode(image: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Invert `gamma_encode` for encoded values in [0, 1]; returns linear light."""
    return image.clamp(0.0, 1.0) ** GAMMA


def to_network_input(photo: Float[Tensor, "batch 3 h w"]) -> Float[Tensor, "batch 3 h w"]:
    """Turn a linear photo into what the networks see: clamped to 1, gamma 1/2.2, scaled to [-1, 1]."""
    return gamma_encode(photo) * 2.0 - 1.0


def luminance(image: Float[Tensor, "*batch 3 h w"]) -> Float[Tensor, "*batch 1 h w"]:
    """Rec. 709 luminance of linear RGB."""
    weights = torch.tensor([0.2126, 0.7152, 0.0722], dtype=image.dtype, device=image.device)
    return (image * weights[:, None, None]).sum(dim=-3, keepdim=True)


def gamma_encode_from_floor(image: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Encode linear light with the 1/2.2 power, black below `ENCODING_FLOOR` and not clipped at 1.

    For differences that gradients flow through: the slope stays bounded, also where it is too bright.
    """
    return image.clamp(min=ENCODING_FLOOR) ** (1.0 / GAMMA)
