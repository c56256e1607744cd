"""Free parameters: every number is a legal material, and legal materials come back."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional

from nets.svbrdf import CHANNELS, MAPS, SVBRDF
from refine.parametrization import (
    ALBEDO_RANGE,
    LOGIT_MARGIN,
    MAX_SLOPE,
    ROUGHNESS_RANGE,
    SLOPE_SCALE,
    Parameters,
)
from tests.helpers import assert_close, gradcheck, random_svbrdf, seeded

CHANNELS_OF_PARAMETERS = {**CHANNELS, "normal": 2}


def parameters(value: float, height: int = 2, width: int = 3) -> Parameters:
    return Parameters(*(torch.full((1, CHANNELS_OF_PARAMETERS[name], height, width), value) for name in MAPS))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("seed", range(3))
def test_materials_come_back(dtype: torch.dtype, seed: int) -> None:
    material = random_svbrdf(2, tilt=3.0, seed=seed, dtype=dtype)
    back = Parameters.from_svbrdf(material).svbrdf().validate()
    assert_close(back.channels(), material.channels())


def test_parameters_come_back() -> None:
    generator = seeded(0)
    start = Parameters(
        *(torch.randn(1, c, 3, 4, generator=generator).double() for c in CHANNELS_OF_PARAMETERS.values())
    )
    back = Parameters.from_svbrdf(start.svbrdf())
    for name in MAPS:
        assert_close(getattr(back, name), getattr(start, name))


@settings(max_examples=60)
@given(values=st.lists(st.floats(-1e4, 1e4), min_size=9, max_size=9))
def test_any_parameters_are_a_legal_material(values: list[float]) -> None:
    numbers = torch.tensor(values)[None, :, None, None]
    material = Parameters(*torch.split(numbers, list(CHANNELS_OF_PARAMETERS.values()), dim=1)).svbrdf()
    material.validate()
    assert float(material.roughness.min()) >= ROUGHNESS_RANGE[0] * (1 - 1e-6)


def test_zero_is_the_middle() -> None:
    material = parameters(0.0).svbrdf()
    assert_close(material.normal, SVBRDF.constant(2, 3).normal)
    for name in ("diffuse", "specular"):
        assert_close(getattr(material, name), torch.full((1, 3, 2, 3), sum(ALBEDO_RANGE) / 2))
    assert_close(material.roughness, torch.full((1, 1, 2, 3), sum(ROUGHNESS_RANGE) / 2))


def test_normal_parameters_are_slopes() -> None:
    normal = parameters(1.0).svbrdf().normal
    assert_close(normal[:, :2] / normal[:, 2:], torch.full((1, 2, 2, 3), SLOPE_SCALE))


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_the_ends_of_ranges_stay_near_and_keep_a_gradient(value: float) -> None:
    extreme = SVBRDF.constant(2, 2, diffuse=value, roughness=max(value, 1e-3), specular=value)
    start = Parameters.from_svbrdf(extreme)
    raw = [getattr(start, name).requires_grad_(True) for name in MAPS]
    material = Parameters(*raw).svbrdf().validate()
    assert_close(material.diffuse, extreme.diffuse, atol=1.01 * LOGIT_MARGIN)
    assert_close(material.specular, extreme.specular, atol=1.01 * LOGIT_MARGIN)
    assert_close(material.roughness, extreme.roughness.clamp(*ROUGHNESS_RANGE), atol=1.01 * LOGIT_MARGIN)
    material.channels().sum().backward()
    for tensor in raw[1:]:
        assert tensor.grad is not None
        assert float(tensor.grad.abs().min()) > 1e-3


@pytest.mark.parametrize("z", [0.0, 1e-6, 0.05])
def test_grazing_normals_are_raised_to_the_largest_slope(z: float) -> None:
    flat = SVBRDF.constant(1, 1)
    grazing = replace(flat, normal=torch.tensor([(1.0 - z * z) ** 0.5, 0.0, z])[None, :, None, None])
    normal = Parameters.from_svbrdf(grazing).svbrdf().validate().normal.flatten()
    assert float(normal[0] / normal[2]) == pytest.approx(MAX_SLOPE, rel=1e-5)


def test_shared_offsets_move_all_pixels_and_others_one() -> None:
    start = Parameters.from_svbrdf(random_svbrdf(1, 2, 3))
    pixels = torch.zeros(1, 3, 2, 3)
    pixels[0, 1, 1, 2] = 0.7
    moved = start.shifted({"roughness": torch.full((1, 1, 1, 1), 0.3), "diffuse": pixels})
    assert_close(moved.roughness, start.roughness + 0.3)
    assert int((moved.diffuse != start.diffuse).sum()) == 1
    assert moved.normal is start.normal
    assert moved.specular is start.specular


def test_a_shared_offset_has_the_summed_gradient() -> None:
    start = Parameters.from_svbrdf(random_svbrdf(1, 3, 4))
    shared = torch.zeros(1, 1, 1, 1, requires_grad=True)
    own = torch.zeros(1, 1, 3, 4, requires_grad=True)
    for offset in (shared, own):
        (start.shifted({"roughness": offset}).svbrdf().roughness ** 2).sum().backward()
    assert shared.grad is not None
    assert own.grad is not None
    assert_close(shared.grad.squeeze(), own.grad.sum())


def test_gradients() -> None:
    start = Parameters.from_svbrdf(random_svbrdf(1, 1, 2, dtype=torch.float64))
    weights = torch.randn(1, 10, 1, 2, generator=seeded(1), dtype=torch.float64)

    def weighted(*raw: Tensor) -> Tensor:
        return Parameters(*raw).svbrdf().channels() * weights

    gradcheck(weighted, *(getattr(start, name) for name in MAPS))


def test_round_trip_gradients_are_the_identitys() -> None:
    material = random_svbrdf(1, 1, 2, dtype=torch.float64)
    diffuse = material.diffuse.requires_grad_(True)
    normal = material.normal.requires_grad_(True)
    back = Parameters.from_svbrdf(SVBRDF(normal, diffuse, material.roughness, material.specular)).svbrdf()
    weights = torch.rand(diffuse.shape, generator=seeded(2), dtype=torch.float64)
    (found,) = torch.autograd.grad((back.diffuse * weights).sum(), diffuse)
    assert_close(found, weights)
    (found,) = torch.autograd.grad((back.normal * weights).sum(), normal)
    (expected,) = torch.autograd.grad((functional.normalize(normal, dim=1) * weights).sum(), normal)
    # Both are normalisations, along z and along the vector: they agree on the sphere's tangents.
    tangent = (
        torch.eye(3, dtype=torch.float64)[:, :, None, None] - normal[0].detach() * normal[0].detach()[:, None]
    )
    assert_close(torch.einsum("ijhw,bjhw->bihw", tangent, found), expected, atol=1e-9)
