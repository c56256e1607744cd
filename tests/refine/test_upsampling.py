"""Guided upsampling: detail of the photo becomes detail of those maps it comes from, without seams."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from nets.render import PointLight, render
from nets.svbrdf import MAPS, SVBRDF
from refine import bands
from refine.initialization import initialize
from refine.upsampling import WHOLE, find_shares, legal, octaves, sample, shrink, upsample
from tests.helpers import assert_close, random_svbrdf, seeded

SIDE, SIZE = 64, 256
"""Sides of the maps that are carried and of the photo they are carried to."""

LIGHT = PointLight.at((0.5, 0.3, 2.0))


def texture(size: int, seed: int = 0) -> Tensor:
    """Return `[1, 1, size, size]` in [0, 1], as rough as many a surface: less in every octave."""
    generator, total = seeded(seed), torch.zeros(1, 1, size, size)
    for octave in range(2, 9):
        noise = torch.rand(1, 1, 2**octave, 2**octave, generator=generator) - 0.5
        total += 0.6**octave * interpolate(noise, (size, size), mode="bicubic", align_corners=False)
    return (total - total.min()) / (total.max() - total.min())


def painted(size: int) -> SVBRDF:
    flat = SVBRDF.constant(size, size, roughness=0.5)
    colors = torch.tensor([0.5, 0.3, 0.2])[:, None, None] * (0.2 + 1.2 * texture(size))
    return replace(flat, diffuse=colors)


def embossed(size: int) -> SVBRDF:
    height = 0.06 * texture(size, seed=1)
    right = (height.roll(-1, 3) - height.roll(1, 3)) * size / 4
    down = (height.roll(-1, 2) - height.roll(1, 2)) * size / 4
    normal = normalize(torch.cat([-right, down, torch.ones_like(right)], dim=1), dim=1)
    return replace(SVBRDF.constant(size, size, diffuse=0.4, roughness=0.5), normal=normal)


def small(material: SVBRDF) -> SVBRDF:
    """Return what a perfect network would say of a shrunken photo."""
    return legal(material.map(lambda tensor: shrink(tensor, (SIDE, SIDE))))


def carried(material: SVBRDF) -> tuple[SVBRDF, SVBRDF]:
    """Return the maps of a shrunken photo carried to the photo with its guidance, and without."""
    photo = render(material, LIGHT).clamp(max=1.0)
    found = upsample(small(material), shrink(photo, (SIDE, SIDE)), photo, WHOLE, LIGHT)
    return found.validate(), blurred(small(material))


def blurred(material: SVBRDF) -> SVBRDF:
    return legal(material.map(lambda tensor: interpolate(tensor, (SIZE, SIZE), mode="bilinear")))


def rmse(a: Tensor, b: Tensor) -> float:
    return float((a - b).square().mean().sqrt())


def test_paint_becomes_paint_and_not_slope() -> None:
    truth = painted(SIZE)
    found, blurry = carried(truth)
    assert rmse(found.diffuse, truth.diffuse) < 0.25 * rmse(blurry.diffuse, truth.diffuse)
    assert rmse(found.normal, truth.normal) < 0.01
    assert rmse(found.roughness, truth.roughness) < 0.01


def test_slope_becomes_slope_and_not_paint() -> None:
    truth = embossed(SIZE)
    found, blurry = carried(truth)
    assert rmse(found.normal, truth.normal) < 0.9 * rmse(blurry.normal, truth.normal)
    painting = upsample(
        painted(SIDE), shrink(render(truth, LIGHT), (SIDE, SIDE)), render(truth, LIGHT), WHOLE, LIGHT
    )
    variation = [float(material.diffuse.std(dim=(2, 3)).mean()) for material in (found, painting)]
    assert variation[0] < 0.1 * variation[1]


def test_colored_detail_is_paint_whatever_the_network_thinks() -> None:
    reddened = painted(SIZE).diffuse.clone()
    reddened[:, :1] *= 0.5 + texture(SIZE, seed=5)
    photo = render(replace(painted(SIZE), diffuse=reddened), LIGHT).clamp(max=1.0)
    uniform = SVBRDF.constant(SIDE, SIDE, diffuse=0.3, roughness=0.5)
    found = upsample(uniform, shrink(photo, (SIDE, SIDE)), photo, WHOLE, LIGHT).diffuse
    redness, expected = (torch.log(image[:, :1] / image[:, 1:2]) for image in (found, reddened))
    expected = expected - interpolate(shrink(expected, (SIDE, SIDE)), (SIZE, SIZE), mode="bilinear")
    assert rmse(redness, expected) < 0.3 * float(expected.std())


def test_a_blank_photo_adds_nothing() -> None:
    maps = small(painted(SIZE))
    photo = torch.full((1, 3, SIZE, SIZE), 0.4)
    found = upsample(maps, shrink(photo, (SIDE, SIDE)), photo, WHOLE, LIGHT)
    once = blurred(maps)
    # Two bilinear steps of 2 are not quite one of 4.
    assert rmse(found.diffuse, once.diffuse) < 0.03 * float(once.diffuse.std())
    assert_close(found.normal, once.normal)


@pytest.mark.parametrize("pixels", [1, 1000, 7777])
def test_bands_leave_no_seams(pixels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, _ = carried(painted(SIZE))
    monkeypatch.setattr(bands, "BAND_PIXELS", pixels)
    parts, _ = carried(painted(SIZE))
    for name in MAPS:
        assert_close(getattr(parts, name), getattr(whole, name))


@pytest.mark.parametrize("size", [(300, 300), (256, 700), (1030, 257)])
def test_any_photo_gives_legal_maps(size: tuple[int, int]) -> None:
    def model(photo: Tensor) -> tuple[SVBRDF, PointLight]:
        return random_svbrdf(1, *photo.shape[-2:], tilt=4.0, roughness=(0.001, 1.0)), LIGHT

    photo = torch.rand(1, 3, *size, generator=seeded(1)) ** 8
    photo[..., :9, :] = 0.0
    photo[..., -9:, :] = 1.0
    material, _ = initialize(model, photo)
    assert material.validate().size == size


def test_a_featureless_guess_has_shares_all_the_same() -> None:
    shares = find_shares(SVBRDF.constant(SIDE, SIDE), PointLight.at((0.0, 0.0, 2.0)))
    for name in ("slope", "relief", "roughness"):
        assert float(getattr(shares, name).abs().max()) < 1e-3
    assert bool(torch.isfinite(shares.diffuse).all())


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((512, 512), [(512, 512)]),
        ((257, 100), [(257, 100)]),
        ((1024, 512), [(512, 256), (1024, 512)]),
        ((3000, 2000), [(474, 316), (876, 584), (1621, 1081), (3000, 2000)]),
    ],
)
def test_octaves_grow_evenly_to_the_photo(size: tuple[int, int], expected: list[tuple[int, int]]) -> None:
    found = octaves(torch.rand(1, 3, *size), 256)
    assert [tuple(image.shape[-2:]) for image in found] == expected


def test_sampling_is_bilinear() -> None:
    image = torch.rand(1, 2, 7, 5, dtype=torch.float64)
    rows, columns = ((torch.arange(n).double() + 0.5) / n * m - 0.5 for n, m in ((20, 7), (31, 5)))
    expected = interpolate(image, (20, 31), mode="bilinear", align_corners=False)
    assert_close(sample(image, rows, columns), expected)
    assert_close(sample(image, torch.tensor([2.0]), torch.tensor([3.0]))[0, :, 0, 0], image[0, :, 2, 3])
