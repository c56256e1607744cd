"""The material: shapes, selection, stacking, and a `validate` that names what is wrong."""

from __future__ import annotations

from dataclasses import replace

import jaxtyping
import pytest
import torch
from torch import Tensor

from nets.svbrdf import CHANNELS, MAPS, SVBRDF
from tests.helpers import assert_close, random_svbrdf


def test_maps_stand_in_the_papers_order_and_have_ten_channels() -> None:
    assert MAPS == ("normal", "diffuse", "roughness", "specular")
    assert [CHANNELS[name] for name in MAPS] == [3, 3, 1, 3]


def test_a_constant_material_is_flat_and_legal() -> None:
    material = SVBRDF.constant(2, 3, diffuse=0.2, roughness=0.3, specular=0.4, batch=2).validate()
    assert material.size == (2, 3)
    assert material.batch == 2
    for name, value in {"diffuse": 0.2, "roughness": 0.3, "specular": 0.4}.items():
        assert_close(getattr(material, name), torch.full((2, CHANNELS[name], 2, 3), value))
    assert_close(material.normal[1, :, 1, 2], torch.tensor([0.0, 0.0, 1.0]))


def test_channels_and_back() -> None:
    material = random_svbrdf(2)
    stacked = material.channels()
    assert stacked.shape == (2, 10, 5, 7)
    assert torch.equal(stacked[:, 6:7], material.roughness)
    back = SVBRDF.from_channels(stacked)
    assert all(torch.equal(getattr(back, name), getattr(material, name)) for name in MAPS)


@pytest.mark.parametrize(
    ("index", "kept"),
    [(0, [0]), (2, [2]), (-1, [2]), (-2, [1]), (slice(1, 3), [1, 2]), (torch.tensor([2, 0]), [2, 0])],
)
def test_selection_keeps_the_batch_axis(index: int | slice | Tensor, kept: list[int]) -> None:
    material = random_svbrdf(3)
    for name in MAPS:
        assert torch.equal(getattr(material[index], name), getattr(material, name)[kept])


def test_cat_undoes_selection() -> None:
    material = random_svbrdf(3)
    assert torch.equal(SVBRDF.cat([material[i] for i in range(3)]).channels(), material.channels())


def test_cast_and_detach() -> None:
    material = random_svbrdf().map(lambda tensor: tensor.requires_grad_(True))
    assert material.channels().requires_grad
    assert not material.detach().channels().requires_grad
    assert material.to(torch.float64).channels().dtype == torch.float64


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_random_legal_materials_pass_in_any_precision(dtype: torch.dtype) -> None:
    random_svbrdf(2, tilt=5.0).to(dtype).validate()


def test_validation_is_silent_about_gradients() -> None:
    material = random_svbrdf().map(lambda tensor: tensor.requires_grad_(True))
    assert material.validate() is material  # a warning would fail the suite


ILLEGAL = [
    ("normal", lambda n: n * 1.01, "normals must be unit vectors"),
    ("normal", lambda n: n * 0.0, "normals must be unit vectors"),
    ("normal", lambda n: -n, "normals must face the viewer"),
    ("normal", lambda n: n * float("nan"), "normal holds NaN or infinity"),
    ("diffuse", lambda d: d - 1.0, r"diffuse lies in \[-0.9"),
    ("diffuse", lambda d: d + 0.5, r"diffuse lies in .*, expected \[0, 1\]"),
    ("diffuse", lambda d: d / 0.0, "diffuse holds NaN or infinity"),
    ("roughness", lambda r: r * 0.0, r"roughness lies in \[0, 0\], expected \(0, 1\]"),
    ("roughness", lambda r: r + 1.0, r"expected \(0, 1\]"),
    ("specular", lambda s: s * 3.0, r"specular lies in .*, expected \[0, 1\]"),
]


@pytest.mark.parametrize(("name", "spoil", "message"), ILLEGAL)
def test_illegal_values_are_named(name: str, spoil, message: str) -> None:  # type: ignore[no-untyped-def]
    material = random_svbrdf()
    with pytest.raises(ValueError, match=message):
        replace(material, **{name: spoil(getattr(material, name))}).validate()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("name", "shape"), [("roughness", (1, 3, 5, 7)), ("diffuse", (1, 3, 5, 8)), ("specular", (2, 3, 5, 7))]
)
def test_illegal_shapes_are_named(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(
        ValueError, match=rf"{name} has shape \({shape[0]}, {shape[1]}, 5, {shape[3]}\), expected"
    ):
        replace(random_svbrdf(), **{name: torch.full(shape, 0.5)}).validate()


def test_the_suite_checks_shapes_at_run_time() -> None:
    material = random_svbrdf()
    with pytest.raises(jaxtyping.TypeCheckError):
        replace(material, roughness=material.diffuse)
    with pytest.raises(jaxtyping.TypeCheckError):
        SVBRDF.from_channels(material.diffuse)
