"""Widths of the prior: of known errors, and by the command."""

from __future__ import annotations

import torch

from eval.prior import split, width
from tests.helpers import seeded


def test_the_width_of_a_normal_distribution_is_its_deviation_whatever_a_few_pixels_do() -> None:
    errors = 0.3 * torch.randn(2, 9, 64, 64, generator=seeded(0))
    assert abs(width(errors) - 0.3) < 0.01
    errors[:, :, :4] = 100.0
    assert abs(width(errors) - 0.3) < 0.03


def test_what_a_neighbourhood_shares_is_coarse_and_the_rest_fine() -> None:
    noise = 0.1 * torch.randn(1, 9, 96, 96, generator=seeded(1))
    fine, coarse = split(noise + 2.0)
    assert abs(width(fine) - 0.1) < 0.01
    torch.testing.assert_close(coarse, torch.full_like(coarse, 2.0), atol=0.05, rtol=0.0)
    torch.testing.assert_close(fine + coarse, noise + 2.0)
