"""Adversarial terms: LSGAN and feature matching on what `nets.discriminator` says (paper, Eq. 2 to 4).

Pure functions of judgements, equal weight for every scale. Who is judged, next to what, and how the terms
are weighted against others is said in `objective.py`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nets.discriminator import Judgement

REAL = 1.0
"""What a discriminator is to say of truth (LSGAN's b and c)."""

FAKE = 0.0
"""What it is to say of an estimate (LSGAN's a)."""

DISCRIMINATOR_FACTOR = 0.5
"""Halves a discriminator's loss, as LSGAN and pix2pixHD do; the generator's keeps its full size."""

FEATURE_FACTOR = 4.0
"""Times the mean over layers: pix2pixHD weighs each by 4 / (layers + 1), and there are layers + 1 of them."""


def discriminator_loss(real: Sequence[Judgement], fake: Sequence[Judgement]) -> Float[Tensor, ""]:
    """Return what a discriminator minimises: the least squares of Mao et al. 2017, Eq. 9.

    `mean over scales of 0.5 (mean((D(real) - 1)^2) + mean(D(fake)^2))`. pix2pixHD sums over scales instead:
    with S scales its value is S times this one.

    Args:
        real: judgements of the truth, one per scale.
        fake: judgements of the estimate. Nothing is detached here: detach it, or take the gradient by the
            discriminator's weights only, as `nets.trainer` does.

    Returns:
        The loss, >= 0; 0.25 if every logit is 1/2. float32 at least, whatever the logits are.

    Raises:
        ValueError: if there is no scale, or not as many in both.
    """
    _check_scales(real, fake)
    parts = [
        _square_error(one.logits, REAL) + _square_error(other.logits, FAKE)
        for one, other in zip(real, fake, strict=True)
    ]
    return DISCRIMINATOR_FACTOR * torch.stack(parts).mean()


def generator_loss(fake: Sequence[Judgement]) -> Float[Tensor, ""]:
    """Return L_adv, what a generator minimises to be taken for real: Mao et al. 2017, Eq. 9.

    `mean over scales of mean((D(fake) - 1)^2)`: without LSGAN's half, as in pix2pixHD, which sums over
    scales: with S scales its value is S times this one.

    Args:
        fake: judgements of the estimate, one per scale; gradients flow through them.

    Returns:
        The loss, >= 0; 1 if every logit is 0, 0.25 if every logit is 1/2.

    Raises:
        ValueError: if there is no scale.
    """
    _check_scales(fake, fake)
    return torch.stack([_square_error(judgement.logits, REAL) for judgement in fake]).mean()


def feature_matching(
    real: Sequence[Judgement], fake: Sequence[Judgement], factor: float = FEATURE_FACTOR
) -> Float[Tensor, ""]:
    """Return L_feat: how far an estimate's features are from those of the truth (Wang et al. 2018, Eq. 4).

    `factor x mean over scales of mean over layers of mean |D_l(real) - D_l(fake)|`. With the default factor
    this is pix2pixHD's code: there each of `layers + 1` features (all but the logits) weighs
    `4 / (layers + 1)`, and each scale `1 / scales`.

    Args:
        real: judgements of the truth, one per scale; detached here, so the truth is a constant.
        fake: judgements of the estimate next to the same photo; gradients flow through them.
        factor: times the means; `lambda_1` of Eq. 2 and 3 comes on top.

    Returns:
        The loss, >= 0, 0 for equal features.

    Raises:
        ValueError: quoting what differs, if there is no scale or no feature, or scales, layers or shapes do
            not agree.
    """
    _check_scales(real, fake)
    scales = []
    for one, other in zip(real, fake, strict=True):
        shapes, others = ([tuple(feature.shape) for feature in j.features] for j in (one, other))
        if shapes != others or not shapes:
            raise ValueError(f"features to match have shapes {shapes} and {others}")
        pairs = zip(one.features, other.features, strict=True)
        layers = [(_full(b) - _full(a.detach())).abs().mean() for a, b in pairs]
        scales.append(torch.stack(layers).mean())
    return factor * torch.stack(scales).mean()


@torch.no_grad()
def accuracy(real: Sequence[Judgement], fake: Sequence[Judgement]) -> Float[Tensor, ""]:
    """Return the share of patches that a discriminator puts on their side of 1/2. To log, not to minimise.

    Equal weights for scales, and for real and fake: a discriminator that always says the same has 0.5.

    Args:
        real: judgements of the truth, one per scale.
        fake: judgements of the estimate.

    Returns:
        The share, in [0, 1], without gradient. A logit of exactly 1/2 or NaN is on neither side.

    Raises:
        ValueError: if there is no scale, or not as many in both.
    """
    _check_scales(real, fake)
    middle = (REAL + FAKE) / 2.0
    right = [judgement.logits > middle for judgement in real] + [j.logits < middle for j in fake]
    return torch.stack([sides.float().mean() for sides in right]).mean()


def _square_error(logits: Tensor, target: float) -> Tensor:
    return (_full(logits) - target).square().mean()


def _full(x: Tensor) -> Tensor:
    # Under autocast logits are bfloat16, in which a mean over thousands of patches has two digits.
    return x.to(torch.promote_types(x.dtype, torch.float32))


def _check_scales(real: Sequence[Judgement], fake: Sequence[Judgement]) -> None:
    if len(real) != len(fake) or not real:
        raise ValueError(f"judgements of {len(real)} and {len(fake)} scales, expected as many, at least one")
