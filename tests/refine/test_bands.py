"""Bands of rows: what is computed in them is what is computed at once."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from losses.refinement import photo_distance
from nets.render import PRESETS, Camera, render, shading_geometry, surface_points
from refine import bands
from refine.bands import distance_in_bands, photo_geometry, pixel_geometry, render_in_bands
from refine.capture import Capture
from tests.helpers import assert_close, random_light, random_svbrdf, seeded

SIZE = (23, 17)


@pytest.fixture(params=[1, 40, 100, 10**6], ids=lambda pixels: f"{pixels} px")
def _band_pixels(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bands, "BAND_PIXELS", request.param)


@pytest.mark.usefixtures("_band_pixels")
@pytest.mark.parametrize("size", [SIZE, (1, 1), (3, 200), (200, 3)])
def test_bands_cover_every_row_once(size: tuple[int, int]) -> None:
    rows = [row for band in bands.bands(*size) for row in range(size[0])[band]]
    assert rows == list(range(size[0]))


@pytest.mark.usefixtures("_band_pixels")
@pytest.mark.parametrize("kind", ["orthographic", "perspective", "collocated"])
def test_bands_render_as_one(kind: str) -> None:
    material, light = random_svbrdf(1, *SIZE), random_light(falloff="inverse_square")
    camera = Camera(kind)  # type: ignore[arg-type]
    assert_close(render_in_bands(material, light, camera), render(material, light, camera), rtol=1e-5)
    photo = torch.rand(1, 3, *SIZE, generator=seeded(3))
    capture = Capture(photo, photo[:, :1] < 0.8, camera, light)
    expected = photo_distance(render(material, light, camera), photo, capture.unsaturated)
    assert distance_in_bands(material, capture) == pytest.approx(float(expected), rel=1e-6)


@pytest.mark.parametrize("preset", ["paper", "des19"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_geometry_of_some_pixels_is_that_of_the_whole_there(preset: str, dtype: torch.dtype) -> None:
    rules, light, camera = PRESETS[preset], random_light(), Camera("collocated")
    points = surface_points(*SIZE, grid=rules.grid, dtype=dtype)
    whole = shading_geometry(points, light.to(dtype), camera, rules)
    photo = torch.zeros(1, 3, *SIZE, dtype=dtype)
    capture = Capture(photo, photo[:, :1] == 0.0, camera, light)
    some = torch.randint(SIZE[0] * SIZE[1], (4, 5), generator=seeded(0))
    for found, chosen in (
        (photo_geometry(capture, rules), torch.arange(SIZE[0] * SIZE[1]).reshape(SIZE)),
        (pixel_geometry(some, SIZE, light, camera, rules, dtype), some),
    ):
        for name in ("light_direction", "view", "half_vector", "fresnel_weight"):
            # The last few numbers of an array do not go through vector instructions.
            assert_close(getattr(found, name), getattr(whole, name).flatten(2)[..., chosen], rtol=1e-6)
        assert torch.equal(found.irradiance, whole.irradiance)


def test_a_photo_without_its_light_has_no_geometry() -> None:
    photo = torch.zeros(1, 3, 4, 4)
    capture = replace(Capture(photo, photo[:, :1] == 0.0), light=None)
    with pytest.raises(ValueError, match="light of a photo is not known"):
        photo_geometry(capture)
    with pytest.raises(ValueError, match="light of a photo is not known"):
        distance_in_bands(random_svbrdf(1, 4, 4), capture)
