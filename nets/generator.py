"""The paper's generator (Sec. 5.1): one encoder, four decoders with skips, and a light head.

Any width and depth; `GeneratorConfig()` is the paper's network with the layer shapes of the authors'
public checkpoint. What the network sees and says in plain numbers is fixed by `predict`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nets.color import to_network_input
from nets.light_head import LEAKY_SLOPE, LightEncoder, LightHead, light_from_output
from nets.render import Camera, PointLight
from nets.revision import REVISION_WIDTHS, Revision, feedback
from nets.shading_cues import CUES, shading_cues
from nets.svbrdf import CHANNELS, MAPS, SVBRDF

DROPOUT = 0.5
DROPOUT_LEVELS = 3
"""Dropout follows this many of the deepest decoder levels."""

DETAIL_FEATURES = 2
"""Channels beyond its map that each decoder hands to the full-resolution layers."""

MIN_NORMAL_Z = 0.02
"""Predicted normals are kept this far above the horizon before they are normalised."""

MIN_ROUGHNESS = 1e-3
"""Predicted roughness is kept above this: zero is not a legal roughness."""


@dataclass(frozen=True)
class GeneratorConfig:
    """The shape of a generator.

    Attributes:
        width: channels of the first convolution; 64 in the paper.
        levels: stride-2 convolutions of the encoder; 8 in the paper, so that 256 px shrink to 1.
        deep_multiplier: cap of the channels as a multiple of `width`; 8 in the paper.
        shading_cues: whether the network also sees `nets.shading_cues`; not in the paper.
        detail_channels: of the full-resolution layers that see decoder and input together, see `Detail`; 0
            leaves them out, as the paper does.
        light_channels: of the first convolution of a `LightEncoder`; 0 leaves it out for the paper's head on
            the bottleneck.
        revision_channels: at full resolution, of the second look that sees the maps' own re-rendering, see
            `Revision`; 0 leaves it out, as the paper does.
        revision_passes: how often it looks, with the same weights, each time at what it made of the maps.
    """

    width: int = 64
    levels: int = 8
    deep_multiplier: int = 8
    shading_cues: bool = False
    detail_channels: int = 0
    light_channels: int = 0
    revision_channels: int = 0
    revision_passes: int = 1

    def __post_init__(self) -> None:
        """Refuse shapes that cannot be built."""
        if (
            self.width < 1
            or self.deep_multiplier < 1
            or self.detail_channels < 0
            or self.light_channels < 0
            or self.revision_channels < 0
            or self.revision_passes < 1
            or (self.revision_channels and self.levels < len(REVISION_WIDTHS))
            or not 2 <= self.levels <= 10
        ):
            raise ValueError(f"not a generator: {self}")

    @property
    def encoder_widths(self) -> tuple[int, ...]:
        """Output channels of each encoder level: w, 2w, 4w, 8w, 8w, ..."""
        return tuple(self.width * min(2**level, self.deep_multiplier) for level in range(self.levels))

    @property
    def inputs(self) -> int:
        """Channels the first convolution sees."""
        return 3 + CUES if self.shading_cues else 3

    @property
    def multiple(self) -> int:
        """Image sides must be multiples of this."""
        return int(2**self.levels)

    def as_dict(self) -> dict[str, int | bool]:
        """Return plain values for a checkpoint's header."""
        return asdict(self)


PAPER_GENERATOR = GeneratorConfig()
NARROW_GENERATOR = GeneratorConfig(
    width=16,
    levels=7,
    deep_multiplier=4,
    shading_cues=True,
    detail_channels=16,
    light_channels=24,
    revision_channels=16,
    revision_passes=2,
)
"""What is trained on two CPU cores and shipped: see docs/architecture.md for what differs and why."""


class UpBlock(nn.Module):
    """Nearest x2, then two 4x4 "same" convolutions without bias, as Deschaintre et al. 2018."""

    def __init__(self, inputs: int, outputs: int) -> None:
        """Build for `inputs` and `outputs` channels."""
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 4, bias=False)
        self.conv2 = nn.Conv2d(outputs, outputs, 4, bias=False)

    def forward(self, x: Float[Tensor, "b inputs h w"]) -> Float[Tensor, "b outputs h2 w2"]:
        """Double the resolution."""
        x = upsampled_convolution(x, self.conv1.weight)
        return self.conv2(functional.pad(x, SAME_PADDING))


SAME_PADDING = (1, 2, 1, 2)
"""An even kernel has no middle: pad 1 left and top, 2 right and bottom, as TensorFlow's "same"."""


def upsampled_convolution_reference(
    x: Float[Tensor, "b inputs h w"], weight: Float[Tensor, "outputs inputs 4 4"]
) -> Float[Tensor, "b outputs h2 w2"]:
    """Upsample by nearest x2, pad, convolve: the definition, kept to test the fast path against."""
    x = functional.interpolate(x, scale_factor=2.0, mode="nearest")
    return functional.conv2d(functional.pad(x, SAME_PADDING), weight)


def upsampled_convolution(
    x: Float[Tensor, "b inputs h w"], weight: Float[Tensor, "outputs inputs 4 4"]
) -> Float[Tensor, "b outputs h2 w2"]:
    """Compute `upsampled_convolution_reference` as one transposed convolution.

    Nearest x2 is a transposed convolution with a 2x2 kernel of ones, so both steps together are one with
    the 5x5 kernel `flip(weight) * ones(2, 2)`: 25 products per input pixel instead of 64, and no
    upsampled tensor in memory. On two cores this is 2 to 5 times faster, forward and backward.
    """
    flipped = weight.flip(2, 3)
    kernel = torch.zeros(()).to(flipped)
    for left, top in ((0, 0), (0, 1), (1, 0), (1, 1)):
        kernel = kernel + functional.pad(flipped, (left, 1 - left, top, 1 - top))
    return functional.conv_transpose2d(x, kernel.transpose(0, 1), stride=2, padding=2, output_padding=1)


class Detail(nn.Module):
    """A correction of all maps at full resolution, from the decoders' last features and the network's input.

    In the paper's network the finest skip reaches the maps linearly, at half resolution and through `width`
    channels: enough for 64, not for 16, and cannot decide whether a bright pixel is paint, gloss or slope.
    """

    def __init__(self, config: GeneratorConfig) -> None:
        """Build two 3x3 convolutions; the last begins at zero, and so does the correction."""
        super().__init__()
        features = sum(CHANNELS.values()) + len(CHANNELS) * DETAIL_FEATURES
        self.conv1 = nn.Conv2d(features + config.inputs, config.detail_channels, 3, padding=1)
        self.conv2 = nn.Conv2d(config.detail_channels, sum(CHANNELS.values()), 3, padding=1)
        nn.init.zeros_(self.conv2.weight)
        nn.init.zeros_(self.conv2.bias)  # type: ignore[arg-type]

    def forward(
        self, maps: Tensor, features: Tensor, seen: Float[Tensor, "b inputs h w"]
    ) -> Float[Tensor, "b 10 h w"]:
        """Return what to add to the maps before tanh."""
        mixed = self.conv1(torch.cat([maps, features, seen], dim=1))
        correction: Tensor = self.conv2(functional.leaky_relu(mixed, LEAKY_SLOPE))
        return correction


class Decoder(nn.Module):
    """One map's decoder: `levels` up-blocks fed by the level below and the encoder's skip."""

    def __init__(self, config: GeneratorConfig, outputs: int) -> None:
        """Build for a map of `outputs` channels."""
        super().__init__()
        skips = config.encoder_widths[-2::-1]
        blocks, norms = [], []
        inputs = config.encoder_widths[-1]
        for skip in skips:
            blocks.append(UpBlock(inputs, skip))
            norms.append(nn.InstanceNorm2d(skip, affine=True))
            inputs = 2 * skip
        blocks.append(UpBlock(inputs, outputs + (DETAIL_FEATURES if config.detail_channels else 0)))
        self.blocks = nn.ModuleList(blocks)
        self.norms = nn.ModuleList(norms)
        self.dropout = nn.Dropout(DROPOUT)

    def forward(self, features: list[Tensor]) -> Float[Tensor, "b outputs h w"]:
        """Decode encoder features (finest first) to one map before tanh, and features for `Detail`."""
        x = features[-1]
        for level, norm in enumerate(self.norms):
            x = norm(self.blocks[level](functional.leaky_relu(x, LEAKY_SLOPE)))
            if level < DROPOUT_LEVELS:
                x = self.dropout(x)
            x = torch.cat([x, features[-2 - level]], dim=1)
        decoded: Tensor = self.blocks[-1](functional.leaky_relu(x, LEAKY_SLOPE))
        return decoded


class Generator(nn.Module):
    """Photo to maps and light.

    `forward` speaks the network's own range; `predict` takes a linear photo and returns a legal
    `SVBRDF` and a `PointLight`, and so does `predict_under`, which is told the light.
    """

    def __init__(self, config: GeneratorConfig = PAPER_GENERATOR) -> None:
        """Build with random weights."""
        super().__init__()
        self.config = config
        widths = config.encoder_widths
        self.encoder = nn.ModuleList(
            nn.Conv2d(inputs, outputs, 4, stride=2, padding=1, bias=False)
            for inputs, outputs in zip((config.inputs, *widths[:-1]), widths, strict=True)
        )
        # Neither the first nor the last level is normalised: they carry absolute levels.
        self.encoder_norms = nn.ModuleList(nn.InstanceNorm2d(width, affine=True) for width in widths[1:-1])
        self.decoders = nn.ModuleDict({name: Decoder(config, CHANNELS[name]) for name in MAPS})
        self.light_head = (
            LightEncoder(config.light_channels) if config.light_channels else LightHead(widths[-1])
        )
        self.detail = Detail(config) if config.detail_channels else None
        channels = config.revision_channels
        self.revision = Revision(channels, config.inputs) if channels else None

    def see(self, photo: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b inputs h w"]:
        """Return what the first convolution sees: the photo and, if so configured, its shading cues."""
        return torch.cat([photo, shading_cues(photo)], dim=1) if self.config.shading_cues else photo

    def encode(self, seen: Float[Tensor, "b inputs h w"]) -> list[Tensor]:
        """Return the features of every encoder level, finest first, before activation."""
        features = [self.encoder[0](seen)]
        for level, conv in enumerate(self.encoder[1:]):
            x = conv(functional.leaky_relu(features[-1], LEAKY_SLOPE))
            features.append(self.encoder_norms[level](x) if level < len(self.encoder_norms) else x)
        return features

    def forward(
        self,
        photo: Float[Tensor, "b 3 h w"],
        known: PointLight | None = None,
        camera: Camera | None = None,
    ) -> tuple[Float[Tensor, "b 10 h w"], Float[Tensor, "b 3"]]:
        """Map an encoded photo in [-1, 1] to maps in [-1, 1] (order of `MAPS`) and a standardised light.

        Args:
            photo: encoded; see also `nets.color.to_network_input`.
            known: the photos' lights, under which the revision renders; by default what is estimated.
            camera: of the photos, likewise; the authors' by default.

        Raises:
            ValueError: if a side is not a multiple of `config.multiple`, naming the shape.
        """
        multiple = self.config.multiple
        if photo.shape[-1] % multiple or photo.shape[-2] % multiple:
            raise ValueError(
                f"photo has shape {tuple(photo.shape)}, its sides must be multiples of {multiple}"
            )
        seen = self.see(photo)
        features = self.encode(seen)
        decoded = {name: self.decoders[name](features) for name in MAPS}
        maps = torch.cat([decoded[name][:, : CHANNELS[name]] for name in MAPS], dim=1)
        if self.detail is not None:
            more = torch.cat([decoded[name][:, CHANNELS[name] :] for name in MAPS], dim=1)
            maps = maps + self.detail(maps, more, seen)
        light = self.light_head(photo if self.config.light_channels else features[-1])
        if self.revision is not None:
            lit = known or light_from_output(light.detach().float())
            for _ in range(self.config.revision_passes):
                estimate = torch.tanh(maps.float())
                found = feedback(maps_to_svbrdf(estimate.detach()), lit, photo, camera)
                maps = maps + self.revision(seen, estimate, found)
        return torch.tanh(maps), light

    def estimate_light(self, photo: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3"]:
        """Return what `forward` says of the light, without the decoders: a fifth of the work or less."""
        alone = self.config.light_channels
        light: Tensor = self.light_head(photo if alone else self.encode(self.see(photo))[-1])
        return light

    def predict(self, photo: Float[Tensor, "b 3 h w"]) -> tuple[SVBRDF, PointLight]:
        """Estimate material and light of linear photos (clamped to 1 here), sides as in `forward`."""
        return self.predict_under(photo)

    @torch.no_grad()
    def predict_under(
        self,
        photo: Float[Tensor, "b 3 h w"],
        known: PointLight | None = None,
        camera: Camera | None = None,
    ) -> tuple[SVBRDF, PointLight]:
        """Estimate the material of linear photos whose lights may be known; the light returned is a guess.

        Args:
            photo: as `predict` takes it.
            known: one light per photo; only a network with a revision makes use of it.
            camera: of the photos, likewise.
        """
        training = self.training
        self.eval()
        try:
            maps, light = self(to_network_input(photo), known, camera)
        finally:
            self.train(training)
        return maps_to_svbrdf(maps), light_from_output(light)


def maps_to_svbrdf(maps: Float[Tensor, "b 10 h w"]) -> SVBRDF:
    """Turn network maps in [-1, 1] into a legal material: [0, 1], normals upward and unit."""
    raw = SVBRDF.from_channels(maps)
    xy, z = raw.normal[:, :2], raw.normal[:, 2:].clamp(min=MIN_NORMAL_Z)
    return SVBRDF(
        functional.normalize(torch.cat([xy, z], dim=1), dim=1),
        (raw.diffuse + 1.0) / 2.0,
        ((raw.roughness + 1.0) / 2.0).clamp(min=MIN_ROUGHNESS),
        (raw.specular + 1.0) / 2.0,
    )


def svbrdf_to_maps(svbrdf: SVBRDF) -> Float[Tensor, "b 10 h w"]:
    """Invert `maps_to_svbrdf`: the network's targets in [-1, 1]."""
    scaled = svbrdf.map(lambda tensor: tensor * 2.0 - 1.0)
    return SVBRDF(svbrdf.normal, scaled.diffuse, scaled.roughness, scaled.specular).channels()
