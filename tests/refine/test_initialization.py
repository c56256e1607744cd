"""From a photo of any size to the square a model sees, and its maps back onto the photo, pixel for pixel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nets.render import Camera, PointLight, surface_points
from nets.svbrdf import SVBRDF
from refine.initialization import NETWORK_SIZE, initialize
from refine.upsampling import legal
from tests.helpers import assert_close, random_svbrdf, seeded

LIGHT = PointLight.at((0.1, 0.2, 2.0))


def with_diffuse(diffuse: Tensor) -> tuple[SVBRDF, PointLight]:
    return replace(SVBRDF.constant(NETWORK_SIZE, NETWORK_SIZE), diffuse=diffuse), LIGHT


def echo(photo: Tensor) -> tuple[SVBRDF, PointLight]:
    """Return the photo as the diffuse map."""
    return with_diffuse(photo)


def coordinates(photo: Tensor) -> tuple[SVBRDF, PointLight]:
    """Return every pixel's x and y on the surface, as shares of 0..1, in the diffuse map."""
    points = surface_points(*photo.shape[-2:])[None]
    return with_diffuse((points + 1.0) / 2.0)


SIZES = [(256, 256), (200, 256), (512, 300), (64, 20), (101, 16), (30, 333), (17, 257), (16, 640)]
"""Smaller and larger than the network's square, very long ones, and odd numbers."""


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_maps_lie_where_the_photo_lies(height: int, width: int) -> None:
    found, light = initialize(coordinates, torch.full((1, 3, height, width), 0.3))
    assert found.validate().size == (height, width)
    assert light is LIGHT
    expected = (surface_points(height, width)[None] + 1.0) / 2.0
    # Resampling flattens the outermost pixels of the square; an odd margin cannot be halved.
    pixel = 1.0 / max(height, width)
    edge = max(2, 2 * max(height, width) // NETWORK_SIZE)
    for axis, name in ((0, "x"), (1, "y")):
        inner = found.diffuse[0, axis], expected[0, axis]
        long = (width, height)[axis] == max(height, width)
        cut = edge if long else int(max(height, width) > NETWORK_SIZE)
        kept = slice(cut, -cut or None)
        part = (slice(None), kept) if axis == 0 else (kept, slice(None))
        measured, wanted = (values[part] for values in inner)
        allowed = 1e-4 if long or (height - width) % 2 == 0 else 0.5 * pixel + 1e-4
        assert float((measured - wanted).abs().max()) < allowed, name


@pytest.mark.parametrize(("height", "width"), [(100, 256), (256, 100), (256, 155), (40, 256)])
def test_no_pixel_is_lost_and_the_rest_is_its_mirror_image(height: int, width: int) -> None:
    photo = torch.rand(1, 3, height, width, generator=seeded(1))
    seen: list[Tensor] = []

    def model(square: Tensor) -> tuple[SVBRDF, PointLight]:
        seen.append(square)
        return echo(square)

    found, _ = initialize(model, photo)
    assert torch.equal(found.diffuse, photo)
    margins = [((NETWORK_SIZE - side) // 2, -(-(NETWORK_SIZE - side) // 2)) for side in (height, width)]
    expected = np.pad(photo[0].numpy(), [(0, 0), *margins], mode="symmetric")
    assert np.array_equal(seen[0][0].numpy(), expected)


@pytest.mark.parametrize(("height", "width"), [(32, 32), (64, 48), (512, 512), (768, 1024), (300, 411)])
def test_the_network_sees_its_own_size_whatever_the_photos(height: int, width: int) -> None:
    shapes: list[tuple[int, ...]] = []
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    smooth = 0.5 + 0.3 * torch.sin(5.0 * rows / height) * torch.cos(4.0 * columns / width)
    photo = smooth.expand(1, 3, height, width).contiguous()

    def model(square: Tensor) -> tuple[SVBRDF, PointLight]:
        shapes.append(tuple(square.shape))
        return echo(square)

    found, _ = initialize(model, photo)
    assert shapes == [(1, 3, NETWORK_SIZE, NETWORK_SIZE)]
    assert_close(found.diffuse, photo, atol=0.02, rtol=0.0)  # what two resamplings of a smooth picture cost


@pytest.mark.parametrize("side", [64, 256, 700])
def test_bumpy_normals_stay_unit_vectors_and_maps_in_range(side: int) -> None:
    def model(square: Tensor) -> tuple[SVBRDF, PointLight]:
        return random_svbrdf(1, *square.shape[-2:], tilt=3.0, roughness=(0.001, 1.0)), LIGHT

    initialize(model, torch.rand(1, 3, side, side // 2))[0].validate()


def test_a_model_may_be_an_object_with_predict() -> None:
    class Network:
        def __call__(self, photo: Tensor) -> None:
            raise AssertionError("predict is what is asked for")

        def predict(self, photo: Tensor) -> tuple[SVBRDF, PointLight]:
            return echo(photo)

    photo = torch.rand(1, 3, 40, 64)
    assert torch.equal(initialize(Network(), photo)[0].diffuse, initialize(echo, photo)[0].diffuse)


def test_a_model_that_makes_use_of_a_known_light_is_told() -> None:
    told: list[object] = []

    class Network:
        def predict(self, photo: Tensor) -> tuple[SVBRDF, PointLight]:
            raise AssertionError("what is known is to be told")

        def predict_under(
            self, photo: Tensor, known: PointLight | None = None, camera: Camera | None = None
        ) -> tuple[SVBRDF, PointLight]:
            told.extend([known, camera])
            return echo(photo)

    light, camera = PointLight.at((0.3, 0.1, 2.0)), Camera("collocated")
    initialize(Network(), torch.rand(1, 3, 40, 64), light, camera)
    assert told == [light, camera]


def test_no_gradients_are_kept() -> None:
    weight = torch.ones(1, requires_grad=True)
    found, _ = initialize(lambda photo: with_diffuse(photo * weight), torch.rand(1, 3, 32, 32))
    assert not found.diffuse.requires_grad


def test_legal_mends_what_resampling_breaks_and_nothing_else() -> None:
    material = random_svbrdf(1, 8, 8)
    assert_close(legal(material).channels(), material.channels())
    broken = SVBRDF(
        material.normal * 0.7, material.diffuse * 3, material.roughness * 0, material.specular - 1
    )
    mended = legal(broken).validate()
    assert_close(mended.normal, material.normal)
    assert float(mended.roughness.max()) == pytest.approx(1e-3)


def damaged(name: str, change: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Any]:
    def model(photo: Tensor) -> Any:
        svbrdf, light = echo(photo * 0.0 + 0.5)
        part = light if hasattr(light, name) else svbrdf
        part = replace(part, **{name: change(getattr(part, name).clone())})
        return (part, light) if isinstance(part, SVBRDF) else (svbrdf, part)

    return model


def one_nan(tensor: Tensor) -> Tensor:
    tensor.view(-1)[-1] = float("nan")
    return tensor


WRONG = {
    "nan normal": (damaged("normal", one_nan), "normal holds NaN"),
    "nan diffuse": (damaged("diffuse", one_nan), "diffuse holds NaN"),
    "infinite roughness": (damaged("roughness", lambda t: t / 0.0), "roughness holds NaN or infinity"),
    "zero roughness": (damaged("roughness", lambda t: t * 0.0), r"roughness lies in \[0, 0\]"),
    "8-bit albedo": (damaged("diffuse", lambda t: t * 255.0), "diffuse lies in"),
    "maps in [-1, 1]": (damaged("specular", lambda t: t * 2.0 - 1.0), "specular lies in"),
    "encoded normals": (damaged("normal", lambda t: (t + 1.0) / 2.0), "unit vectors"),
    "normals away": (damaged("normal", lambda t: -t), "face the viewer"),
    "one-channel albedo": (damaged("diffuse", lambda t: t[:, :1]), r"diffuse has shape \(1, 1, 256, 256\)"),
    "rgb roughness": (damaged("roughness", lambda t: t.repeat(1, 3, 1, 1)), "roughness has shape"),
    "maps of several sizes": (damaged("specular", lambda t: t[..., :128]), "specular has shape"),
    "small maps": (lambda photo: (SVBRDF.constant(64, 64), LIGHT), r"\(1, 3, 64, 64\)"),
    "two materials": (lambda photo: (SVBRDF.constant(256, 256, batch=2), LIGHT), r"\(2, 3, 256, 256\)"),
    "nan light": (damaged("position", one_nan), "position"),
    "infinite light": (damaged("intensity", lambda t: t / 0.0), "intensity"),
    "two lights": (damaged("position", lambda t: t.repeat(2, 1)), "position"),
    "no light": (lambda photo: echo(photo)[0], "returned SVBRDF, expected an SVBRDF and a PointLight"),
    "a light alone": (lambda photo: (LIGHT, LIGHT), "expected an SVBRDF and a PointLight"),
    "nothing": (lambda photo: None, "returned NoneType"),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("model", "hint"), WRONG.values(), ids=WRONG)
def test_a_wrong_model_is_told_what_is_wrong(model: Callable[[Tensor], Any], hint: str) -> None:
    with pytest.raises(ValueError, match=hint) as caught:
        initialize(model, torch.rand(1, 3, 48, 64))
    assert str(caught.value).startswith("the model returned")
    assert "\n" not in str(caught.value)
