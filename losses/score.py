"""How parts of an objective are added up, and what critics are told: the bookkeeping of Eq. 2 to 4."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from losses.adversarial import accuracy, discriminator_loss, feature_matching, generator_loss
from nets.discriminator import Discriminator, DiscriminatorConfig, Judgement
from nets.training import Losses, Terms

GAIN_RANGE = (0.25, 4.0)
"""Exposure of a real photo against our rendering is corrected by no more than this."""

Perceptual = Callable[[Tensor, Tensor], Tensor]
"""Distance of two batches of gamma-encoded images in [0, 1]."""


@dataclass(frozen=True)
class TermWeights:
    """Weights within Eq. 2 (a map), Eq. 3 (a rendering) or Eq. 4 (a rendering of a real pair).

    Attributes:
        adversarial: of the LSGAN term, 1 in all three.
        feature: lambda_1, of feature matching.
        l1: lambda_2, of the L1 distance.
        perceptual: lambda_3, of the VGG distance.
        l2: of the mean squared distance, beside the L1; 0 in the paper. L1 is smallest at the median, which
            for normals is flat wherever the photo leaves doubt; squares are smallest at the mean.
    """

    adversarial: float = 1.0
    feature: float = 10.0
    l1: float = 10.0
    perceptual: float = 0.0
    l2: float = 0.0

    @property
    def need_critic(self) -> bool:
        """Whether any weighed term comes from a critic."""
        return bool(self.adversarial or self.feature)


class Score:
    """Adds up what both players are told, and keeps the parts."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self.generator: list[Tensor] = []
        self.critics: list[Tensor] = []
        self.terms: Terms = {}

    def add(self, name: str, weight: float, term: Float[Tensor, ""]) -> None:
        """Add a term to the generator's loss."""
        self.terms[name] = term
        self.generator.append(weight * term)

    def measure(self, name: str, difference: Tensor, weights: TermWeights, factor: float = 1.0) -> None:
        """Add the L1 distance and, if it has a weight, the mean square of a difference."""
        self.add(name, factor * weights.l1, difference.abs().mean())
        if weights.l2:
            self.add(f"{name} squared", factor * weights.l2, difference.square().mean())

    def judge(
        self,
        name: str,
        critics: nn.ModuleDict,
        condition: Tensor,
        estimate: Tensor,
        truth: Tensor,
        weights: TermWeights,
        factor: float = 1.0,
    ) -> None:
        """Let a critic see estimate and truth: the adversarial and feature terms, and its own loss.

        The estimate is not detached from the critic's loss: `nets.trainer` takes each player's gradient with
        respect to its own weights only, and so one pass through the critic serves both. Without weights
        there is no critic.
        """
        if not weights.need_critic:
            return
        both = critics[name](torch.cat([truth, estimate]), torch.cat([condition, condition]))
        real, fake = _halves(both)
        self.add(f"{name} adversarial", factor * weights.adversarial, generator_loss(fake))
        self.add(f"{name} features", factor * weights.feature, feature_matching(real, fake))
        self.critics.append(discriminator_loss(real, fake))
        self.terms[f"{name} accuracy"] = accuracy(real, fake)

    def perceive(
        self,
        name: str,
        perceptual: Perceptual | None,
        estimate: Tensor,
        truth: Tensor,
        weights: TermWeights,
        factor: float = 1.0,
    ) -> None:
        """Add the VGG distance, if it has a weight.

        Raises:
            ValueError: it has one, but no VGG was given.
        """
        if not weights.perceptual:
            return
        if perceptual is None:
            raise ValueError("the objective weighs a VGG distance; give it the VGG or the weight 0")
        self.add(f"{name} perceptual", factor * weights.perceptual, perceptual(estimate, truth))

    def losses(self) -> Losses:
        """Return the sums; none for critics where there are none."""
        critics = torch.stack(self.critics).sum() if self.critics else None
        return Losses(torch.stack(self.generator).sum(), self.terms, critics)


def exposure_gain(
    rendering: Float[Tensor, "b 3 h w"], photo: Float[Tensor, "b 3 h w"]
) -> Float[Tensor, "b 1 1 1"]:
    """Return the factor that brings each rendering closest to its photo, where the photo is not clipped."""
    known = (photo < 1.0).to(photo)
    fit = (known * rendering * photo).sum(dim=(1, 2, 3)) / (known * rendering.square()).sum(
        dim=(1, 2, 3)
    ).clamp(min=1e-6)
    return fit.clamp(*GAIN_RANGE)[:, None, None, None]


def build_critics(judged: Mapping[str, int], **shape: int) -> nn.ModuleDict:
    """Build an untrained critic for each thing that is judged; `shape` is width, layers, scales."""
    return nn.ModuleDict(
        {
            name: Discriminator(DiscriminatorConfig(channels=channels, **shape))
            for name, channels in judged.items()
        }
    )


def random_window(side: int, like: Tensor, generator: torch.Generator) -> Callable[[Tensor], Tensor]:
    """Return a function that cuts the same random square out of every image of the size of `like`.

    Critics judge patches and VGG sees neighbourhoods: a part of the picture costs less and says as much. A
    side of 0, or one not smaller than the picture, cuts nothing.
    """
    height, width = like.shape[-2:]
    if not 0 < side < min(height, width):
        return lambda image: image
    top = int(torch.randint(height - side + 1, (1,), generator=generator))
    left = int(torch.randint(width - side + 1, (1,), generator=generator))
    return lambda image: image[..., top : top + side, left : left + side]


def _halves(judgements: Sequence[Judgement]) -> tuple[list[Judgement], list[Judgement]]:
    # The first half of the batch is the truth, the second the estimate.
    halves: tuple[list[Judgement], list[Judgement]] = ([], [])
    for judgement in judgements:
        logits = judgement.logits.chunk(2)
        features = [feature.chunk(2) for feature in judgement.features]
        for side, half in enumerate(halves):
            half.append(Judgement(tuple(pair[side] for pair in features), logits[side]))
    return halves
