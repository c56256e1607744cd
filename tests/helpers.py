"""Shared by tests: tolerances per dtype, a gradcheck that insists on good inputs, random legal materials."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn import functional

from nets.render import PointLight
from nets.svbrdf import SVBRDF

TOLERANCES: dict[torch.dtype, dict[str, float]] = {
    torch.float16: {"rtol": 2e-3, "atol": 1e-3},
    torch.bfloat16: {"rtol": 2e-2, "atol": 1e-2},
    torch.float32: {"rtol": 1e-4, "atol": 1e-5},
    torch.float64: {"rtol": 1e-9, "atol": 1e-11},
}
"""What rounding alone explains, by dtype."""


def assert_close(found: Tensor, expected: Tensor, **overrides: Any) -> None:
    """Compare within `TOLERANCES` of the found dtype; shapes must agree, dtypes need not."""
    assert found.shape == expected.shape
    tolerances = {**TOLERANCES[found.dtype], **overrides}
    torch.testing.assert_close(found, expected, check_dtype=False, **tolerances)


def gradcheck(function: Callable[..., Tensor], *inputs: Tensor) -> None:
    """Hold autograd to finite differences in float64; constant inputs, which hide errors, are refused."""
    leaves = []
    for value in inputs:
        assert value.dtype == torch.float64
        assert value.numel() == 1 or float(value.std()) > 0.0, "a constant input hides errors"
        leaves.append(value.detach().clone().requires_grad_(True))
    assert torch.autograd.gradcheck(function, tuple(leaves), eps=1e-6, atol=1e-5, rtol=1e-4)


def seeded(seed: int) -> torch.Generator:
    """Return a random stream of its own."""
    return torch.Generator().manual_seed(seed)


def random_svbrdf(
    batch: int = 1,
    height: int = 5,
    width: int = 7,
    *,
    seed: int = 0,
    tilt: float = 0.6,
    roughness: tuple[float, float] = (0.1, 1.0),
    dtype: torch.dtype = torch.float32,
) -> SVBRDF:
    """Draw a legal material; `tilt` is the largest slope of its normals along x and y."""
    generator = seeded(seed)

    def uniform(channels: int, low: float, high: float) -> Tensor:
        values = torch.rand(batch, channels, height, width, generator=generator, dtype=torch.float64)
        return low + (high - low) * values

    slopes = uniform(2, -tilt, tilt)
    normal = functional.normalize(torch.cat([slopes, torch.ones_like(slopes[:, :1])], dim=1), dim=1)
    return SVBRDF(normal, uniform(3, 0.02, 0.98), uniform(1, *roughness), uniform(3, 0.02, 0.98)).to(dtype)


def random_light(
    batch: int = 1,
    *,
    seed: int = 0,
    falloff: Literal["none", "inverse_square"] = "none",
    dtype: torch.dtype = torch.float32,
) -> PointLight:
    """Draw coloured lights somewhere above the surface."""
    generator = seeded(seed)
    x, y, z = torch.rand(3, batch, generator=generator, dtype=torch.float64)
    position = torch.stack([3.0 * x - 1.5, 3.0 * y - 1.5, 0.8 + 2.0 * z], dim=1)
    intensity = 0.5 + torch.rand(batch, 3, generator=generator, dtype=torch.float64)
    return PointLight(position.to(dtype), intensity.to(dtype), falloff)


def is_running(pid: int) -> bool:
    """Whether a process is there and no zombie; looks in /proc."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
