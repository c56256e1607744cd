"""Transfer curves: values, inverses, and finite slopes at black."""

from __future__ import annotations

import pytest
import torch

from nets.color import (
    gamma_decode,
    gamma_encode,
    linear_to_srgb,
    luminance,
    srgb_to_linear,
    to_network_input,
)
from tests.helpers import assert_close, gradcheck, seeded

SRGB_VALUES = [(0.0, 0.0), (0.02, 0.02 / 12.92), (0.5, 0.21404), (0.735357, 0.5), (1.0, 1.0)]
"""Encoded value, linear value (IEC 61966-2-1)."""


@pytest.mark.parametrize(("encoded", "linear"), SRGB_VALUES)
def test_srgb_has_the_standards_values(encoded: float, linear: float) -> None:
    assert_close(srgb_to_linear(torch.full((3, 2, 2), encoded)), torch.full((3, 2, 2), linear))
    assert_close(linear_to_srgb(torch.full((3, 2, 2), linear)), torch.full((3, 2, 2), encoded), atol=2e-5)


@pytest.mark.parametrize(
    ("encode", "decode"), [(linear_to_srgb, srgb_to_linear), (gamma_encode, gamma_decode)]
)
@pytest.mark.parametrize("shape", [(3, 4, 5), (2, 3, 4, 5)])
def test_curves_invert_each_other(encode, decode, shape: tuple[int, ...]) -> None:  # type: ignore[no-untyped-def]
    image = torch.rand(shape, generator=seeded(1), dtype=torch.float64)
    assert_close(decode(encode(image)), image, atol=2e-6)
    assert_close(encode(decode(image)), image, atol=2e-3 if encode is gamma_encode else 1e-6)


def test_gamma_is_a_plain_power_of_clamped_light() -> None:
    linear = torch.tensor([-1.0, 0.0, 0.25, 1.0, 7.0])
    expected = torch.tensor([0.0, 0.0, 0.25 ** (1 / 2.2), 1.0, 1.0])
    assert_close(gamma_encode(linear), expected, atol=0.5 / 255)  # below the floor: less than half a step
    assert float(gamma_encode(linear)[2]) == pytest.approx(0.5325, abs=1e-4)


def test_gamma_has_a_finite_slope_at_black() -> None:
    black = torch.zeros(4, requires_grad=True)
    gamma_encode(black).sum().backward()
    assert black.grad is not None
    assert bool(torch.isfinite(black.grad).all())


def test_gamma_gradients() -> None:
    gradcheck(gamma_encode, 0.05 + 0.9 * torch.rand(7, generator=seeded(0), dtype=torch.float64))


def test_network_input_spans_minus_one_to_one() -> None:
    photo = torch.tensor([0.0, 0.5**2.2, 1.0, 3.0])[None, None, None].expand(1, 3, 1, 4)
    assert_close(to_network_input(photo)[0, 0, 0], torch.tensor([-1.0, 0.0, 1.0, 1.0]), atol=4e-3)


def test_luminance_weighs_as_rec_709() -> None:
    primaries = torch.eye(3).reshape(3, 3, 1, 1)
    assert_close(luminance(primaries).flatten(), torch.tensor([0.2126, 0.7152, 0.0722]))
    assert_close(luminance(torch.ones(3, 2, 2)), torch.ones(1, 2, 2))
