"""The paper's discriminators: pix2pixHD's multi-scale PatchGAN (Wang et al. 2018), conditioned on the photo.

Judges patches, not pictures: one logit per overlapping patch, on an average-pooled pyramid. How logits and
features become losses (LSGAN, feature matching) is said in `losses/adversarial.py`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

LEAKY_SLOPE = 0.2
KERNEL = 4
PADDING = 2
"""pix2pixHD pads every convolution by `ceil((4 - 1) / 2)`, so maps come out one pixel larger than half."""

WIDEST_MULTIPLE = 8
"""Channels double per layer up to this multiple of the first."""

WEIGHT_DEVIATION = 0.02
"""Convolutions start normally distributed with this standard deviation."""


@dataclass(frozen=True)
class DiscriminatorConfig:
    """The shape of a discriminator.

    Attributes:
        channels: of what is judged: a map (3 or 1) or a rendering (3).
        condition_channels: of the photo it is judged with; 0 for an unconditional discriminator.
        width: channels of the first convolution; 64 in the paper.
        layers: stride-2 convolutions; 3 in the paper, for patches of 70 pixels.
        scales: levels of the pyramid, each half as fine as the one before.
    """

    channels: int = 3
    condition_channels: int = 3
    width: int = 64
    layers: int = 3
    scales: int = 2

    def __post_init__(self) -> None:
        """Refuse shapes that cannot be built."""
        if min(self.channels, self.width, self.layers, self.scales) < 1 or self.condition_channels < 0:
            raise ValueError(f"not a discriminator: {self}")

    @property
    def widths(self) -> tuple[int, ...]:
        """Output channels of every convolution: w, 2w, 4w, ..., and one logit."""
        features = (self.width * min(2**layer, WIDEST_MULTIPLE) for layer in range(self.layers + 1))
        return (*features, 1)

    @property
    def receptive_field(self) -> int:
        """Side of the patch behind one logit, in pixels of its scale."""
        field = 1
        for stride in (1, 1, *(2,) * self.layers):
            field = (field - 1) * stride + KERNEL
        return field

    @property
    def smallest_side(self) -> int:
        """Shortest image side: 2 pixels at the coarsest scale, since one alone cannot be normalised."""
        return int(2 ** (self.scales - 1)) + 1

    def as_dict(self) -> dict[str, int]:
        """Return plain numbers for a checkpoint's header."""
        return asdict(self)


@dataclass(frozen=True)
class Judgement:
    """What one scale says.

    Attributes:
        features: activations after every convolution but the last, for feature matching.
        logits: one per patch; LSGAN wants 1 for real and 0 for fake. Not squashed.
    """

    features: tuple[Float[Tensor, "b _ _ _"], ...]
    logits: Float[Tensor, "b 1 _ _"]


class PatchDiscriminator(nn.Module):
    """One scale: stride-2 convolutions, then two of stride 1; InstanceNorm but for the first and last."""

    def __init__(self, config: DiscriminatorConfig) -> None:
        """Build with random weights."""
        super().__init__()
        widths = (config.channels + config.condition_channels, *config.widths)
        self.convolutions = nn.ModuleList(
            nn.Conv2d(inputs, outputs, KERNEL, stride=2 if layer < config.layers else 1, padding=PADDING)
            for layer, (inputs, outputs) in enumerate(pairwise(widths))
        )
        self.norms = nn.ModuleList(nn.InstanceNorm2d(width) for width in config.widths[1:-1])
        for name, parameter in self.named_parameters():
            if name.endswith("weight"):
                nn.init.normal_(parameter, std=WEIGHT_DEVIATION)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Judgement:
        """Judge every patch of conditioned images."""
        features = [functional.leaky_relu(self.convolutions[0](x), LEAKY_SLOPE)]
        for convolution, norm in zip(self.convolutions[1:-1], self.norms, strict=True):
            features.append(functional.leaky_relu(norm(convolution(features[-1])), LEAKY_SLOPE))
        return Judgement(tuple(features), self.convolutions[-1](features[-1]))


class Discriminator(nn.Module):
    """The same patch discriminator, with weights of its own, at every scale of an average-pooled pyramid."""

    def __init__(self, config: DiscriminatorConfig | None = None) -> None:
        """Build with random weights; the default is the paper's for three-channel maps and renderings."""
        super().__init__()
        self.config = config or DiscriminatorConfig()
        self.scales = nn.ModuleList(PatchDiscriminator(self.config) for _ in range(self.config.scales))

    def forward(
        self, candidate: Float[Tensor, "b _ h w"], condition: Float[Tensor, "b _ h w"] | None = None
    ) -> list[Judgement]:
        """Judge maps or renderings next to the photo they are said to belong to.

        Args:
            candidate: real or generated, in the network's range [-1, 1].
            condition: the encoded photo in [-1, 1]; None if `condition_channels` is 0.

        Returns:
            One judgement per scale, finest first.

        Raises:
            ValueError: quoting the shapes, if channels, batches or sizes are not what the config says, or
                sides are shorter than `config.smallest_side`.
        """
        self._check(candidate, condition)
        x = candidate if condition is None else torch.cat([condition, candidate], dim=1)
        judgements = []
        for index, scale in enumerate(self.scales):
            if index:
                x = functional.avg_pool2d(x, 3, stride=2, padding=1, count_include_pad=False)
            judgements.append(scale(x))
        return judgements

    def _check(self, candidate: Tensor, condition: Tensor | None) -> None:
        batch, _, height, width = candidate.shape
        expected = (batch, self.config.channels, height, width)
        if tuple(candidate.shape) != expected:
            raise ValueError(f"candidate has shape {tuple(candidate.shape)}, expected {expected}")
        conditioned = (batch, self.config.condition_channels, height, width)
        found = (batch, 0, height, width) if condition is None else tuple(condition.shape)
        if found != conditioned:
            raise ValueError(f"condition has shape {found}, expected {conditioned}")
        if min(height, width) < self.config.smallest_side:
            raise ValueError(
                f"candidate has shape {expected}, its sides must be at least {self.config.smallest_side}"
            )
