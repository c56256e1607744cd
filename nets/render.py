"""Lights, cameras and the Cook-Torrance model: material in, linear radiance out.

A pure function of tensors, differentiable in the maps and in the light's position and intensity.
The surface is the plane z = 0, the longer image side spans [-1, 1], x right, y up, z to the viewer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nets.svbrdf import SVBRDF

AUTHORS_CAMERA = (0.0, 0.0, 2.14)
"""Where the authors' code keeps its camera, in surface units: a field of view of 50 degrees."""


@dataclass(frozen=True)
class Conventions:
    """Every floor, epsilon and grid choice of the shading model, named.

    Attributes:
        roughness_floor: roughness below this is shaded as this: a mirror has no finite lobe.
        visibility_floor: lower bound of each Smith factor `n.x (1 - k) + k`.
        distribution_floor: lower bound of the GGX denominator `n.h^2 (a^2 - 1) + 1`.
        length_floor: lower bound of vector lengths that are divided by.
        grid: pixel `centre`s, or `corner` (first and last pixel on -1 and 1, the authors' linspace).
    """

    roughness_floor: float = 0.03
    visibility_floor: float = 1e-4
    distribution_floor: float = 1e-7
    length_floor: float = 1e-6
    grid: Literal["centre", "corner"] = "centre"


PRESETS: dict[str, Conventions] = {
    "paper": Conventions(),
    "des19": Conventions(
        roughness_floor=0.001, visibility_floor=1e-3, distribution_floor=1e-3, grid="corner"
    ),
    "gao19": Conventions(roughness_floor=0.001, visibility_floor=1e-6, distribution_floor=1e-6),
}
"""Named conventions of the systems compared with; `paper` is this library's own."""

PAPER = PRESETS["paper"]


@dataclass(frozen=True)
class PointLight:
    """One point light per material of the batch.

    Attributes:
        position: in surface units.
        intensity: radiance of a white Lambertian patch at the centre facing the light; linear RGB.
        falloff: `none` (the paper) or `inverse_square`, normalised to 1 at the patch centre.
    """

    position: Float[Tensor, "batch 3"]
    intensity: Float[Tensor, "batch 3"]
    falloff: Literal["none", "inverse_square"] = "none"

    @staticmethod
    def at(
        position: tuple[float, float, float],
        intensity: float | tuple[float, float, float] = 1.0,
        falloff: Literal["none", "inverse_square"] = "none",
        dtype: torch.dtype = torch.float32,
    ) -> PointLight:
        """Return one light from plain numbers."""
        rgb = (intensity,) * 3 if isinstance(intensity, int | float) else intensity
        return PointLight(
            torch.tensor([position], dtype=dtype), torch.tensor([rgb], dtype=dtype), falloff=falloff
        )

    def to(self, target: torch.dtype | torch.device | str) -> PointLight:
        """Cast to a dtype or move to a device."""
        return PointLight(self.position.to(target), self.intensity.to(target), self.falloff)

    def expand(self, batch: int) -> PointLight:
        """Repeat one light over a batch."""
        return PointLight(self.position.expand(batch, 3), self.intensity.expand(batch, 3), self.falloff)

    def __getitem__(self, index: slice | Tensor) -> PointLight:
        """Select along the batch."""
        return PointLight(self.position[index], self.intensity[index], self.falloff)


@dataclass(frozen=True)
class Camera:
    """Where the surface is seen from: only view directions, since photos are rectified to the surface.

    Attributes:
        kind: `orthographic` (the paper's text), `perspective` at `position` (the authors' code),
            or `collocated`: at the light, as a phone's flash.
        position: of the perspective camera, surface units.
    """

    kind: Literal["orthographic", "perspective", "collocated"] = "perspective"
    position: tuple[float, float, float] = AUTHORS_CAMERA

    def view(
        self, points: Float[Tensor, "3 h w"], light: PointLight, length_floor: float
    ) -> Float[Tensor, "#batch 3 h w"]:
        """Return unit vectors from surface points towards the camera."""
        if self.kind == "orthographic":
            return torch.stack([torch.zeros_like(points[0])] * 2 + [torch.ones_like(points[0])])[None]
        if self.kind == "collocated":
            eye = light.position
        else:
            eye = torch.tensor([self.position], dtype=points.dtype, device=points.device)
        return _normalize(eye[:, :, None, None] - points, length_floor)


def surface_points(
    height: int,
    width: int,
    *,
    grid: Literal["centre", "corner"] = "centre",
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Float[Tensor, "3 height width"]:
    """Return the surface coordinates of all pixels: x right, y up (row 0 at the top), z = 0."""
    longer = max(height, width)

    def axis(count: int) -> Tensor:
        return _coordinate(torch.arange(count, device=device), count, longer, grid, dtype)

    y, x = torch.meshgrid(-axis(height), axis(width), indexing="ij")
    return torch.stack([x, y, torch.zeros_like(x)])


def pixel_points(
    pixels: Int[Tensor, "*shape"],
    height: int,
    width: int,
    *,
    grid: Literal["centre", "corner"] = "centre",
    dtype: torch.dtype = torch.float32,
) -> Float[Tensor, "3 *shape"]:
    """Return what `surface_points` says of some pixels, numbered row by row: the same to the bit."""
    longer = max(height, width)
    row = torch.div(pixels, width, rounding_mode="floor")
    x = _coordinate(pixels - row * width, width, longer, grid, dtype)
    return torch.stack([x, -_coordinate(row, height, longer, grid, dtype), torch.zeros_like(x)])


def _coordinate(index: Tensor, count: int, longer: int, grid: str, dtype: torch.dtype) -> Tensor:
    centred = index.to(dtype) - (count - 1) / 2
    return centred * (2.0 / longer if grid == "centre" else 2.0 / max(longer - 1, 1))


@dataclass(frozen=True)
class Geometry:
    """All of shading that does not depend on the material: fixed while maps are optimised.

    Attributes:
        light_direction: unit vectors towards the light.
        view: unit vectors towards the camera.
        half_vector: unit vectors between the two.
        fresnel_weight: of the white end of Schlick's blend, `schlick_weight(v.h)`.
        irradiance: the light's intensity times its falloff, times pi.
    """

    light_direction: Float[Tensor, "batch 3 height width"]
    view: Float[Tensor, "#batch 3 height width"]
    half_vector: Float[Tensor, "batch 3 height width"]
    fresnel_weight: Float[Tensor, "batch 1 height width"]
    irradiance: Float[Tensor, "batch 3 #height #width"]


def shading_geometry(
    points: Float[Tensor, "3 height width"],
    light: PointLight,
    camera: Camera | None = None,
    conventions: Conventions = PAPER,
) -> Geometry:
    """Return directions, Fresnel weight and irradiance at surface points; camera as in `render`."""
    floor = conventions.length_floor
    to_light = light.position[:, :, None, None] - points
    light_direction = _normalize(to_light, floor)
    view = (camera or Camera()).view(points, light, floor)
    half_vector = _normalize(light_direction + view, floor)
    v_dot_h = _dot(view, half_vector).clamp(min=0.0)
    irradiance = math.pi * light.intensity[:, :, None, None]
    if light.falloff == "inverse_square":
        centre = (light.position**2).sum(dim=1)[:, None, None, None]
        irradiance = irradiance * centre / (to_light**2).sum(dim=1, keepdim=True).clamp(min=floor**2)
    return Geometry(light_direction, view, half_vector, schlick_weight(v_dot_h), irradiance)


def render(
    svbrdf: SVBRDF,
    light: PointLight,
    camera: Camera | None = None,
    conventions: Conventions = PAPER,
) -> Float[Tensor, "batch 3 height width"]:
    """Render flat materials under point lights.

    Args:
        svbrdf: maps; a batch of one is repeated over the lights.
        light: one light per material, or one for all.
        camera: defaults to the perspective camera of the authors' code.
        conventions: floors and grid; see `Conventions`.

    Returns:
        Linear radiance `pi f n.l` times the light's intensity (DESIGN.md, "Reflectance"), not clamped;
        1 is a white Lambertian patch facing a unit light.
    """
    points = surface_points(
        *svbrdf.size, grid=conventions.grid, dtype=svbrdf.normal.dtype, device=svbrdf.normal.device
    )
    return shade(svbrdf, shading_geometry(points, light, camera, conventions), conventions)


def shade(
    svbrdf: SVBRDF, geometry: Geometry, conventions: Conventions = PAPER
) -> Float[Tensor, "batch 3 height width"]:
    """Return the radiance of materials seen and lit as `geometry` says: `pi f n.l` times the light."""
    n_dot_l = _dot(svbrdf.normal, geometry.light_direction).clamp(min=0.0)
    return cook_torrance(svbrdf, geometry, conventions) * n_dot_l * geometry.irradiance


def cook_torrance(
    svbrdf: SVBRDF, geometry: Geometry, conventions: Conventions = PAPER
) -> Float[Tensor, "batch 3 height width"]:
    """Evaluate the BRDF `f = d(1-s)/pi + D G F / 4` (Deschaintre et al. 2018, Karis 2013).

    Returns:
        Reflectance in 1/steradian. G already contains the division by n.l and n.v.
    """
    n_dot_l = _dot(svbrdf.normal, geometry.light_direction).clamp(min=0.0)
    n_dot_v = _dot(svbrdf.normal, geometry.view).clamp(min=0.0)

    alpha = svbrdf.roughness.clamp(min=conventions.roughness_floor) ** 2
    k = alpha / 2.0

    # n.h^2 (a^2 - 1) + 1 loses every digit at the peak of a sharp lobe. With the chord c^2 = |n - h|^2 of
    # two unit vectors, n.h = 1 - c^2/2 and the same number is c^2 (1 - c^2/4) + n.h^2 a^2: no cancellation.
    chord_squared = ((svbrdf.normal - geometry.half_vector) ** 2).sum(dim=1, keepdim=True).clamp(max=2.0)
    n_dot_h = 1.0 - chord_squared / 2.0
    denominator = chord_squared * (1.0 - chord_squared / 4.0) + (n_dot_h * alpha) ** 2
    distribution = (alpha / denominator.clamp(min=conventions.distribution_floor)) ** 2 / math.pi

    smith_l = (n_dot_l * (1.0 - k) + k).clamp(min=conventions.visibility_floor)
    smith_v = (n_dot_v * (1.0 - k) + k).clamp(min=conventions.visibility_floor)

    fresnel = svbrdf.specular + (1.0 - svbrdf.specular) * geometry.fresnel_weight
    specular = distribution * fresnel / (4.0 * smith_l * smith_v)
    return svbrdf.diffuse * (1.0 - svbrdf.specular) / math.pi + specular


def schlick_weight(v_dot_h: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return Karis's spherical-Gaussian fit to Schlick's `(1 - v.h)^5`."""
    return torch.exp2((-5.55473 * v_dot_h - 6.98316) * v_dot_h)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(dim=1, keepdim=True)


def _normalize(vectors: Tensor, length_floor: float) -> Tensor:
    squared = (vectors**2).sum(dim=1, keepdim=True).clamp(min=length_floor**2)
    return vectors * torch.rsqrt(squared)
