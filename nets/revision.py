"""A second look: the photo beside the re-rendering of what was made of it, and what the maps change for that.

A network that never sees its own rendering cannot know where its maps fail to explain the photo. This one is
shown where, and what would mend it at every pixel; a small U-Net turns that into a correction of the maps.
The idea is that of the rendering error in the cascade of Li et al. 2018; the paper has nothing of the kind.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nets.color import gamma_encode_from_floor
from nets.light_head import LEAKY_SLOPE
from nets.render import PAPER, Camera, Geometry, PointLight, shade, shading_geometry, surface_points
from nets.svbrdf import CHANNELS, MAPS, SVBRDF

FEEDBACK = 20
"""Channels of `feedback`."""

RESIDUAL_SCALE = 5.0
"""Encoded differences are multiplied by this: they are small beside everything else that is seen."""

LARGEST_FEEDBACK = 2.0
"""Differences, places in the lobe and steps are kept within plus and minus this."""

STEP_WIDTHS = {"normal": 0.14, "diffuse": 0.12, "roughness": 0.16, "specular": 0.11}
"""How far maps are typically off (`python -m eval.prior`): what `explaining_step` calls a small change."""

STEP_NOISE = 0.02
"""Encoded difference that `explaining_step` need not explain."""

REVISION_WIDTHS = (1.5, 3.0, 4.0)
"""Channels at half, quarter and eighth resolution, as multiples of those at full resolution."""


def feedback(
    estimate: SVBRDF,
    light: PointLight,
    photo: Float[Tensor, "b 3 h w"],
    camera: Camera | None = None,
) -> Float[Tensor, "b 20 h w"]:
    """Return what a photo says of an estimate of it: features, through which no gradient flows.

    Args:
        estimate: the material.
        light: where its flash is taken to be, one per material.
        photo: encoded to [-1, 1], as the network sees it.
        camera: of the photo; the authors' by default.

    Returns:
        The rendering, encoded to [-1, 1]; how much brighter the photo is, times `RESIDUAL_SCALE`; how far
        each pixel's slope is from that of a mirror, in units of its lobe's width (GGX alpha), where
        brightness changes fastest with the normal; `explaining_step`; and the half vector's x and y.
    """
    with torch.no_grad(), torch.autocast(photo.device.type, enabled=False):
        points = surface_points(*estimate.size, device=photo.device)
        geometry = shading_geometry(points, light, camera or Camera())
        target = (photo.float() + 1.0) / 2.0
        rendering, residual, step = explaining_step(estimate, geometry, target)
        half_vector, normal = geometry.half_vector, estimate.normal
        alpha = estimate.roughness.clamp(min=PAPER.roughness_floor) ** 2
        place = (half_vector[:, :2] / half_vector[:, 2:] - normal[:, :2] / normal[:, 2:]) / alpha
        bounded = torch.cat([RESIDUAL_SCALE * residual, place, step], dim=1)
        bounded = bounded.clamp(-LARGEST_FEEDBACK, LARGEST_FEEDBACK)
        return torch.cat([2.0 * rendering.clamp(max=1.0) - 1.0, bounded, half_vector[:, :2]], dim=1)


def explaining_step(
    estimate: SVBRDF, geometry: Geometry, target: Float[Tensor, "b 3 h w"]
) -> tuple[Float[Tensor, "b 3 h w"], Float[Tensor, "b 3 h w"], Float[Tensor, "b 10 h w"]]:
    """Return the least change of each pixel's maps that would explain a picture, to first order.

    With residual r, derivatives J [3, 10] of the encoded rendering and widths W of the maps, that is the
    damped Gauss-Newton step `W^2 J^T (J W^2 J^T + noise^2 I)^-1 r`, pixel by pixel. Where both are saturated
    nothing is left to explain.

    Args:
        estimate: the material.
        geometry: of the shading.
        target: the picture, encoded, in [0, 1]; white from 1 on.

    Returns:
        The rendering, encoded, not clipped; the residual; and the step in units of `STEP_WIDTHS`, normals
        before they are normalised.
    """
    with torch.inference_mode(False), torch.enable_grad():
        geometry = Geometry(**{name: tensor.clone() for name, tensor in vars(geometry).items()})
        target = target.clone()
        leaf = estimate.map(lambda tensor: tensor.detach().clone().requires_grad_())
        unit = functional.normalize(leaf.normal, dim=1)
        material = SVBRDF(unit, leaf.diffuse, leaf.roughness, leaf.specular)
        rendering = gamma_encode_from_floor(shade(material, geometry))
        shown = torch.where(target < 1.0, rendering, rendering.clamp(max=1.0))
        tensors = [getattr(leaf, name) for name in MAPS]
        rows = [
            torch.cat(torch.autograd.grad(shown[:, channel].sum(), tensors, retain_graph=channel < 2), dim=1)
            for channel in range(3)
        ]
    widths = torch.cat([target.new_full((CHANNELS[name],), STEP_WIDTHS[name]) for name in MAPS])
    jacobian = torch.stack(rows, dim=1) * widths[:, None, None]  # [b, 3, 10, h, w]
    residual = (target - shown).detach()
    matrix = torch.einsum("bimhw,bjmhw->bijhw", jacobian, jacobian)
    matrix = matrix + STEP_NOISE**2 * torch.eye(3, dtype=matrix.dtype, device=matrix.device)[:, :, None, None]
    step = torch.einsum("bimhw,bihw->bmhw", jacobian, _solve(matrix, residual))
    return rendering.detach(), residual, step


def _solve(matrix: Float[Tensor, "b 3 3 h w"], right: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Solve symmetric 3x3 systems, one per pixel, by cofactors: the columns' cross products.

    In float64: under a sharp highlight a matrix's eigenvalues are a billion times apart.
    """
    first, second, third = matrix.double().unbind(dim=2)
    crossed = (torch.linalg.cross(a, b, dim=1) for a, b in ((second, third), (third, first), (first, second)))
    cofactors = torch.stack(list(crossed), dim=1)
    determinant = (first * cofactors[:, 0]).sum(dim=1, keepdim=True)
    solution = torch.einsum("bijhw,bjhw->bihw", cofactors, right.double()) / determinant
    return solution.to(right.dtype)


class Revision(nn.Module):
    """A U-Net of four resolutions, without norms: absolute levels are what a residual is about.

    At the coarsest its features are also pooled over the photo: what a highlight says of gloss is true of the
    whole material.
    """

    def __init__(self, channels: int, inputs: int) -> None:
        """Build it; the last convolution begins at zero, and so do corrections.

        Args:
            channels: at full resolution; for those below see `REVISION_WIDTHS`.
            inputs: channels of what the generator's first convolution sees.
        """
        super().__init__()
        maps = sum(CHANNELS.values())
        seen = inputs + maps + FEEDBACK
        widths = tuple(math.ceil(channels * factor) for factor in REVISION_WIDTHS)
        self.down = nn.ModuleList(
            nn.Conv2d(coarse_inputs, outputs, 4, stride=2, padding=1)
            for coarse_inputs, outputs in pairwise((seen, *widths))
        )
        self.middle = nn.Conv2d(widths[-1], widths[-1], 3, padding=1)
        self.whole = nn.Linear(2 * widths[-1], widths[-1])
        self.up = nn.ModuleList(
            nn.Conv2d(coarse + fine, fine, 3, padding=1) for fine, coarse in pairwise(widths)
        )
        self.fine = nn.Conv2d(seen, channels, 3, padding=1)
        self.coarse = nn.Conv2d(widths[0], channels, 1)
        self.last = nn.Conv2d(channels, maps, 3, padding=1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)  # type: ignore[arg-type]

    def forward(
        self,
        seen: Float[Tensor, "b inputs h w"],
        estimate: Float[Tensor, "b 10 h w"],
        found: Float[Tensor, "b 20 h w"],
    ) -> Float[Tensor, "b 10 h w"]:
        """Return what to add to the maps before tanh.

        Args:
            seen: what the generator's first convolution sees.
            estimate: the maps, in [-1, 1].
            found: their `feedback`.
        """
        x = torch.cat([seen, estimate.to(seen.dtype), found.to(seen.dtype)], dim=1)
        fine, features = x, []
        for down in self.down:
            x = functional.leaky_relu(down(x), LEAKY_SLOPE)
            features.append(x)
        pooled = torch.cat([x.mean(dim=(2, 3)), x.amax(dim=(2, 3))], dim=1)
        x = x + functional.leaky_relu(self.middle(x) + self.whole(pooled)[:, :, None, None], LEAKY_SLOPE)
        for up, finer in zip(reversed(self.up), reversed(features[:-1]), strict=True):
            x = functional.leaky_relu(up(torch.cat([_double(x), finer], dim=1)), LEAKY_SLOPE)
        x = functional.leaky_relu(self.fine(fine) + _double(self.coarse(x)), LEAKY_SLOPE)
        correction: Tensor = self.last(x)
        return correction


def _double(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="nearest")
