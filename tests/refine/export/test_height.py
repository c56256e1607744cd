"""Heights from normals whose surface is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from nets.data.procedural import generate
from refine.export.height import height_from_normals, relief

AMPLITUDE = 0.05


def normals(slope_x: np.ndarray, slope_y: np.ndarray) -> Tensor:
    vectors = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)])
    return torch.from_numpy(vectors / np.linalg.norm(vectors, axis=0))[None]


def grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Surface coordinates of pixel centres, written out: x right, y up, the longer side spans [-1, 1]."""
    spacing = 2.0 / max(height, width)
    x = (np.arange(width) - (width - 1) / 2) * spacing
    y = -(np.arange(height) - (height - 1) / 2) * spacing
    return np.meshgrid(x, y)


@pytest.mark.parametrize(("height", "width"), [(64, 64), (48, 80), (81, 50)])
def test_a_known_sinusoid_is_recovered(height: int, width: int) -> None:
    x, y = grid(height, width)
    u, v = (2 * np.pi * k * max(height, width) / (2.0 * n) for k, n in ((3, width), (2, height)))
    known = AMPLITUDE * np.sin(u * x + v * y + 0.4)
    slope = AMPLITUDE * np.cos(u * x + v * y + 0.4)
    found = height_from_normals(normals(u * slope, v * slope), repeats=True)
    np.testing.assert_allclose(found, known - known.mean(), atol=1e-9)


@pytest.mark.parametrize(("height", "width"), [(64, 64), (48, 80), (81, 50)])
def test_a_known_surface_that_does_not_repeat_is_recovered(height: int, width: int) -> None:
    x, y = grid(height, width)
    left, bottom = (-n / max(height, width) for n in (width, height))
    u, v = (np.pi * k * max(height, width) / (2.0 * n) for k, n in ((3, width), (1, height)))
    known = AMPLITUDE * np.cos(u * (x - left)) * np.cos(v * (y - bottom))
    slope_x = -AMPLITUDE * u * np.sin(u * (x - left)) * np.cos(v * (y - bottom))
    slope_y = -AMPLITUDE * v * np.cos(u * (x - left)) * np.sin(v * (y - bottom))
    found = height_from_normals(normals(slope_x, slope_y))
    np.testing.assert_allclose(found, known - known.mean(), atol=1e-9)


def test_what_points_up_is_higher_below_it() -> None:
    """A normal that leans to +y (up in the picture) stands on ground that falls upwards."""
    slope = np.full((40, 40), -0.3)
    found = height_from_normals(normals(np.zeros_like(slope), slope))
    assert found[30, 20] > found[10, 20]


def test_slopes_that_no_surface_has_are_projected() -> None:
    """A rotation field has no potential: nothing of it is left."""
    x, y = grid(64, 64)
    swirl = np.pi * 0.1
    p, q = -swirl * np.sin(np.pi * y) * np.cos(np.pi * x), swirl * np.sin(np.pi * x) * np.cos(np.pi * y)
    assert np.abs(height_from_normals(normals(p, q), repeats=True)).max() < 1e-9


def test_grazing_normals_are_bounded() -> None:
    normal = torch.zeros(1, 3, 16, 16)
    normal[:, 0] = 1.0
    assert np.isfinite(height_from_normals(normal)).all()


def test_relief_says_what_its_values_mean() -> None:
    heights = np.array([[-0.2, 0.1], [0.3, 0.0]])
    found = relief(heights)
    assert (found.picture.min(), found.picture.max()) == (0.0, 1.0)
    np.testing.assert_allclose(found.low + found.picture * (found.high - found.low), heights)
    flat = relief(np.zeros((3, 3)))
    assert (flat.low, flat.high, float(flat.picture.mean())) == (0.0, 0.0, 0.5)


def test_the_relief_of_a_generated_wall_is_recovered() -> None:
    """Its normals are central differences of a known height: the courses and their depth come back."""
    wall = generate("slate", 96, 3)
    found = height_from_normals(torch.from_numpy(wall.normal).movedim(-1, 0)[None])
    known = wall.height - wall.height.mean()
    assert np.corrcoef(found.ravel(), known.ravel())[0, 1] > 0.99
    assert found.std() == pytest.approx(known.std(), rel=0.05)
