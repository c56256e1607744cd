"""A material to export, under a name that every format has to escape."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import interpolate, normalize

from nets.svbrdf import SVBRDF
from refine.export.bundle import Source
from tests.helpers import seeded

AWKWARD = '2 "stones" & <co> é@\''
"""A stem of everything that XML, JSON, USD and Python have to escape."""


@pytest.fixture
def material() -> SVBRDF:
    """Return a smooth material, wider than high, with coloured metal and dielectric in it."""
    field = interpolate(torch.rand(1, 10, 6, 8, generator=seeded(0)), (48, 64), mode="bilinear")
    slopes = 0.5 * (field[:, :2] - 0.5)
    normal = normalize(torch.cat([slopes, torch.ones_like(slopes[:, :1])], dim=1), dim=1)
    return SVBRDF(normal, field[:, 3:6], 0.1 + 0.9 * field[:, 6:7], 0.02 + 0.6 * field[:, 7:] ** 2)


@pytest.fixture
def source(material: SVBRDF) -> Source:
    """Return it as a source with an awkward name."""
    return Source(material, AWKWARD)
