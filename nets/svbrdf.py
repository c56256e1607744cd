"""The material: four maps of one flat surface, with validation. Rendering lives in `render.py`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

MAPS = ("normal", "diffuse", "roughness", "specular")
"""Map names in the paper's order N, D, R, S; also the order of tiles in a strip and of network outputs."""

CHANNELS = {"normal": 3, "diffuse": 3, "roughness": 1, "specular": 3}
"""Channels of each map; ten in all."""

UNIT_TOLERANCE = 1e-3
"""How far from 1 the length of a normal may be (16-bit files keep 2e-5, float16 1e-3)."""


@dataclass(frozen=True)
class SVBRDF:
    """Four maps of a batch of flat surfaces, linear, tangent space.

    Attributes:
        normal: unit vectors, x right, y up (OpenGL), z to the viewer.
        diffuse: linear albedo in [0, 1].
        roughness: in (0, 1]; the GGX alpha is its square.
        specular: linear reflectance at normal incidence (F0) in [0, 1].
    """

    normal: Float[Tensor, "batch 3 height width"]
    diffuse: Float[Tensor, "batch 3 height width"]
    roughness: Float[Tensor, "batch 1 height width"]
    specular: Float[Tensor, "batch 3 height width"]

    @property
    def batch(self) -> int:
        """Number of materials."""
        return self.normal.shape[0]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.normal.shape[-2], self.normal.shape[-1]

    def map(self, function: Callable[[Tensor], Tensor]) -> SVBRDF:
        """Apply one function to each of the four tensors (moving, slicing, casting)."""
        return SVBRDF(*(function(getattr(self, name)) for name in MAPS))

    def to(self, target: torch.dtype | torch.device | str) -> SVBRDF:
        """Cast all maps to a dtype or move them to a device."""
        return self.map(lambda tensor: tensor.to(target))

    def detach(self) -> SVBRDF:
        """Drop the autograd graph of all maps."""
        return self.map(torch.Tensor.detach)

    def __getitem__(self, index: int | slice | Tensor) -> SVBRDF:
        """Select along the batch; an integer keeps the batch axis with one entry."""
        if isinstance(index, int):
            index = slice(index, index + 1 or None)
        return self.map(lambda tensor: tensor[index])

    def channels(self) -> Float[Tensor, "batch 10 height width"]:
        """Stack the maps along channels in the order of `MAPS`."""
        return torch.cat([getattr(self, name) for name in MAPS], dim=1)

    @staticmethod
    def from_channels(stacked: Float[Tensor, "batch 10 height width"]) -> SVBRDF:
        """Invert `channels`."""
        return SVBRDF(*torch.split(stacked, [CHANNELS[name] for name in MAPS], dim=1))

    @staticmethod
    def cat(materials: Sequence[SVBRDF]) -> SVBRDF:
        """Concatenate materials of one size along the batch."""
        return SVBRDF(*(torch.cat([getattr(m, name) for m in materials]) for name in MAPS))

    @staticmethod
    def constant(
        height: int,
        width: int,
        *,
        diffuse: float = 0.5,
        roughness: float = 0.5,
        specular: float = 0.04,
        batch: int = 1,
        dtype: torch.dtype = torch.float32,
    ) -> SVBRDF:
        """Return a flat, uniform material (values as the attributes)."""

        def full(channels: int, value: float) -> Tensor:
            return torch.full((batch, channels, height, width), value, dtype=dtype)

        normal = full(3, 0.0)
        normal[:, 2] = 1.0
        return SVBRDF(normal, full(3, diffuse), full(1, roughness), full(3, specular))

    def validate(self) -> SVBRDF:
        """Return self if every map is legal.

        Raises:
            ValueError: naming the map and what is wrong: shapes that differ, NaN or infinity,
                values outside their range, normals that are not unit length or point away.
        """
        shape = (self.batch, *self.size)
        for name in (field.name for field in fields(self)):
            tensor = getattr(self, name).detach()
            expected = (shape[0], CHANNELS[name], *shape[1:])
            if tuple(tensor.shape) != expected:
                raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {expected}")
            if not bool(torch.isfinite(tensor).all()):
                raise ValueError(f"{name} holds NaN or infinity")
            if name == "normal":
                continue
            low, high = float(tensor.min()), float(tensor.max())
            if low < 0.0 or high > 1.0 or (name == "roughness" and low == 0.0):
                interval = "(0, 1]" if name == "roughness" else "[0, 1]"
                raise ValueError(f"{name} lies in [{low:.4g}, {high:.4g}], expected {interval}")
        normal = self.normal.detach()
        length = torch.linalg.vector_norm(normal, dim=1)
        if float((length - 1.0).abs().max()) > UNIT_TOLERANCE:
            raise ValueError(
                f"normals must be unit vectors, lengths lie in [{length.min():.4g}, {length.max():.4g}]"
            )
        if float(normal[:, 2].min()) < 0.0:
            raise ValueError(f"normals must face the viewer (z >= 0), lowest z is {normal[:, 2].min():.4g}")
        return self
