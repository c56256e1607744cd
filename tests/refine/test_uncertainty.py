"""Deviations: the posterior's where the photo tells something, the expected error where it does not."""

from dataclasses import replace

import pytest
import torch

from nets.render import Camera, PointLight, render
from nets.svbrdf import MAPS, SVBRDF
from refine import bands
from refine.capture import Capture
from refine.engine.gauss_newton import posterior_deviations, solve, stack
from refine.expected_error import FEATURES, ErrorModel, expected_errors, features, with_means
from refine.parametrization import Parameters
from refine.uncertainty import deviations
from tests.helpers import assert_close, random_svbrdf, seeded


def photographed(svbrdf: SVBRDF, saturated: bool = False, **light: float) -> Capture:
    flash = PointLight.at((light.get("x", 0.0), light.get("y", 0.0), 2.0))
    photo = render(svbrdf, flash, Camera()).clamp(0.0, 1.0).float()
    if saturated:
        photo = torch.ones_like(photo)
    return Capture(photo, (photo < 1.0).all(dim=1, keepdim=True), Camera(), flash)


def constant_model(error: float = 0.1, scale: float = 1.0) -> ErrorModel:
    """A model that expects the same error everywhere."""
    count = 2 * len(FEATURES)
    weights = (0.0,) * count + (float(torch.tensor(error + 0.01).log()),)
    return ErrorModel(
        (0.0,) * count, (1.0,) * count, dict.fromkeys(MAPS, weights), dict.fromkeys(MAPS, scale), {}
    )


@pytest.fixture
def surface() -> SVBRDF:
    return random_svbrdf(height=12, width=16, seed=3, tilt=0.2)


def test_what_no_photo_shows_is_as_doubtful_as_expected(surface: SVBRDF) -> None:
    # A clipped photo under a light so bright that every material would clip it.
    clipped = photographed(surface, saturated=True)
    capture = replace(clipped, light=PointLight.at((0.0, 0.0, 2.0), intensity=1e3))
    found = deviations(surface, surface, capture, constant_model(0.1))
    for name in ("diffuse", "roughness", "specular"):
        plane = getattr(surface, name)
        inside = ((plane > 0.05) & (plane < 0.95)).all(dim=1, keepdim=True)
        assert found[name].shape == (1, 1, 12, 16)
        assert bool(inside.any())
        assert_close(found[name][inside], torch.full_like(found[name][inside], 0.1), rtol=1e-3)


def test_a_photo_narrows_and_more_photos_narrow_more(surface: SVBRDF) -> None:
    model = constant_model(0.1)
    one = deviations(surface, surface, photographed(surface), model)
    photos = [photographed(surface, x=x, y=y) for x, y in ((0.0, 0.0), (0.8, 0.0), (0.0, -0.8))]
    three = deviations(surface, surface, photos, model)
    for name in MAPS:
        assert bool((one[name] <= 0.1 * 1.3).all())
        assert bool((three[name] <= one[name] + 1e-6).all())
    assert float(one["diffuse"].mean()) < 0.09
    assert float(three["diffuse"].mean()) < 0.95 * float(one["diffuse"].mean())


def test_scale_scales(surface: SVBRDF) -> None:
    capture = photographed(surface)
    one, two = (deviations(surface, surface, capture, constant_model(0.1, scale)) for scale in (1.0, 2.0))
    for name in MAPS:
        assert_close(two[name], 2.0 * one[name])


def test_bands_do_not_show(surface: SVBRDF, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = photographed(surface)
    whole = deviations(surface, surface, capture)
    monkeypatch.setattr(bands, "BAND_PIXELS", 16 * 5)
    for name, expected in whole.items():
        assert_close(deviations(surface, surface, capture)[name], expected)


def test_the_posterior_is_the_solvers() -> None:
    surface = random_svbrdf(height=4, width=5, seed=1)
    capture = photographed(surface)
    start = Parameters.from_svbrdf(surface)
    widths = {"normal": 0.3, "diffuse": 0.5, "roughness": 0.2, "specular": 0.4}
    solved = solve(start, capture, iterations=3, widths=widths, noise=0.1, huber=3.0)
    planes = Parameters(*(torch.full_like(getattr(start, name), widths[name]) for name in MAPS))
    found = posterior_deviations(solved.parameters, capture, widths=planes, noise=0.1, huber=3.0)
    assert_close(stack(found), stack(solved.deviations))


def test_features_see_what_they_are_named_after(surface: SVBRDF) -> None:
    capture = photographed(surface)
    seen = dict(zip(FEATURES, features(surface, surface, capture)[0], strict=True))
    small = torch.full_like(seen["residue"], 1e-3).log()
    assert_close(seen["contradiction"], small, atol=1e-2)  # its own photo contradicts nothing
    assert_close(seen["diffuse moved"], small)
    other = replace(surface, diffuse=(surface.diffuse * 0.5))
    moved = dict(zip(FEATURES, features(other, surface, capture)[0], strict=True))
    assert bool((moved["contradiction"] > seen["contradiction"]).any())
    assert bool((moved["diffuse moved"] > seen["diffuse moved"]).all())
    assert_close(moved["roughness"], surface.roughness[0, 0])
    assert_close(seen["clipped"], (~capture.unsaturated[0, 0]).float())


def test_means_follow_pixels() -> None:
    planes = torch.rand(1, 3, 4, 5, generator=seeded(0))
    rows = with_means(planes)
    assert rows.shape == (20, 6)
    assert_close(rows[:, :3], planes[0].flatten(1).T)
    assert_close(rows[7, 3:], planes.mean(dim=(2, 3))[0])


def test_expected_errors_of_a_large_photo_are_computed_small() -> None:
    surface = random_svbrdf(height=1, width=1, seed=2).map(lambda plane: plane.expand(-1, -1, 300, 520))
    errors = expected_errors(surface, surface, photographed(surface))
    assert errors.shape == (1, 4, 300, 520)
    assert bool((errors > 0.0).all())
    assert bool(torch.isfinite(errors).all())


def test_the_shipped_model_is_whole() -> None:
    model = ErrorModel.shipped()
    assert len(model.mean) == len(model.deviation) == 2 * len(FEATURES)
    assert set(model.weights) == set(model.scale) == set(MAPS)
    assert all(len(weights) == 2 * len(FEATURES) + 1 for weights in model.weights.values())
    assert {"data", "seed", "commit", "materials"} <= set(model.origin)
