"""The U-Net of Deschaintre et al. 2018 with its global track, which Des19 runs once for each photo.

Convolutions see their neighbourhood, and instance normalisation takes away what is the same everywhere. The
global track, fully connected layers beside the convolutions, keeps it: at every layer it is told the mean of
the features before they are normalised, and its state is added to all pixels after.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nets.generator import DROPOUT, DROPOUT_LEVELS, LEAKY_SLOPE, UpBlock

MERGE_SCALE = 0.01
"""The track's state begins to be added with weights this much smaller than the track's own."""


@dataclass(frozen=True)
class UNetConfig:
    """The shape of a U-Net.

    Attributes:
        width: channels of the first convolution; 64 in the papers.
        levels: stride-2 convolutions of the encoder; 8 in the papers, so that 256 px shrink to 1.
        deep_multiplier: cap of the channels as a multiple of `width`; 8 in the papers.
    """

    width: int = 64
    levels: int = 8
    deep_multiplier: int = 8

    def __post_init__(self) -> None:
        """Refuse shapes that cannot be built."""
        if self.width < 2 or self.deep_multiplier < 1 or not 2 <= self.levels <= 10:
            raise ValueError(f"not a U-Net: {self}")

    @property
    def encoder_widths(self) -> tuple[int, ...]:
        """Output channels of each encoder level: w, 2w, 4w, 8w, 8w, ..."""
        return tuple(self.width * min(2**level, self.deep_multiplier) for level in range(self.levels))

    @property
    def multiple(self) -> int:
        """Image sides must be multiples of this."""
        return int(2**self.levels)

    def as_dict(self) -> dict[str, int]:
        """Return plain values for a checkpoint's header."""
        return asdict(self)


class Track(nn.Module):
    """A step of the global track: its next state, from the last one and the features' means."""

    def __init__(self, inputs: int, outputs: int) -> None:
        """Build; weights start as self-normalising ones do (Klambauer et al. 2017)."""
        super().__init__()
        self.linear = nn.Linear(inputs, outputs)
        nn.init.normal_(self.linear.weight, std=inputs**-0.5)
        nn.init.zeros_(self.linear.bias)

    def forward(self, *known: Float[Tensor, "b _"]) -> Float[Tensor, "b outputs"]:
        """Return the next state."""
        return functional.selu(self.linear(torch.cat(known, dim=1)))


class TrackedLayer(nn.Module):
    """A convolution whose features hear from the global track and are told to it."""

    def __init__(
        self,
        convolution: nn.Module,
        channels: int,
        heard: int,
        told: int | None = None,
        *,
        normalised: bool = True,
    ) -> None:
        """Build.

        Args:
            convolution: or an up-block.
            channels: it puts out.
            heard: size of the track's state before.
            told: and after; None ends the track.
            normalised: whether its features are.
        """
        super().__init__()
        self.convolution = convolution
        self.norm = nn.InstanceNorm2d(channels, affine=True) if normalised else nn.Identity()
        self.merge = nn.Linear(heard, channels, bias=False)
        nn.init.normal_(self.merge.weight, std=MERGE_SCALE * heard**-0.5)
        self.track = Track(heard + channels, told) if told is not None else None

    def forward(
        self, x: Float[Tensor, "b inputs h w"], state: Float[Tensor, "b heard"]
    ) -> tuple[Float[Tensor, "b channels h2 w2"], Float[Tensor, "b told"]]:
        """Return features before activation, and the track's next state, or its last if it ends here."""
        x = self.convolution(x)
        mean = x.mean(dim=(2, 3))
        x = self.norm(x) + self.merge(state)[:, :, None, None]
        return x, state if self.track is None else self.track(state, mean)


class UNet(nn.Module):
    """Encoder, decoder with skips, and the global track through both."""

    def __init__(self, config: UNetConfig, inputs: int, outputs: int, *, open_end: bool) -> None:
        """Build with random weights.

        Args:
            config: its shape.
            inputs: channels of the image.
            outputs: channels of the features it puts out.
            open_end: whether the track's last state, of `outputs` numbers, is of use.
        """
        super().__init__()
        self.config = config
        widths = config.encoder_widths
        # The finest level hears nothing yet; its track is told the mean of the image.
        self.first = nn.Conv2d(inputs, widths[0], 4, stride=2, padding=1, bias=False)
        self.start = Track(inputs, widths[1])
        down = []
        for level in range(1, config.levels):
            convolution = nn.Conv2d(widths[level - 1], widths[level], 4, stride=2, padding=1, bias=False)
            following = widths[min(level + 1, config.levels - 1)]
            # The coarsest level is not normalised: it is a single pixel.
            kept = level == config.levels - 1
            down.append(
                TrackedLayer(convolution, widths[level], widths[level], following, normalised=not kept)
            )
        self.down = nn.ModuleList(down)
        up, x, state = [], widths[-1], widths[-1]
        for skip, following in pairwise((*widths[-2::-1], outputs)):
            up.append(TrackedLayer(UpBlock(x, skip), skip, state, following))
            x, state = 2 * skip, following
        last = outputs if open_end else None
        up.append(TrackedLayer(UpBlock(x, outputs), outputs, state, last, normalised=False))
        self.up = nn.ModuleList(up)
        self.dropout = nn.Dropout(DROPOUT)

    def forward(
        self, image: Float[Tensor, "b inputs h w"]
    ) -> tuple[Float[Tensor, "b outputs h w"], Float[Tensor, "b _"]]:
        """Return features before activation and the track's last state.

        Raises:
            ValueError: if a side is not a multiple of `config.multiple`, naming the shape.
        """
        require_multiple(image, self.config.multiple)
        state = self.start(image.mean(dim=(2, 3)))
        features = [self.first(image)]
        for layer in self.down:
            x, state = layer(functional.leaky_relu(features[-1], LEAKY_SLOPE), state)
            features.append(x)
        x = features.pop()
        for level, layer in enumerate(self.up):
            x, state = layer(functional.leaky_relu(x, LEAKY_SLOPE), state)
            if level < min(DROPOUT_LEVELS, len(self.up) - 1):
                x = self.dropout(x)
            if features:
                x = torch.cat([x, features.pop()], dim=1)
        return x, state


def require_multiple(image: Tensor, multiple: int) -> None:
    """Check that the sides of an image are multiples of a number.

    Raises:
        ValueError: they are not, naming the shape.
    """
    sides: Sequence[int] = image.shape[-2:]
    if any(side % multiple for side in sides):
        raise ValueError(
            f"the image has shape {tuple(image.shape)}, its sides must be multiples of {multiple}"
        )
