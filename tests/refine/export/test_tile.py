"""Tiles: borders that match, maps that stay together, nothing that is not legal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from nets.svbrdf import MAPS, SVBRDF
from refine.errors import UserError
from refine.export.tile import OVERLAPS, _cut, make_seamless
from tests.helpers import seeded


def smooth_material(height: int = 96, width: int = 128, seed: int = 0) -> SVBRDF:
    """Blobs of four pixels on a strong gradient: nothing of it repeats."""
    noise = torch.rand(1, 10, height // 4, width // 4, generator=seeded(seed))
    field = interpolate(noise, (height, width), mode="bicubic").clamp(0.0, 1.0)
    field = 0.5 * field + 0.4 * torch.linspace(0.0, 1.0, width) + 0.05
    slopes = field[:, :2] - 0.5
    normal = normalize(torch.cat([slopes, torch.ones_like(slopes[:, :1])], dim=1), dim=1)
    return SVBRDF(normal, field[:, 3:6], field[:, 6:7], field[:, 7:])


def steps(values: Tensor, axis: int) -> tuple[float, float]:
    """Mean difference of neighbours inside, and across the border when the tile is laid beside itself."""
    inside = values.diff(dim=axis).abs().mean()
    across = (values.select(axis, 0) - values.select(axis, -1)).abs().mean()
    return float(inside), float(across)


@pytest.mark.parametrize("size", [(96, 128), (128, 128), (150, 65)])
def test_borders_match(size: tuple[int, int]) -> None:
    material = smooth_material(*size)
    tile = make_seamless(material).validate()
    for after, before in zip(tile.size, size, strict=True):
        assert 1.0 - OVERLAPS[1] - 0.01 < after / before < 1.0 - OVERLAPS[0] + 0.01
    for name in MAPS:
        for axis in (-1, -2):
            inside, across = steps(getattr(tile, name), axis)
            assert across < 2.0 * inside, (name, axis)
        before_inside, before_across = steps(getattr(material, name), -1)
        assert before_across > 4.0 * before_inside  # so that the test can fail


def test_no_seam_inside() -> None:
    """Neighbours differ nowhere much more than they did."""
    material = smooth_material()
    tile = make_seamless(material)
    for name in MAPS:
        for axis in (-1, -2):
            before = getattr(material, name).diff(dim=axis).abs().amax()
            assert float(getattr(tile, name).diff(dim=axis).abs().amax()) < 1.5 * float(before)


def test_maps_stay_together() -> None:
    """What was a linear function of the diffuse map still is one: all maps have the same weights."""
    material = smooth_material()
    diffuse = material.diffuse
    tied = SVBRDF(material.normal, diffuse, 1.0 - 0.5 * diffuse[:, :1], 0.1 + 0.3 * diffuse)
    tile = make_seamless(tied)
    torch.testing.assert_close(tile.roughness, 1.0 - 0.5 * tile.diffuse[:, :1])
    torch.testing.assert_close(tile.specular, 0.1 + 0.3 * tile.diffuse)


def test_most_of_the_material_is_left_alone() -> None:
    material = smooth_material(100, 100)
    tile = make_seamless(material)
    height, width = tile.size
    top, left = 100 - height, 100 - width
    torch.testing.assert_close(tile.diffuse[..., top:, left:], material.diffuse[..., top:height, left:width])


def test_a_material_that_repeats_shows_through() -> None:
    """An overlap of whole periods is found; there the strips agree, and nothing changes."""
    x = torch.arange(100) / 20.0 * 2 * torch.pi  # five periods: the overlap is one
    wave = (0.5 + 0.3 * torch.sin(x))[None, None, None, :].expand(1, 1, 100, 100)
    wave = 0.5 * (wave + wave.transpose(-1, -2))
    flat = SVBRDF.constant(100, 100)
    material = SVBRDF(flat.normal, wave.expand(1, 3, 100, 100), wave, wave.expand(1, 3, 100, 100))
    tile = make_seamless(material)
    assert tile.size == (80, 80)
    torch.testing.assert_close(tile.diffuse, material.diffuse[..., :80, :80], atol=0.04, rtol=0.0)


def test_a_cut_takes_the_cheapest_way_and_comes_back() -> None:
    cost = np.ones((40, 20))
    way = (10 + 5 * np.sin(np.arange(40) / 40 * 2 * np.pi)).round().astype(int)
    cost[np.arange(40), way] = 0.0
    np.testing.assert_array_equal(_cut(cost, repeats=False), way)
    np.testing.assert_array_equal(_cut(cost, repeats=True), way)
    noise = np.random.default_rng(0).random((50, 20))
    path = _cut(noise, repeats=True)
    assert np.abs(np.diff(np.append(path, path[0]))).max() <= 1


def test_too_small_to_tile(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="32 pixels"):
        make_seamless(SVBRDF.constant(20, 64))
