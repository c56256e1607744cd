"""The network's maps at every pixel of a larger photo: detail of the photo becomes detail of the maps.

The network sees 256 px. What the photo shows beyond them, octave by octave, is shared out among slopes,
relief, colours and roughness as the maps share out their own finest octave: locally, by least squares, from
where in the maps the detail of their re-rendering comes. So paint stays paint, and mortar stays deep.

This is the local linear model of the guided filter (He et al. 2013; at low resolution, He and Sun 2015), with
two differences: the maps are fitted to the brightness they themselves explain, not to the photo's, and only
what is new in the photo passes through the model, so that the network's maps are kept as they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from losses.reflectance import LOG_OFFSET
from nets.render import Camera, PointLight, pixel_points, render, surface_points
from nets.svbrdf import CHANNELS, MAPS, SVBRDF
from refine.bands import bands
from refine.parametrization import MAX_SLOPE, PARAMETER_COUNTS

WINDOW = 1 / 4
"""Side of the square in which one linear model holds, as a share of the longer side of the network's maps."""

STEADINESS = 1.0
"""Weight of the whole surface's model against the window's, where both show as much detail."""

LARGEST_DETAIL = 2.0
"""Natural logarithm of the largest contrast within an octave that is believed: 7.4 to 1."""

LEAST_CONTRAST = 1e-12
"""Added to variances, so that featureless maps have no detail instead of NaN."""


@dataclass(frozen=True)
class Shares:
    """What one unit of a detail's logarithmic brightness is in the maps, at each place.

    Attributes:
        slope: towards the light, in units of the tangent of the light's angle there.
        relief: height, in pixels of the detail's octave.
        diffuse: change of the albedo's logarithm.
        roughness: change of roughness.
        specular: change of the albedo's logarithm.
    """

    slope: Float[Tensor, "1 1 h w"]
    relief: Float[Tensor, "1 1 h w"]
    diffuse: Float[Tensor, "1 1 h w"]
    roughness: Float[Tensor, "1 1 h w"]
    specular: Float[Tensor, "1 1 h w"]


@dataclass(frozen=True)
class Box:
    """A part of an image, as shares of its height and width."""

    top: float = 0.0
    left: float = 0.0
    height: float = 1.0
    width: float = 1.0


WHOLE = Box()


def upsample(
    svbrdf: SVBRDF,
    seen: Float[Tensor, "1 3 side side"],
    photo: Float[Tensor, "1 3 h w"],
    place: Box,
    light: PointLight,
    camera: Camera | None = None,
) -> SVBRDF:
    """Carry maps of a square to the pixels of a larger photo.

    Args:
        svbrdf: maps of the square.
        seen: the square as the network saw it, linear radiance.
        photo: linear radiance, in smaller pixels.
        place: where the photo lies on the square.
        light: of the photo.
        camera: as in `nets.render.render`.

    Returns:
        A legal material of the photo's size.
    """
    shares = find_shares(svbrdf, light, camera)
    coarse, covered = seen, place
    for fine in octaves(photo, seen.shape[-1]):
        svbrdf = _add_octave(svbrdf, coarse, covered, fine, shares, place, light)
        coarse, covered = fine, WHOLE
    return svbrdf


def octaves(photo: Float[Tensor, "1 3 h w"], side: int) -> list[Float[Tensor, "1 3 height width"]]:
    """Return a photo in sizes that grow by equal factors of 2 or a little less, from `side` to its own."""
    height, width = photo.shape[-2:]
    count = max(1, math.ceil(math.log2(max(height, width) / side)))
    sizes = [photo]
    for step in range(count - 1, 0, -1):
        scale = (side / max(height, width)) ** (1.0 - step / count)
        size = max(1, round(height * scale)), max(1, round(width * scale))
        sizes.append(shrink(sizes[-1], size))
    return sizes[::-1]


def find_shares(svbrdf: SVBRDF, light: PointLight, camera: Camera | None = None) -> Shares:
    """Find by local least squares what the detail of the maps' own rendering is made of.

    Args:
        svbrdf: square maps, whose finest octave is the example.
        light: of the photo they explain.
        camera: as in `nets.render.render`.
    """
    brightness = _log(render(svbrdf, light, camera).clamp(max=1.0)).mean(dim=1, keepdim=True)
    detail = _detail(brightness)
    slopes = _detail(_slopes(svbrdf.normal))
    points = surface_points(*svbrdf.size, dtype=detail.dtype, device=detail.device)
    oblique = _oblique(detail, points, light)
    ascent = _ascent(functional.pad(detail, (1, 1, 1, 1), mode="replicate"))
    slope = _fit(slopes, oblique)
    return Shares(
        slope=slope,
        relief=_fit(slopes - slope * oblique, -ascent),
        diffuse=_fit(_detail(_log(svbrdf.diffuse).mean(dim=1, keepdim=True)), detail),
        roughness=_fit(_detail(svbrdf.roughness), detail),
        specular=_fit(_detail(_log(svbrdf.specular).mean(dim=1, keepdim=True)), detail),
    )


def legal(svbrdf: SVBRDF) -> SVBRDF:
    """Return the nearest legal material: normals unit length, values in range (after resampling)."""
    normal, diffuse, roughness, specular = (getattr(svbrdf, name) for name in MAPS)
    squared = (normal**2).sum(dim=1, keepdim=True).clamp(min=torch.finfo(normal.dtype).tiny)
    return SVBRDF(
        normal * torch.rsqrt(squared),
        diffuse.clamp(0.0, 1.0),
        roughness.clamp(1e-3, 1.0),
        specular.clamp(0.0, 1.0),
    )


def shrink(image: Float[Tensor, "1 c h w"], size: tuple[int, int]) -> Float[Tensor, "1 c height width"]:
    """Resize with an antialiasing triangle filter."""
    return functional.interpolate(image, size=size, mode="bilinear", align_corners=False, antialias=True)


def sample(
    image: Float[Tensor, "1 c h w"], rows: Float[Tensor, "height"], columns: Float[Tensor, "width"]
) -> Float[Tensor, "1 c height width"]:
    """Interpolate bilinearly where fractional rows and columns cross; pixel centres are whole numbers."""
    rows = rows.clamp(0.0, float(image.shape[-2] - 1))
    top = int(rows.min())
    # Columns first, of the rows that are needed: there are fewer of them than there will be.
    image = image[..., top : int(rows.max()) + 2, :]
    for axis, places in ((-1, columns), (-2, rows - top)):
        last = image.shape[axis] - 1
        places = places.clamp(0.0, float(last))
        index = places.long()
        weight = (places - index).to(image.dtype)
        low = image.index_select(axis, index)
        high = image.index_select(axis, (index + 1).clamp(max=last))
        image = torch.lerp(low, high, weight[:, None] if axis == -2 else weight)
    return image


def _add_octave(
    svbrdf: SVBRDF,
    coarse: Float[Tensor, "1 3 below left"],
    covered: Box,
    fine: Float[Tensor, "1 3 h w"],
    shares: Shares,
    place: Box,
    light: PointLight,
) -> SVBRDF:
    """Carry maps to a finer photo; `coarse` is what they know of it, `covered` the part of them it covers."""
    height, width = fine.shape[-2:]
    maps = [_slopes(svbrdf.normal), svbrdf.diffuse, svbrdf.roughness, svbrdf.specular]
    known = torch.cat([*maps, _log(coarse)], dim=1)
    models = torch.cat([getattr(shares, field.name) for field in fields(Shares)], dim=1)
    columns = torch.arange(width, device=fine.device)
    result = SVBRDF(*(fine.new_empty(1, CHANNELS[name], height, width) for name in MAPS))

    def carried(image: Tensor, box: Box, rows: Tensor) -> Tensor:
        below, left = image.shape[-2:]
        return sample(
            image,
            ((rows.double() + 0.5) / height * box.height + box.top) * below - 0.5,
            ((columns.double() + 0.5) / width * box.width + box.left) * left - 0.5,
        )

    for rows in bands(height, width):
        inside = torch.arange(rows.start, rows.stop, device=fine.device)
        # A row more above and below, for the ascent of the detail; the outermost are repeated.
        around = torch.arange(rows.start - 1, rows.stop + 1, device=fine.device).clamp(0, height - 1)
        *maps, before = carried(known, covered, around).split([*PARAMETER_COUNTS.values(), 3], dim=1)
        detail = (_log(fine[..., around, :]) - before).clamp(-LARGEST_DETAIL, LARGEST_DETAIL)
        brightness = detail.mean(dim=1, keepdim=True)
        ascent = _ascent(functional.pad(brightness, (1, 1, 0, 0), mode="replicate"))
        slopes, diffuse, roughness, specular, color, told = (
            image[..., 1:-1, :] for image in (*maps, detail - brightness, brightness)
        )
        share = Shares(*carried(models, place, inside).split(1, dim=1))
        points = pixel_points(inside[:, None] * width + columns, height, width, dtype=fine.dtype)
        slopes = slopes + share.slope * _oblique(told, points, light) - share.relief * ascent
        band = legal(
            SVBRDF(
                torch.cat([slopes, torch.ones_like(told)], dim=1),
                diffuse * torch.exp(share.diffuse * told + color),
                roughness + share.roughness * told,
                specular * torch.exp(share.specular * told),
            )
        )
        for name in MAPS:
            getattr(result, name)[..., rows, :] = getattr(band, name)
    return result


def _fit(values: Float[Tensor, "1 c h w"], detail: Float[Tensor, "1 c h w"]) -> Float[Tensor, "1 1 h w"]:
    """Return at each place the factor of `detail` that explains `values` around it best."""
    product = (values * detail).sum(dim=1, keepdim=True)
    square = (detail**2).sum(dim=1, keepdim=True) + LEAST_CONTRAST
    radius = round(WINDOW * max(detail.shape[-2:]) / 2)
    everywhere = STEADINESS * square.mean()
    overall = product.mean() / square.mean()
    return (_box_mean(product, radius) + everywhere * overall) / (_box_mean(square, radius) + everywhere)


def _box_mean(image: Float[Tensor, "1 1 h w"], radius: int) -> Float[Tensor, "1 1 h w"]:
    for kernel, padding in (((1, 2 * radius + 1), (0, radius)), ((2 * radius + 1, 1), (radius, 0))):
        image = functional.avg_pool2d(image, kernel, stride=1, padding=padding, count_include_pad=False)
    return image


def _detail(image: Float[Tensor, "1 c h w"]) -> Float[Tensor, "1 c h w"]:
    """Return the finest octave: what half the resolution does not show."""
    height, width = image.shape[-2:]
    half = shrink(image, (-(-height // 2), -(-width // 2)))
    return image - functional.interpolate(half, size=(height, width), mode="bilinear", align_corners=False)


def _ascent(image: Float[Tensor, "1 1 h2 w2"]) -> Float[Tensor, "1 2 h w"]:
    """Return differences per pixel along x (right) and y (up), of all pixels but the outermost."""
    right = (image[..., 1:-1, 2:] - image[..., 1:-1, :-2]) / 2.0
    up = (image[..., :-2, 1:-1] - image[..., 2:, 1:-1]) / 2.0
    return torch.cat([right, up], dim=1)


def _oblique(
    detail: Float[Tensor, "1 1 h w"], points: Float[Tensor, "3 h w"], light: PointLight
) -> Float[Tensor, "1 2 h w"]:
    """Return detail times the slope of the light's direction, in which slopes change brightness most."""
    position = light.position.to(detail)[:, :, None, None]
    return detail * (position[:, :2] - points[None, :2]) / position[:, 2:]


def _slopes(normal: Float[Tensor, "1 3 h w"]) -> Float[Tensor, "1 2 h w"]:
    return (normal[:, :2] / normal[:, 2:].clamp(min=1e-3)).clamp(-MAX_SLOPE, MAX_SLOPE)


def _log(image: Float[Tensor, "1 c h w"]) -> Float[Tensor, "1 c h w"]:
    return torch.log(image + LOG_OFFSET)
