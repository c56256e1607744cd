"""What our material is in the shading models of others: pure functions of maps, no files.

Ours is `d (1 - s) / pi` below a lobe of reflectance s at normal incidence (docs/conventions.md, C11 to C14).
Every other model here has a GGX lobe with alpha = roughness^2, too; they differ in what lies below it:

- *per colour* (UsdPreviewSurface): base (1 - F), colour by colour. Its base colour is our d.
- *under a layer* (glTF, Cycles, MaterialX): base (1 - the largest colour of F): `layered_base_color`.
- *metallic* (Unreal, Unity): base (1 - m) and F0 = 0.04 (1 - m) + base m: `metallic_roughness`. It cannot say
  every material; `loss` tells how far it is off.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nets.color import gamma_encode
from nets.render import AUTHORS_CAMERA, PointLight
from nets.svbrdf import SVBRDF
from refine.bands import render_in_bands

DIELECTRIC_F0 = 0.04
"""Reflectance at normal incidence of what is not metallic: an index of refraction of 1.5."""

LARGEST_F0 = 0.98
"""Reflectance up to which an index of refraction is given (199); a mirror's would be infinite."""

SMALLEST_TRANSMISSION = 1e-3
"""Lower bound of what a layer lets through, where it is divided by."""


def diffuse_reflectance(svbrdf: SVBRDF) -> Float[Tensor, "batch 3 height width"]:
    """Return `d (1 - s)`: how much light leaves the surface diffusely; linear, in [0, 1]."""
    return svbrdf.diffuse * (1.0 - svbrdf.specular)


def layered_base_color(svbrdf: SVBRDF) -> Float[Tensor, "batch 3 height width"]:
    """Return the base colour b whose `b (1 - max s)` is our diffuse reflectance; linear, clipped at 1.

    For a grey s this is d. It is clipped only where a bright diffuse lies below a strongly coloured lobe.
    """
    strongest = svbrdf.specular.amax(dim=1, keepdim=True)
    return (diffuse_reflectance(svbrdf) / (1.0 - strongest).clamp(min=SMALLEST_TRANSMISSION)).clamp(0.0, 1.0)


def from_layered(svbrdf: SVBRDF, base_color: Float[Tensor, "batch 3 height width"]) -> SVBRDF:
    """Return the material a layered model shows for a base colour: `svbrdf` with another diffuse."""
    strongest = svbrdf.specular.amax(dim=1, keepdim=True)
    return _with_reflectance(svbrdf, base_color * (1.0 - strongest), svbrdf.specular)


def ior_of_f0(f0: float) -> float:
    """Return the index of refraction whose reflectance at normal incidence is `f0`, in [0, 1)."""
    root = f0**0.5
    return (1.0 + root) / (1.0 - root)


def f0_of_ior(ior: float) -> float:
    """Return the reflectance at normal incidence of an index of refraction: `((n - 1) / (n + 1))^2`."""
    return ((ior - 1.0) / (ior + 1.0)) ** 2


@dataclass(frozen=True)
class SpecularSplit:
    """F0 as models with an index of refraction want it: `s = peak level tint`.

    Attributes:
        peak: the largest F0 of the material, from `DIELECTRIC_F0` to `LARGEST_F0`.
        level: the largest colour of s, as a share of the peak; linear, in [0, 1].
        tint: s without its brightness; linear, its largest colour 1.
    """

    peak: float
    level: Float[Tensor, "batch 1 height width"]
    tint: Float[Tensor, "batch 3 height width"]

    @property
    def ior(self) -> float:
        """Index of refraction of the peak."""
        return ior_of_f0(self.peak)


def split_specular(specular: Float[Tensor, "batch 3 height width"]) -> SpecularSplit:
    """Split F0 into an index of refraction, a level and a tint."""
    strongest = specular.amax(dim=1, keepdim=True)
    peak = min(max(float(strongest.max()), DIELECTRIC_F0), LARGEST_F0)
    tint = torch.where(strongest > 0.0, specular / strongest.clamp(min=1e-12), 1.0)
    return SpecularSplit(peak, (strongest / peak).clamp(max=1.0), tint)


@dataclass(frozen=True)
class MetallicRoughness:
    """A material of the metallic workflow.

    Attributes:
        base_color: diffuse of what is not metallic, F0 of what is; linear, in [0, 1].
        metallic: share of metal, in [0, 1].
    """

    base_color: Float[Tensor, "batch 3 height width"]
    metallic: Float[Tensor, "batch 1 height width"]

    def shown(self, svbrdf: SVBRDF) -> SVBRDF:
        """Return what is shown for it, as a material of ours; normal and roughness are those of `svbrdf`."""
        diffuse = self.base_color * (1.0 - self.metallic)
        return _with_reflectance(
            svbrdf, diffuse, DIELECTRIC_F0 * (1.0 - self.metallic) + self.base_color * self.metallic
        )


def metallic_roughness(svbrdf: SVBRDF) -> MetallicRoughness:
    """Convert to the metallic workflow, as well as that goes.

    The share of metal m solves `s = 0.04 (1 - m) + D m / (1 - m)` for the brightness of the diffuse
    reflectance D and the largest colour of s; it is quadratic, as in Khronos's conversion between workflows
    (KHR_materials_pbrSpecularGlossiness, examples/convert-between-workflows).
    Then `b (1 - m) = D` and `b m = s - 0.04 (1 - m)` are six equations for three colours: least squares.
    """
    diffuse, f0 = diffuse_reflectance(svbrdf), svbrdf.specular
    brightness, strongest = (value.amax(dim=1, keepdim=True) for value in (diffuse, f0))
    linear = brightness + strongest - 2.0 * DIELECTRIC_F0
    discriminant = linear**2 + 4.0 * DIELECTRIC_F0 * (strongest - DIELECTRIC_F0)
    metallic = (discriminant.clamp(min=0.0).sqrt() - linear) / (2.0 * DIELECTRIC_F0)
    metallic = torch.where(strongest <= DIELECTRIC_F0, 0.0, metallic).clamp(0.0, 1.0)
    rest = 1.0 - metallic
    base = (rest * diffuse + metallic * (f0 - DIELECTRIC_F0 * rest)) / (rest**2 + metallic**2)
    return MetallicRoughness(base.clamp(0.0, 1.0), metallic)


def loss(svbrdf: SVBRDF, shown: SVBRDF) -> dict[str, float]:
    """Return how far what a target shows is from the material, as root mean squares to six decimals.

    `diffuse` compares d (1 - s), `specular` F0, both linear; `rendering` compares gamma-encoded renderings
    (1/2.2) under a light at the default camera.
    """
    light = PointLight.at(AUTHORS_CAMERA).to(svbrdf.normal.dtype)
    seen = (gamma_encode(render_in_bands(each, light)) for each in (svbrdf, shown))
    pairs = {
        "diffuse": (diffuse_reflectance(svbrdf), diffuse_reflectance(shown)),
        "specular": (svbrdf.specular, shown.specular),
        "rendering": tuple(seen),
    }
    return {name: round(float((a - b).square().mean().sqrt()), 6) for name, (a, b) in pairs.items()}


def _with_reflectance(
    svbrdf: SVBRDF,
    diffuse: Float[Tensor, "batch 3 height width"],
    specular: Float[Tensor, "batch 3 height width"],
) -> SVBRDF:
    """Return the material of ours with that diffuse reflectance d (1 - s) and that F0."""
    albedo = (diffuse / (1.0 - specular).clamp(min=SMALLEST_TRANSMISSION)).clamp(max=1.0)
    return SVBRDF(svbrdf.normal, albedo, svbrdf.roughness, specular)
