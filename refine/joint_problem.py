"""Lights and material of one surface as one robust least-squares problem: residuals, priors, descent.

Unknown are, for every sampled pixel, the nine parameters of its material (`refine.parametrization`) and, for
every photo, the light's x, y, log z and log exposure. All photos show the same material: that is what gives
the lights away. Where to start and when to trust what: `refine.calibration`.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.func import jvp, vmap

from nets.color import GAMMA, GAMMA_FLOOR
from nets.render import Camera, PointLight, shade, shading_geometry
from refine.bordered import solve_bordered
from refine.parametrization import SLOPE_SCALE, Parameters

MATERIAL = 9
"""Parameters of a pixel: two slopes, three colours each of diffuse and specular, roughness between."""

X, Y, LOG_Z, EXPOSURE = range(4)
"""What is unknown of a light."""

LARGEST_DAMPING = 1e6
"""Of Levenberg and Marquardt; a step that is still refused then is the end."""


@dataclass(frozen=True)
class MaterialPrior:
    """How far the material may be from the network's, as standard deviations of its parameters.

    Attributes:
        normal: of a pixel's slopes.
        diffuse: of a pixel's logit.
        roughness: of a pixel's logit.
        specular: of a pixel's logit.
        shift: of the one shift of all pixels' diffuse, roughness and specular logits.
        tilt: mean slope of a surface that is called flat.
        bend: slope that changes by this from the centre to the edge.
        twist: the same, for the part that no surface has because its curl is not zero.
    """

    normal: float = 0.2
    diffuse: float = 1.0
    roughness: float = 0.7
    specular: float = 0.7
    shift: tuple[float, float, float] = (1.0, 1.5, 1.5)
    tilt: float = 0.03
    bend: float = 0.02
    twist: float = 0.003

    @property
    def weights(self) -> Float[Tensor, "9 1"]:
        """Return the inverse variance of each of a pixel's parameters."""
        widths = [self.normal / SLOPE_SCALE] * 2 + [self.diffuse] * 3
        widths += [self.roughness] + [self.specular] * 3
        return torch.tensor(widths, dtype=torch.float64)[:, None] ** -2


@dataclass(frozen=True)
class Estimate:
    """One answer.

    Attributes:
        material: parameters of every sampled pixel.
        lights: x, y, log z, log exposure of every photo.
        shift: of diffuse, roughness and specular of all pixels.
        cost: of `JointProblem.cost`; infinite if it was not evaluated.
    """

    material: Float[Tensor, "9 pixels"]
    lights: Float[Tensor, "photos 4"]
    shift: Float[Tensor, "3"]
    cost: float = math.inf


@dataclass(frozen=True)
class JointProblem:
    """The sampled pixels of all photos, what is known beforehand, and the scale of the robust distance.

    Attributes:
        encoded: photos, gamma-encoded.
        unsaturated: elsewhere a photo only says "at least this".
        points: of the surface.
        material: parameters the prior is around, before they are shifted.
        prior: its widths.
        lights: the prior's mean.
        light_weights: its inverse covariance.
        free: which of a light's four numbers are unknown; the others stay at the mean.
        camera: that took the photos.
        falloff: of the lights.
        scale: encoded difference where soft L1 turns from square to linear.
    """

    encoded: Float[Tensor, "photos 3 pixels"]
    unsaturated: Bool[Tensor, "photos 1 pixels"]
    points: Float[Tensor, "3 1 pixels"]
    material: Float[Tensor, "9 pixels"]
    prior: MaterialPrior
    lights: Float[Tensor, "photos 4"]
    light_weights: Float[Tensor, "unknown unknown"]
    free: Sequence[int]
    camera: Camera
    falloff: Literal["none", "inverse_square"]
    scale: float

    def point_light(self, lights: Float[Tensor, "photos 4"]) -> PointLight:
        """Return the lights that these numbers mean.

        The exposure is that of a flash of constant power: with falloff, `PointLight.intensity`, which is the
        radiance of the surface's centre, is the exposure over the squared distance.
        """
        position = torch.stack([lights[:, X], lights[:, Y], lights[:, LOG_Z].exp()], dim=1)
        intensity = lights[:, EXPOSURE].exp()
        if self.falloff == "inverse_square":
            intensity = intensity / (position**2).sum(dim=1)
        return PointLight(position, intensity[:, None].expand(-1, 3), self.falloff)

    def residuals(
        self, material: Float[Tensor, "9 pixels"], lights: Float[Tensor, "photos 4"]
    ) -> Float[Tensor, "photos 3 pixels"]:
        """Return encoded rendering minus photo; where the photo is saturated only what is too dark."""
        parts = torch.split(material[None, :, None], [2, 3, 1, 3], dim=1)
        geometry = shading_geometry(self.points, self.point_light(lights), self.camera)
        radiance = shade(Parameters(*parts).svbrdf(), geometry)[:, :, 0]
        # Not clamped at 1 as an image is: too bright must differ from much too bright.
        difference = radiance.clamp(min=GAMMA_FLOOR) ** (1.0 / GAMMA) - self.encoded
        return torch.where(self.unsaturated, difference, difference.clamp(max=0.0))

    def cost(self, estimate: Estimate) -> float:
        """Return the sum of squared priors and robust residuals, in units of their standard deviations."""
        lights = (estimate.lights - self.lights)[:, self.free].flatten()
        return float(
            self.cost_by_pixel(estimate).sum()
            + (self._flatness @ estimate.material[:2].flatten()).square().sum()
            + lights @ self.light_weights @ lights
            + (estimate.shift.square() * self._shift_weights).sum()
        )

    def cost_by_pixel(self, estimate: Estimate) -> Float[Tensor, "pixels"]:
        """Return what is every pixel's own of the cost."""
        scaled = self.residuals(estimate.material, estimate.lights) / self.scale
        robust = 2.0 * ((1.0 + scaled**2).sqrt() - 1.0)
        away = estimate.material - self.material - self._spread @ estimate.shift[:, None]
        return robust.sum(dim=(0, 1)) + (away**2 * self.prior.weights).sum(dim=0)

    def improve(self, start: Estimate, iterations: int, tolerance: float) -> Estimate:
        """Descend by Levenberg-Marquardt steps on reweighted residuals; the cost never grows.

        Args:
            start: its cost is evaluated anew.
            iterations: most steps.
            tolerance: share of the cost; a step that gains less is the last.
        """
        best = replace(start, cost=self.cost(start))
        damping = 1e-2
        for _ in range(iterations):
            system = self._normal_equations(best)
            before = best.cost
            while damping < LARGEST_DAMPING:
                moved = self._step(best, system, damping)
                if moved.cost < before:
                    best = moved
                    break
                damping *= 4.0
            damping = max(damping / 5.0, 1e-7)
            if before - best.cost <= tolerance * before:
                break
        return best

    def _step(self, now: Estimate, system: tuple[Tensor, ...], damping: float) -> Estimate:
        blocks, border, corner, own, shared = system
        photos, count = len(self.encoded), len(self.encoded) * len(self.free)
        blocks = blocks + damping * torch.diag_embed(blocks.diagonal(dim1=1, dim2=2))
        # The last rows of the corner are constraints, which are not damped.
        corner = corner + damping * corner.diagonal().clamp(min=0.0).diag()
        try:
            by_pixel, step = solve_bordered(blocks, border, corner, own, shared)
        except torch.linalg.LinAlgError:
            return now
        lights = now.lights.clone()
        lights[:, self.free] += step[:count].reshape(photos, -1)
        moved = Estimate(now.material + by_pixel.T, lights, now.shift + step[count : count + 3])
        cost = self.cost(moved)
        return replace(moved, cost=cost if math.isfinite(cost) else math.inf)

    def _normal_equations(self, now: Estimate) -> tuple[Tensor, ...]:
        """Linearise around an estimate: the arguments of `solve_bordered`.

        What is shared is, in order: the lights, the shifts, and one multiplier for each statement of
        flatness, which ties all pixels together and so cannot be in their blocks.
        """
        residuals = self.residuals(now.material, now.lights)
        weights = (1.0 + (residuals / self.scale) ** 2) ** -0.25 / self.scale
        residuals = residuals * weights
        by_material, by_light = (part * weights for part in self._jacobian(now))
        pixels, photos = residuals.shape[-1], len(residuals)

        own = by_material.permute(3, 0, 1, 2).flatten(2)  # [pixels, 9, residuals of a pixel]
        prior = self.prior.weights
        away = now.material - self.material - self._spread @ now.shift[:, None]
        flat = torch.zeros(pixels, MATERIAL, len(self._flatness), dtype=torch.float64)
        flat[:, 0], flat[:, 1] = self._flatness[:, :pixels].T, self._flatness[:, pixels:].T
        pull = flat @ (self._flatness @ now.material[:2].flatten())
        own_side = -(own @ residuals.permute(2, 0, 1).reshape(pixels, -1, 1))[..., 0]
        own_side = own_side - (away * prior).T - pull

        across = torch.einsum("ipcn,kpcn->nipk", by_material, by_light).flatten(2)
        shifted = -(self._spread * prior).expand(pixels, -1, -1)
        own_lights = torch.einsum("kpcn,lpcn->pkl", by_light, by_light)
        lights = (now.lights - self.lights)[:, self.free].flatten()
        light_side = -torch.einsum("kpcn,pcn->pk", by_light, residuals).flatten()
        light_side = light_side - self.light_weights @ lights
        corner = torch.block_diag(
            torch.block_diag(*own_lights) + self.light_weights,
            pixels * self._spread.T @ (self._spread * prior) + self._shift_weights.diag(),
            -torch.eye(len(self._flatness), dtype=torch.float64),
        )
        shift_side = self._spread.T @ (away * prior).sum(dim=1) - now.shift * self._shift_weights
        shared_side = torch.cat([light_side, shift_side, torch.zeros(len(self._flatness)).double()])
        assert corner.shape[0] == photos * len(self.free) + 3 + len(self._flatness)
        blocks = own @ own.transpose(1, 2) + prior[:, 0].diag()
        return blocks, torch.cat([across, shifted, flat], dim=2), corner, own_side, shared_side

    def _jacobian(self, now: Estimate) -> tuple[Tensor, Tensor]:
        """Return the residuals' derivatives `[9, photos, 3, pixels]` and `[free, photos, 3, pixels]`.

        Pixels do not see each other's material, photos not each other's lights and colours not each other's
        albedo: five tangents find the derivatives of all materials, one more each those of all lights.
        """
        groups = ((0,), (1,), (2, 3, 4), (5,), (6, 7, 8))
        material = torch.zeros(len(groups) + len(self.free), *now.material.shape, dtype=torch.float64)
        lights = torch.zeros(len(material), *now.lights.shape, dtype=torch.float64)
        for tangent, group in enumerate(groups):
            material[tangent, group] = 1.0
        for tangent, number in enumerate(self.free, start=len(groups)):
            lights[tangent, :, number] = 1.0

        def derivative(along_material: Tensor, along_lights: Tensor) -> Tensor:
            primals, tangents = (now.material, now.lights), (along_material, along_lights)
            return jvp(self.residuals, primals, tangents)[1]

        with warnings.catch_warnings():
            # torch's own: loading forward differentiation for the first time calls what it deprecates.
            warnings.filterwarnings("ignore", ".*torch.jit.script", DeprecationWarning)
            found = vmap(derivative)(material, lights)
        by_material = found.new_zeros(MATERIAL, *found.shape[1:])
        for derivatives, group in zip(found, groups, strict=False):
            for channel, number in enumerate(group):
                where = slice(None) if len(group) == 1 else channel
                by_material[number, :, where] = derivatives[:, where]
        return by_material, found[len(groups) :]

    @cached_property
    def _shift_weights(self) -> Float[Tensor, "3"]:
        return torch.tensor(self.prior.shift, dtype=torch.float64) ** -2

    @cached_property
    def _spread(self) -> Float[Tensor, "9 3"]:
        """Which parameters the three shifts move."""
        spread = torch.zeros(MATERIAL, 3, dtype=torch.float64)
        spread[2:5, 0] = spread[5, 1] = spread[6:, 2] = 1.0
        return spread

    @cached_property
    def _flatness(self) -> Float[Tensor, "6 twice_pixels"]:
        """Statements on the slopes' best affine fit `s = t + B p`, each over its standard deviation.

        A dome under a far light shades a matte surface as a plane under a near one: only knowing that the
        surface is flat tells them apart. The two slopes follow each other along the last axis.
        """
        x, y = self.points[0, 0], self.points[1, 0]
        constant, by_x, by_y = SLOPE_SCALE * torch.linalg.pinv(torch.stack([torch.ones_like(x), x, y], dim=1))
        none = torch.zeros_like(x)
        prior = self.prior
        rows = (
            ((constant, none), prior.tilt),
            ((none, constant), prior.tilt),
            ((by_x, none), prior.bend),
            ((none, by_y), prior.bend),
            ((by_y / 2.0, by_x / 2.0), prior.bend),
            ((by_y / 2.0, -by_x / 2.0), prior.twist),
        )
        return torch.stack([torch.cat(row) / width for row, width in rows])
