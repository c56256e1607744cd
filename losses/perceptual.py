"""LPIPS v0.1, the distance of the evaluation, without torchvision: AlexNet offline, VGG-16 if it was fetched.

Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric". AlexNet and both
linear heads are shipped in `losses/weights`; `losses/fetch_weights.py` regenerates them. VGG-16 is too large
to ship: `vgg_weights.py` finds it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from losses.vgg import VGGFeatures

LPIPS_ALEX = Path(__file__).parent / "weights" / "lpips_alex.safetensors"
"""The shipped weights, fp16: `features.{0..4}.{weight,bias}` and `heads.{0..4}`."""

LPIPS_VGG_HEADS = LPIPS_ALEX.with_name("lpips_vgg_heads.safetensors")
"""The shipped linear heads of VGG-16, fp32: `heads.{0..4}`."""

ALEXNET = (
    (3, 64, 11, 4, 2),
    (64, 192, 5, 1, 2),
    (192, 384, 3, 1, 1),
    (384, 256, 3, 1, 1),
    (256, 256, 3, 1, 1),
)
"""AlexNet's five convolutions: channels in and out, kernel, stride, padding (torchvision's variant)."""

POOLED_BEFORE = (1, 2)
"""Convolutions that follow a 3x3 max-pooling of stride 2."""

VGG_LAYERS = ("conv1_2", "conv2_2", "conv3_3", "conv4_3", "conv5_3")
"""The last convolution of each of VGG-16's blocks."""

INPUT_SHIFT = (-0.030, -0.088, -0.188)
"""Subtracted from each channel of an image in [-1, 1]; ImageNet's mean as the reference rounds it."""

INPUT_SCALE = (0.458, 0.448, 0.450)
"""Divides each channel after the shift."""

NORM_EPSILON = 1e-10
"""Added to the length of a feature vector before dividing by it, as the reference does."""

SMALLEST_SIDE = {"alex": 31, "vgg": 16}
"""Images with a shorter side leave nothing after AlexNet's second pooling, or VGG-16's fourth."""

RANGE_TOLERANCE = 1e-3
"""How far outside [-1, 1] an image may lie before it is taken for one in another range."""


class PerceptualDistance(nn.Module):
    """What both networks share: weighted squared differences of unit feature vectors.

    Frozen: gradients flow to the images, none to the weights. `heads` are one weight per channel of each
    activation, all of them >= 0.
    """

    network: str
    heads: nn.ParameterList

    def forward(
        self,
        a: Tensor,  # [batch, 3, height, width], checked below
        b: Tensor,  # [batch, 3, height, width]
    ) -> Float[Tensor, "batch"]:
        """Return the distance of each pair of images.

        Args:
            a: gamma-encoded images in [-1, 1], no side shorter than `SMALLEST_SIDE`.
            b: as `a`, of the same shape.

        Returns:
            Distances, 0 for equal images, seldom above 1.

        Raises:
            ValueError: quoting the shapes that differ or are too small, or the range found.
        """
        _check(a, b, SMALLEST_SIDE[self.network])
        features = self.activations(torch.cat([a, b]))
        distance = a.new_zeros(a.shape[0])
        for activation, head in zip(features, self.heads, strict=True):
            unit_a, unit_b = _unit(activation).chunk(2)
            weighted = ((unit_a - unit_b) ** 2 * head[:, None, None]).sum(dim=1)
            distance = distance + weighted.mean(dim=(1, 2))
        return distance

    def activations(self, images: Tensor) -> tuple[Tensor, ...]:
        """Return the five rectified feature maps of images in [-1, 1]."""
        raise NotImplementedError

    def _freeze(self) -> None:
        self.requires_grad_(False)
        self.eval()


class LPIPS(PerceptualDistance):
    """LPIPS v0.1, AlexNet: the one of the tables."""

    network = "alex"
    shift: Tensor
    scale: Tensor

    def __init__(self, weights: Path = LPIPS_ALEX) -> None:
        """Load the weights.

        Args:
            weights: a file written by `losses.fetch_weights`; the shipped one by default.

        Raises:
            FileNotFoundError: if the weights are not there; names the command that makes them.
        """
        super().__init__()
        state = _read(weights, "--lpips-alex")
        self.features = nn.ModuleList(
            nn.Conv2d(inputs, outputs, kernel, stride, padding)
            for inputs, outputs, kernel, stride, padding in ALEXNET
        )
        self.heads = nn.ParameterList(nn.Parameter(torch.empty(layer[1])) for layer in ALEXNET)
        self.register_buffer("shift", torch.tensor(INPUT_SHIFT)[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor(INPUT_SCALE)[:, None, None], persistent=False)
        self.load_state_dict(state)
        self._freeze()

    def activations(self, images: Tensor) -> tuple[Tensor, ...]:
        """Return the five rectified feature maps of images in [-1, 1]."""
        # A quarter faster on a CPU than the default layout.
        x = ((images - self.shift) / self.scale).contiguous(memory_format=torch.channels_last)
        activations = []
        for index, convolution in enumerate(self.features):
            if index in POOLED_BEFORE:
                x = functional.max_pool2d(x, 3, stride=2)
            x = functional.relu(convolution(x))
            activations.append(x)
        return tuple(activations)


class LPIPSVGG(PerceptualDistance):
    """LPIPS v0.1, VGG-16: what some papers report instead; some twenty times as slow as AlexNet's."""

    network = "vgg"

    def __init__(self, state: Mapping[str, Tensor], heads: Path = LPIPS_VGG_HEADS) -> None:
        """Build from VGG-16's weights, as `losses.vgg_weights.load_vgg16` finds them.

        Args:
            state: VGG-16's convolutions.
            heads: a file written by `losses.fetch_weights`; the shipped one by default.

        Raises:
            FileNotFoundError: if the heads are not there; names the command that makes them.
            ValueError: naming weights that are not in `state`.
        """
        super().__init__()
        linear = _read(heads, "--lpips-vgg-heads")
        self.features = VGGFeatures(state, VGG_LAYERS)
        self.heads = nn.ParameterList(nn.Parameter(linear[f"heads.{i}"]) for i in range(len(VGG_LAYERS)))
        self._freeze()

    def activations(self, images: Tensor) -> tuple[Tensor, ...]:
        """Return the five rectified feature maps of images in [-1, 1]."""
        # LPIPS's shift and scale of [-1, 1] are ImageNet's mean and deviation of [0, 1].
        found: tuple[Tensor, ...] = self.features((images + 1.0) / 2.0)
        return found


def _read(weights: Path, option: str) -> dict[str, Tensor]:
    if not weights.is_file():
        raise FileNotFoundError(
            f"{weights} is missing; run `python -m losses.fetch_weights {option}` to make it"
        )
    return {name: tensor.float() for name, tensor in load_file(weights).items()}


def _unit(features: Tensor) -> Tensor:
    # vector_norm, unlike sqrt of a sum, has a zero (not NaN) gradient where all features are zero.
    return features / (torch.linalg.vector_norm(features, dim=1, keepdim=True) + NORM_EPSILON)


def _check(a: Tensor, b: Tensor, smallest: int) -> None:
    if a.shape != b.shape or a.ndim != 4 or a.shape[1] != 3:
        raise ValueError(
            f"LPIPS compares two tensors of one shape [batch, 3, height, width], "
            f"got {tuple(a.shape)} and {tuple(b.shape)}"
        )
    if min(a.shape[-2:]) < smallest:
        raise ValueError(f"LPIPS needs sides of at least {smallest} px, got {tuple(a.shape)}")
    for name, image in (("first", a), ("second", b)):
        low, high = (float(value) for value in torch.aminmax(image.detach()))
        # Written so that NaN fails too.
        if not (low >= -1.0 - RANGE_TOLERANCE and high <= 1.0 + RANGE_TOLERANCE):
            raise ValueError(f"LPIPS expects images in [-1, 1], the {name} lies in [{low:.4g}, {high:.4g}]")
