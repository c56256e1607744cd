"""LSGAN and feature matching: closed forms, who gets gradients, and one game that can be won."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from losses.adversarial import accuracy, discriminator_loss, feature_matching, generator_loss
from nets.discriminator import Discriminator, DiscriminatorConfig, Judgement
from tests.helpers import assert_close, gradcheck, seeded

SIDES = (6, 3)
TINY = DiscriminatorConfig(width=4, layers=1, scales=2)


def said(*logits: float, features: float = 0.0, dtype: torch.dtype = torch.float32) -> list[Judgement]:
    """Return judgements of constant logits and features, one scale per argument."""
    return [
        Judgement(
            tuple(torch.full((2, width, side, side), features, dtype=dtype) for width in (4, 8, 8)),
            torch.full((2, 1, side, side), logit, dtype=dtype),
        )
        for logit, side in zip(logits, SIDES, strict=False)
    ]


def random_logits(seed: int) -> list[Tensor]:
    generator = seeded(seed)
    return [torch.randn(2, 1, side, side, generator=generator, dtype=torch.float64) for side in SIDES]


def judged(*logits: Tensor) -> list[Judgement]:
    return [Judgement((), scale) for scale in logits]


@pytest.mark.parametrize(
    ("real", "fake", "expected"),
    [
        ((1.0, 1.0), (0.0, 0.0), 0.0),
        ((0.5, 0.5), (0.5, 0.5), 0.25),
        ((0.0, 0.0), (1.0, 1.0), 1.0),
        ((3.0, 1.0), (0.0, 0.0), 1.0),  # 0.5 * (4 + 0) on one scale, 0 on the other
        ((1.0,), (2.0,), 2.0),
    ],
)
def test_the_loss_of_a_discriminator(
    real: tuple[float, ...], fake: tuple[float, ...], expected: float
) -> None:
    assert float(discriminator_loss(said(*real), said(*fake))) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("fake", "expected"), [((1.0, 1.0), 0.0), ((0.0, 0.0), 1.0), ((0.5,), 0.25), ((-1.0, 1.0), 2.0)]
)
def test_the_loss_of_a_generator(fake: tuple[float, ...], expected: float) -> None:
    assert float(generator_loss(said(*fake))) == pytest.approx(expected)


def test_scales_weigh_the_same_whatever_their_size() -> None:
    real, fake = random_logits(1), random_logits(2)
    each = [0.5 * (((r - 1.0) ** 2).mean() + (f**2).mean()) for r, f in zip(real, fake, strict=True)]
    assert_close(discriminator_loss(judged(*real), judged(*fake)), (each[0] + each[1]) / 2.0)
    each = [((f - 1.0) ** 2).mean() for f in fake]
    assert_close(generator_loss(judged(*fake)), (each[0] + each[1]) / 2.0)


def test_gradients_are_those_of_finite_differences() -> None:
    real, fake = random_logits(1), random_logits(2)
    gradcheck(lambda r, f: discriminator_loss(judged(r), judged(f)), real[0], fake[0])
    gradcheck(lambda a, b: generator_loss(judged(a, b)), *fake)
    matched = [Judgement((scale,), scale) for scale in real]
    gradcheck(lambda a, b: feature_matching(matched, [Judgement((a,), a), Judgement((b,), b)]), *fake)


def test_feature_matching_is_four_times_the_mean_of_scales_and_layers() -> None:
    real, fake = said(0.0, 0.0, features=0.25), said(1.0, 1.0, features=1.0)
    assert float(feature_matching(real, fake)) == pytest.approx(4.0 * 0.75)
    assert float(feature_matching(real, fake, factor=1.0)) == pytest.approx(0.75)
    one = [Judgement((*fake[0].features[:2], real[0].features[2]), fake[0].logits), real[1]]
    assert float(feature_matching(real, one)) == pytest.approx(4.0 * 0.75 * (2 / 3) / 2)


def test_feature_matching_weighs_as_pix2pixhd() -> None:
    network = Discriminator(TINY)
    real, fake = (network(torch.randn(1, 3, 24, 24), torch.zeros(1, 3, 24, 24)) for _ in range(2))
    expected = torch.zeros(())
    for one, other in zip(real, fake, strict=True):
        for a, b in zip(one.features, other.features, strict=True):
            expected = expected + 4.0 / (TINY.layers + 1) / TINY.scales * (a - b).abs().mean()
    assert_close(feature_matching(real, fake), expected)


def test_feature_matching_leaves_the_truth_alone() -> None:
    real, fake = torch.rand(1, 2, 5, 5, requires_grad=True), torch.rand(1, 2, 5, 5, requires_grad=True)
    feature_matching([Judgement((real,), real[:, :1])], [Judgement((fake,), fake[:, :1])]).backward()
    assert real.grad is None
    assert fake.grad is not None
    assert float(fake.grad.abs().max()) > 0.0


@pytest.mark.parametrize(
    ("real", "fake", "expected"),
    [
        ((0.9, 0.6), (0.1, -3.0), 1.0),
        ((0.9, 0.9), (0.9, 0.9), 0.5),
        ((0.1, 0.2), (0.8, 2.0), 0.0),
        ((0.9, 0.1), (0.1, 0.1), 0.75),
        ((0.5, 0.5), (0.5, 0.5), 0.0),
        ((float("nan"),), (0.0,), 0.5),
    ],
)
def test_accuracy(real: tuple[float, ...], fake: tuple[float, ...], expected: float) -> None:
    logits = [j.logits.requires_grad_() for j in said(*fake)]
    found = accuracy(said(*real), judged(*logits))
    assert float(found) == pytest.approx(expected)
    assert not found.requires_grad


def test_low_precision_logits_are_averaged_in_full() -> None:
    fake = said(0.0, 0.0, features=0.1, dtype=torch.bfloat16)
    real = said(1.0, 1.0, features=0.3, dtype=torch.bfloat16)
    for loss in (discriminator_loss(real, fake), generator_loss(fake), feature_matching(real, fake)):
        assert loss.dtype == torch.float32
    assert float(feature_matching(real, fake)) == pytest.approx(0.8, rel=1e-2)


@pytest.mark.parametrize("function", [discriminator_loss, feature_matching, accuracy])
def test_scales_that_do_not_agree_are_refused(function: object) -> None:
    with pytest.raises(ValueError, match="judgements of 2 and 1 scales"):
        function(said(0.0, 0.0), said(0.0))  # type: ignore[operator]
    with pytest.raises(ValueError, match="at least one"):
        function([], [])  # type: ignore[operator]


def test_no_scale_and_no_feature_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one"):
        generator_loss([])
    with pytest.raises(ValueError, match=r"shapes \[\] and \[\]"):
        feature_matching(judged(*random_logits(1)), judged(*random_logits(2)))


def test_features_of_other_shapes_are_refused() -> None:
    small, large = said(0.0, 0.0), said(0.0, 0.0)[::-1]
    with pytest.raises(ValueError, match=r"\(2, 4, 6, 6\).* and .*\(2, 4, 3, 3\)"):
        feature_matching(small, large)


def test_a_discriminator_learns_to_tell_and_a_generator_to_be_taken_for_real() -> None:
    network = Discriminator(TINY)
    generator = seeded(0)
    condition = torch.zeros(4, 3, 16, 16)
    real = 0.8 * torch.rand(4, 3, 16, 16, generator=generator)
    fake = (-0.8 * torch.rand(4, 3, 16, 16, generator=generator)).requires_grad_()
    optimizer = torch.optim.Adam(network.parameters(), lr=5e-3)
    for _ in range(40):
        optimizer.zero_grad()
        discriminator_loss(network(real, condition), network(fake.detach(), condition)).backward()
        optimizer.step()
    assert float(accuracy(network(real, condition), network(fake, condition))) > 0.95
    before = generator_loss(network(fake, condition))
    (gradient,) = torch.autograd.grad(before, fake)
    moved = fake - 0.3 * gradient / gradient.abs().max()
    assert bool(generator_loss(network(moved, condition)) < before)
