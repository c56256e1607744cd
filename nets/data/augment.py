"""Vary a batch of materials: crop, turn and mirror, mix, recolour, re-roughen. Pure tensors, no files.

Normals turn and mirror with the picture, so that a turned material under a turned light is the turned photo.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as functional
from jaxtyping import Bool, Float
from torch import Tensor

from nets.data.images import ROUGHNESS_FLOOR, unit_normal
from nets.svbrdf import SVBRDF

MAXIMUM_STRIDE = 1.5
"""Source pixels per sample beyond which several samples are averaged for one output pixel."""

MASK_NODES = 6
"""Random nodes per side that a smooth mixing mask is interpolated from."""


METAL_LEVELS = (0.15, 0.95)
"""Least and greatest mean F0 of a material turned into metal."""

METAL_DIFFUSE = 0.15
"""Most of its diffuse albedo that it keeps."""

METAL_POLISH = 0.35
"""Least factor of its roughness."""

DARKEST_PATTERN = 0.02
"""Albedo and F0 of a pattern are kept above this."""


@dataclass(frozen=True)
class Augmentation:
    """How much to vary; a value of zero (or False) switches its part off.

    Attributes:
        scale: least and greatest fraction of the tile's side that is seen.
        rotate: turn at all.
        any_angle: share of materials turned by any angle; the rest turn by multiples of 90 degrees.
            Turned views that would leave the tile see a smaller part of it instead.
        flip: mirror half of the materials.
        mix_probability: share of materials mixed with another of the batch (Deschaintre et al. 2018).
        mix_range: least and greatest weight of the partner.
        smooth_masks: share of the mixed materials whose weight varies over the surface.
        hue: deviation of the rotation of diffuse colours about grey, radians.
        saturation: deviation of the logarithm of the diffuse saturation factor.
        gain: deviation of the logarithm of per-channel diffuse factors (coloured paint).
        exposure: deviation of the logarithm of the common diffuse factor.
        roughness: deviation of the logarithm of the exponent applied to roughness.
        specular: deviation of the logarithm of the factor of F0.
        specular_hue: deviation of the rotation of F0 colours about grey, radians; grey stays grey.
        relief: deviation of the logarithm of the factor of slopes.
        relief_factor: that factor's median.
        metal: share of materials turned into metal: hardly any diffuse, its pattern as F0, smoother. Few
            textures are of bare metal, and on it relief is all there is to see.
    """

    scale: tuple[float, float] = (0.55, 1.0)
    rotate: bool = True
    any_angle: float = 0.5
    flip: bool = True
    mix_probability: float = 0.3
    mix_range: tuple[float, float] = (0.1, 0.9)
    smooth_masks: float = 0.5
    hue: float = 0.35
    saturation: float = 0.25
    gain: float = 0.1
    exposure: float = 0.3
    roughness: float = 0.3
    specular: float = 0.25
    specular_hue: float = 0.1
    relief: float = 0.3
    relief_factor: float = 1.0
    metal: float = 0.0

    @staticmethod
    def none() -> Augmentation:
        """Return settings that only resize."""
        return Augmentation(
            scale=(1.0, 1.0),
            rotate=False,
            flip=False,
            mix_probability=0.0,
            hue=0.0,
            saturation=0.0,
            gain=0.0,
            exposure=0.0,
            roughness=0.0,
            specular=0.0,
            specular_hue=0.0,
            relief=0.0,
            metal=0.0,
        )


@dataclass(frozen=True)
class Pose:
    """Which part of a tile is seen, and how it is turned; one entry per material.

    Attributes:
        angle: counter-clockwise turn of the picture, radians.
        flip: mirror left and right before turning.
        scale: fraction of the tile's side seen.
        centre: of the part seen, in the tile's coordinates [-1, 1], x right, y up.
    """

    angle: Float[Tensor, "batch"]
    flip: Bool[Tensor, "batch"]
    scale: Float[Tensor, "batch"]
    centre: Float[Tensor, "batch 2"]

    def matrix(self) -> Float[Tensor, "batch 2 2"]:
        """Return the orthogonal matrix M that takes tile directions to picture directions (y up).

        Multiples of 90 degrees are exact.
        """
        quarters = self.angle / (math.pi / 2)
        is_quarter = (quarters - quarters.round()).abs() < 1e-6
        cosine, sine = torch.cos(self.angle), torch.sin(self.angle)
        cosine = torch.where(is_quarter, cosine.round(), cosine)
        sine = torch.where(is_quarter, sine.round(), sine)
        mirror = torch.where(self.flip, -1.0, 1.0).to(self.angle)
        rows = [torch.stack([cosine * mirror, -sine], dim=-1), torch.stack([sine * mirror, cosine], dim=-1)]
        return torch.stack(rows, dim=1)


def augment(
    svbrdf: SVBRDF, generator: torch.Generator, *, size: int, settings: Augmentation | None = None
) -> SVBRDF:
    """Draw and apply one variation per material.

    Args:
        svbrdf: square tiles of at least a few pixels.
        generator: source of all randomness (CPU); the same state gives the same result.
        size: side of the result in pixels.
        settings: see `Augmentation`.

    Returns:
        As many materials, `size` x `size`, legal by `SVBRDF.validate`.

    Raises:
        ValueError: the tiles are not square.
    """
    settings = settings or Augmentation()
    varied = view_tile(svbrdf, draw_pose(svbrdf.batch, generator, settings), size)
    varied = plate(jitter(varied, generator, settings), generator, settings)
    return mix(varied, generator, settings)


def draw_pose(batch: int, generator: torch.Generator, settings: Augmentation) -> Pose:
    """Draw poses whose views lie wholly inside the tile.

    Args:
        batch: number of poses.
        generator: source of randomness.
        settings: `scale`, `rotate`, `any_angle` and `flip` are used.
    """
    uniform = torch.rand(batch, 6, generator=generator)
    quarter = (uniform[:, 0] * 4).floor() * (math.pi / 2)
    angle = torch.where(uniform[:, 1] < settings.any_angle, uniform[:, 0] * (2 * math.pi), quarter)
    angle = angle * float(settings.rotate)
    flip = (uniform[:, 2] < 0.5) & settings.flip
    low, high = settings.scale
    extent = torch.cos(angle).abs() + torch.sin(angle).abs()  # of the turned view's bounding box
    scale = torch.minimum(low + (high - low) * uniform[:, 3], 1.0 / extent)
    room = (1.0 - scale * extent).clamp(min=0.0)
    return Pose(angle, flip, scale, (uniform[:, 4:] * 2.0 - 1.0) * room[:, None])


def view_tile(svbrdf: SVBRDF, pose: Pose, size: int) -> SVBRDF:
    """See a part of each tile, turned and mirrored, at another resolution; slopes stay as they are.

    One bilinear resampling; where it would skip source pixels, several samples are averaged.

    Args:
        svbrdf: square tiles.
        pose: one per material; views that leave the tile repeat its border pixels.
        size: side of the result in pixels.

    Raises:
        ValueError: the tiles are not square.
    """
    height, width = svbrdf.size
    if height != width:
        raise ValueError(f"augmentation needs square tiles, these are {width} x {height}")
    matrix = pose.matrix()
    down = torch.tensor([1.0, -1.0])  # rows run downwards: y changes sign on both sides
    inverse = pose.scale[:, None, None] * down[:, None] * matrix.transpose(1, 2) * down
    theta = torch.cat([inverse, (pose.centre * down)[:, :, None]], dim=2)

    stride = float(pose.scale.max()) * width / size
    samples = max(1, math.ceil(stride / MAXIMUM_STRIDE - 1e-6))
    grid = functional.affine_grid(
        theta, [svbrdf.batch, 1, size * samples, size * samples], align_corners=False
    )

    def look(image: Tensor) -> Tensor:
        seen = functional.grid_sample(image, grid, padding_mode="border", align_corners=False)
        return functional.avg_pool2d(seen, samples) if samples > 1 else seen

    seen = svbrdf.map(look)  # map by map: joining the channels first costs more than it saves
    plane = torch.einsum("bij,bjhw->bihw", matrix, seen.normal[:, :2])
    return SVBRDF(
        unit_normal(torch.cat([plane, seen.normal[:, 2:]], dim=1)),
        seen.diffuse.clamp(0.0, 1.0),
        seen.roughness.clamp(ROUGHNESS_FLOOR, 1.0),
        seen.specular.clamp(0.0, 1.0),
    )


def jitter(svbrdf: SVBRDF, generator: torch.Generator, settings: Augmentation) -> SVBRDF:
    """Vary relief, colours, roughness and reflectance of each material as a whole.

    Args:
        svbrdf: materials of any size.
        generator: source of randomness.
        settings: the deviations are used.
    """
    draw = torch.randn(svbrdf.batch, 10, generator=generator)
    relief = settings.relief_factor * torch.exp(draw[:, 0] * settings.relief)[:, None, None, None]
    normal = torch.cat([svbrdf.normal[:, :2] * relief, svbrdf.normal[:, 2:]], dim=1)

    gain = torch.exp(draw[:, 1:4] * settings.gain + draw[:, 4:5] * settings.exposure)
    saturation = torch.exp(draw[:, 5] * settings.saturation)
    paint = gain[:, :, None] * _hue_matrix(draw[:, 6] * settings.hue, saturation)
    factor = torch.exp(draw[:, 7] * settings.specular)[:, None, None]
    metal = factor * _hue_matrix(draw[:, 8] * settings.specular_hue, torch.ones_like(saturation))

    exponent = torch.exp(draw[:, 9] * settings.roughness)[:, None, None, None]
    return SVBRDF(
        unit_normal(normal),
        _recolour(svbrdf.diffuse, paint),
        (svbrdf.roughness**exponent).clamp(ROUGHNESS_FLOOR, 1.0),
        _recolour(svbrdf.specular, metal),
    )


def plate(svbrdf: SVBRDF, generator: torch.Generator, settings: Augmentation) -> SVBRDF:
    """Turn some materials into metal: the diffuse pattern becomes one of F0, and the surface smoother.

    Args:
        svbrdf: materials of any size.
        generator: source of randomness.
        settings: `metal` is used; at 0 no random number is drawn.
    """
    if settings.metal == 0.0:
        return svbrdf
    uniform = torch.rand(svbrdf.batch, 6, generator=generator)[:, :, None, None, None]
    chosen, level, contrast, tint, rest, polish = uniform.unbind(dim=1)
    pattern = svbrdf.diffuse.clamp(min=DARKEST_PATTERN)
    grey = pattern.mean(dim=1, keepdim=True)
    pattern = torch.lerp(grey.expand_as(pattern), pattern, tint)
    pattern = (pattern / grey.mean(dim=(2, 3), keepdim=True)) ** contrast
    low, high = METAL_LEVELS
    specular = ((low + (high - low) * level) * pattern).clamp(DARKEST_PATTERN, 1.0)
    smoother = METAL_POLISH + (1.0 - METAL_POLISH) * polish
    metal = chosen < settings.metal
    return SVBRDF(
        svbrdf.normal,
        torch.where(metal, svbrdf.diffuse * METAL_DIFFUSE * rest, svbrdf.diffuse),
        torch.where(metal, (svbrdf.roughness * smoother).clamp(min=ROUGHNESS_FLOOR), svbrdf.roughness),
        torch.where(metal, specular, svbrdf.specular),
    )


def mix(svbrdf: SVBRDF, generator: torch.Generator, settings: Augmentation) -> SVBRDF:
    """Blend some materials with another one of the batch: convex combinations of the maps.

    Args:
        svbrdf: materials of any size; a batch of one is returned as it is.
        generator: source of randomness.
        settings: `mix_probability`, `mix_range` and `smooth_masks` are used.
    """
    batch, (height, width) = svbrdf.batch, svbrdf.size
    uniform = torch.rand(batch, 4, generator=generator)
    nodes = torch.randn(batch, 1, MASK_NODES, MASK_NODES, generator=generator)
    shift = int(torch.randint(1, max(batch, 2), (), generator=generator))
    if batch == 1 or settings.mix_probability == 0.0:
        return svbrdf
    low, high = settings.mix_range
    contrast = torch.exp(uniform[:, 2] * 3.0)[:, None, None, None]  # from clouds to nearly hard edges
    clouds = functional.interpolate(nodes, (height, width), mode="bicubic", align_corners=True)
    masks = low + (high - low) * torch.sigmoid(clouds * contrast)
    constant = low + (high - low) * uniform[:, 1, None, None, None]
    weight = torch.where((uniform[:, 3] < settings.smooth_masks)[:, None, None, None], masks, constant)
    weight = weight * (uniform[:, 0] < settings.mix_probability)[:, None, None, None]

    maps = svbrdf.channels()
    blended = SVBRDF.from_channels(torch.lerp(maps, maps.roll(shift, dims=0), weight))
    return SVBRDF(unit_normal(blended.normal), blended.diffuse, blended.roughness, blended.specular)


def _hue_matrix(
    angle: Float[Tensor, "batch"], saturation: Float[Tensor, "batch"]
) -> Float[Tensor, "batch 3 3"]:
    """Return matrices that turn colours about the grey axis and scale their distance from it."""
    grey = torch.full((3, 3), 1.0 / 3.0)
    cross = torch.tensor([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]]) / math.sqrt(3.0)
    cosine, sine = torch.cos(angle)[:, None, None], torch.sin(angle)[:, None, None]
    return grey + saturation[:, None, None] * (cosine * (torch.eye(3) - grey) + sine * cross)


def _recolour(
    colour: Float[Tensor, "batch 3 h w"], matrix: Float[Tensor, "batch 3 3"]
) -> Float[Tensor, "batch 3 h w"]:
    """Apply colour matrices; a material whose brightest value would pass one is darkened as a whole."""
    turned = torch.einsum("bij,bjhw->bihw", matrix, colour).clamp(min=0.0)
    peak = turned.amax(dim=(1, 2, 3), keepdim=True).clamp(min=1.0)
    return (turned / peak).clamp(max=1.0)
