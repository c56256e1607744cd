"""The VGG perceptual loss of the paper's Eq. 3: distances between VGG-16 features, as Chen and Koltun 2017.

Works on pictures, and knows nothing of materials or of files: the weights are not shipped, `vgg_weights.py`
finds them. Not the evaluation's distance: that is LPIPS, in `perceptual.py`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

BLOCKS = (2, 2, 3, 3, 3)
"""Convolutions of each of VGG-16's blocks (Simonyan and Zisserman 2015, configuration D)."""

CONVOLUTIONS = tuple(f"conv{block}_{n}" for block, count in enumerate(BLOCKS, 1) for n in range(1, count + 1))
"""conv1_1 to conv5_3: all 3x3, padded by 1, rectified; a 2x2 max-pooling stands between blocks."""

IMAGENET_MEAN = (0.485, 0.456, 0.406)
"""Subtracted from each channel of an image in [0, 1], as when the weights were trained."""

IMAGENET_DEVIATION = (0.229, 0.224, 0.225)
"""Divides each channel after that."""

SMALLEST_SIDE = 32
"""Images with a shorter side leave less than 2 px to the fifth block."""

RANGE_TOLERANCE = 1e-3
"""How far outside [0, 1] an image may lie before it is taken for one in another range."""


def _check_layers(layers: Sequence[str]) -> tuple[str, ...]:
    known = tuple(name for name in CONVOLUTIONS if name in layers)
    if not layers or known != tuple(layers):
        raise ValueError(f"not layers of VGG-16, shallow to deep: {tuple(layers)}; it has {CONVOLUTIONS}")
    return known


@dataclass(frozen=True)
class PerceptualLoss:
    """Which features are compared, and how much each counts.

    Attributes:
        layers: names of convolutions, shallow to deep; features are taken after their rectification.
        weights: lambda_l of Chen and Koltun's Eq. 1, one per layer, of *mean* absolute differences.
    """

    layers: tuple[str, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        """Refuse layers VGG-16 does not have, in another order, or without a weight of their own."""
        _check_layers(self.layers)
        if len(self.weights) != len(self.layers) or min(self.weights) <= 0.0:
            raise ValueError(f"{self.layers} need as many positive weights, got {self.weights}")

    def first(self, count: int) -> PerceptualLoss:
        """Return the loss on the `count` shallowest layers alone: cheaper, and blind to large structures.

        Raises:
            ValueError: if there are not as many layers, or count is 0.
        """
        if not 1 <= count <= len(self.layers):
            raise ValueError(f"there are {len(self.layers)} layers, cannot take the first {count}")
        return PerceptualLoss(self.layers[:count], self.weights[:count])


CK17 = PerceptualLoss(
    layers=("conv1_2", "conv2_2", "conv3_2", "conv4_2", "conv5_2"),
    weights=(0.13, 0.072, 0.05, 0.087, 0.2),
)
"""Chen and Koltun's layers, by name, in VGG-16 instead of VGG-19, and their rule for the weights.

Their rule: lambda_l starts at the inverse of the number of elements (so terms are means) and is then rescaled
so that every term contributes the same, the image itself included, whose lambda is 1. So lambda_l is the mean
difference of images over that of features, measured on generated materials by `measure` in
`tests/losses/test_vgg.py`. The image's own term is left out here: it is the L1 term of the paper's Eq. 3.
"""


class VGGFeatures(nn.Module):
    """VGG-16 up to the deepest layer that is asked for, frozen: gradients flow to the images only."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, state: Mapping[str, Tensor], layers: Sequence[str] = CK17.layers) -> None:
        """Build from weights; there is no random start, which would be trained on unnoticed.

        Args:
            state: `conv1_1.weight` [out, 3, 3, 3], `conv1_1.bias` [out], and so on. Widths are read off it.
            layers: names of the convolutions whose rectified output is returned, shallow to deep.

        Raises:
            ValueError: naming layers that VGG-16 does not have, or weights that are not in `state`.
        """
        super().__init__()
        self.layers = _check_layers(layers)
        self.convolutions = nn.ModuleDict()
        for name in CONVOLUTIONS[: CONVOLUTIONS.index(self.layers[-1]) + 1]:
            missing = {f"{name}.weight", f"{name}.bias"} - set(state)
            if missing:
                raise ValueError(f"weights of VGG-16 lack {', '.join(sorted(missing))}")
            outputs, inputs, *_ = state[f"{name}.weight"].shape
            convolution = nn.Conv2d(inputs, outputs, 3, padding=1)
            convolution.load_state_dict({"weight": state[f"{name}.weight"], "bias": state[f"{name}.bias"]})
            self.convolutions[name] = convolution
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN)[:, None, None], persistent=False)
        self.register_buffer("deviation", torch.tensor(IMAGENET_DEVIATION)[:, None, None], persistent=False)
        self.requires_grad_(False)
        self.eval()

    def forward(self, images: Float[Tensor, "b 3 h w"]) -> tuple[Float[Tensor, "b _ _ _"], ...]:
        """Return the rectified features of images in [0, 1], gamma-encoded, one tensor per layer."""
        x = (images - self.mean) / self.deviation
        x = x.contiguous(memory_format=torch.channels_last)
        found = []
        for name, convolution in self.convolutions.items():
            if name.endswith("_1") and name != CONVOLUTIONS[0]:
                x = functional.max_pool2d(x, 2)
            x = functional.relu(convolution(x))
            if name in self.layers:
                found.append(x)
        return tuple(found)


def perceptual_distance(
    a: Tensor,  # [batch, 3, height, width], checked below
    b: Tensor,  # [batch, 3, height, width]
    features: VGGFeatures,
    loss: PerceptualLoss = CK17,
) -> Float[Tensor, ""]:
    """Return L_vgg of Eq. 3, `sum_l lambda_l mean |phi_l(a) - phi_l(b)|` (Chen and Koltun 2017, Eq. 1).

    Args:
        a: gamma-encoded images in [0, 1], both sides at least 32 px. Gradients flow to it, and to `b`.
        b: as `a`, of the same shape; costs no memory if it needs no gradient.
        features: built for `loss.layers`.
        loss: layers and weights.

    Returns:
        The distance, mean over the batch, >= 0: 0 for equal images; with `CK17` about five times their mean
        absolute difference. float32 at least, under autocast too. NaN for NaN.

    Raises:
        ValueError: quoting shapes that differ or are too small, the range found, or layers that are not
            those of `features`.
    """
    if features.layers != loss.layers:
        raise ValueError(f"features are those of {features.layers}, the loss needs {loss.layers}")
    _check_images(a, b)
    total = torch.zeros((), dtype=torch.promote_types(a.dtype, torch.float32), device=a.device)
    # One at a time: together, autograd would keep the features of b as well, which needs none.
    for weight, phi_a, phi_b in zip(loss.weights, features(a), features(b), strict=True):
        # Under autocast features are bfloat16, in which a mean over thousands of them has two digits.
        difference = phi_a.to(total.dtype) - phi_b.to(total.dtype)
        total = total + weight * difference.abs().mean()
    return total


def _check_images(a: Tensor, b: Tensor) -> None:
    if a.shape != b.shape or a.ndim != 4 or a.shape[1] != 3:
        raise ValueError(
            f"the VGG loss compares two tensors of one shape [batch, 3, height, width], "
            f"got {tuple(a.shape)} and {tuple(b.shape)}"
        )
    if min(a.shape[-2:]) < SMALLEST_SIDE:
        raise ValueError(f"the VGG loss needs sides of at least {SMALLEST_SIDE} px, got {tuple(a.shape)}")
    for name, image in (("first", a), ("second", b)):
        low, high = (float(value) for value in torch.aminmax(image.detach()))
        # Written so that NaN passes: the trainer leaves out a step that is not finite, and goes on.
        if low < -RANGE_TOLERANCE or high > 1.0 + RANGE_TOLERANCE:
            raise ValueError(
                f"the VGG loss expects images in [0, 1], the {name} lies in [{low:.4g}, {high:.4g}]"
            )
