"""Stages of refinement and the recipes made of them: data that can be printed, saved and replayed."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from typing import Any, TypeVar

import torch

from nets.svbrdf import MAPS
from refine.light import LightFit
from refine.parametrization import PARAMETER_COUNTS

LARGEST_SPEEDUP = 6.0
"""Most that rates are raised when a recipe is asked for fewer iterations than its own."""


@dataclass(frozen=True)
class Rates:
    """Adam's learning rate of each map's parameters, see `refine.parametrization`; 0 keeps a map as it is."""

    normal: float = 0.0
    diffuse: float = 0.0
    roughness: float = 0.0
    specular: float = 0.0

    def scaled(self, factor: float) -> Rates:
        """Return all rates times a factor."""
        return Rates(*(getattr(self, name) * factor for name in MAPS))

    def moving(self) -> dict[str, float]:
        """Return the rates that are not zero, by map name."""
        return {name: rate for name in MAPS if (rate := getattr(self, name)) > 0.0}


Descent = TypeVar("Descent", bound="_Descent")


@dataclass(frozen=True)
class _Descent:
    """What stages of Adam steps have in common."""

    iterations: int
    rates: Rates

    @property
    def moves(self) -> bool:
        """Whether any map moves."""
        return bool(self.rates.moving())

    def scaled(self: Descent, iterations: int, pace: float) -> Descent:
        """Return this stage with other iterations, and rates times a pace."""
        return replace(self, iterations=iterations, rates=self.rates.scaled(pace))


@dataclass(frozen=True)
class GlobalStage(_Descent):
    """Move some maps as a whole: every pixel by the gradient averaged over all pixels (paper Sec. 6.1)."""

    iterations: int = 40
    rates: Rates = Rates(roughness=0.005, specular=0.005)

    @property
    def name(self) -> str:
        """How logs and files call this stage."""
        return "global"

    def offsets(self, height: int, width: int) -> dict[str, torch.Tensor]:
        """Return the zero offsets that this stage optimises: one per channel."""
        return {name: torch.zeros(1, PARAMETER_COUNTS[name], 1, 1) for name in self.rates.moving()}


@dataclass(frozen=True)
class PixelStage(_Descent):
    """Move some maps pixel by pixel."""

    iterations: int = 260
    rates: Rates = Rates(normal=0.0015, diffuse=0.01, roughness=0.0006, specular=0.006)

    @property
    def name(self) -> str:
        """How logs and files call this stage."""
        return "per-pixel"

    def offsets(self, height: int, width: int) -> dict[str, torch.Tensor]:
        """Return the zero offsets that this stage optimises: one per channel and pixel."""
        return {name: torch.zeros(1, PARAMETER_COUNTS[name], height, width) for name in self.rates.moving()}


@dataclass(frozen=True)
class Widths:
    """Standard deviation of a prior on each map's parameters, see `refine.parametrization`; 0 keeps a map."""

    normal: float = 0.0
    diffuse: float = 0.0
    roughness: float = 0.0
    specular: float = 0.0

    def moving(self) -> dict[str, float]:
        """Return the widths that are not zero, by map name."""
        return {name: width for name in MAPS if (width := getattr(self, name)) > 0.0}


@dataclass(frozen=True)
class PosteriorStage:
    """Find every pixel's most probable parameters by damped Gauss-Newton, see `refine.engine.gauss_newton`.

    Attributes:
        iterations: steps; it has converged after a handful.
        widths: of the prior around what the stage before it left.
        noise: standard deviation of the logarithm of radiance that the maps do not explain.
        huber: residuals beyond this many deviations count linearly.
    """

    iterations: int = 6
    widths: Widths = Widths(normal=0.12, diffuse=0.2, roughness=0.1, specular=0.14)
    noise: float = 0.03
    huber: float = 3.0

    @property
    def name(self) -> str:
        """How logs and files call this stage."""
        return "posterior"

    @property
    def moves(self) -> bool:
        """Whether any map moves."""
        return bool(self.widths.moving())

    def scaled(self, iterations: int, pace: float) -> PosteriorStage:
        """Return this stage with other iterations; a solver that has converged does not go faster."""
        return replace(self, iterations=iterations)


@dataclass(frozen=True)
class LatentStage:
    """Move the latent code of an auto-encoder of materials, see `refine.latent` (Gao et al. 2019).

    Attributes:
        iterations: Adam steps.
        rate: Adam's learning rate.
        beta1: Adam's.
        checkpoint: the auto-encoder: a shipped name, or a file.
    """

    iterations: int = 4000
    rate: float = 1e-3
    beta1: float = 0.5
    checkpoint: str = "gao19"

    @property
    def name(self) -> str:
        """How logs and files call this stage."""
        return "latent"

    @property
    def moves(self) -> bool:
        """Whether any map moves: all do."""
        return True

    def scaled(self, iterations: int, pace: float) -> LatentStage:
        """Return this stage with other iterations, and the rate times a pace."""
        return replace(self, iterations=iterations, rate=self.rate * pace)


Stage = GlobalStage | PixelStage | PosteriorStage | LatentStage


@dataclass(frozen=True)
class Recipe:
    """A named sequence of stages.

    Attributes:
        name: how it is asked for.
        light_fit: how an unknown light is found; None takes the network's word.
        stages: in order.
    """

    name: str
    light_fit: LightFit | None = field(default_factory=LightFit)
    stages: tuple[Stage, ...] = ()

    @property
    def iterations(self) -> int:
        """Steps of all stages together."""
        return sum(stage.iterations for stage in self.stages)

    def with_iterations(self, total: int) -> Recipe:
        """Return this recipe with its stages scaled so that they take `total` steps together.

        Rates are scaled the other way, up to `LARGEST_SPEEDUP`: fewer steps go as far with longer ones, and
        more steps follow the same path more finely instead of drifting on. Posterior stages, which have
        converged, keep their steps, but leave half of the total to the others.
        """
        if total < 0:
            raise ValueError(f"iterations must be 0 or more, got {total}")
        solving = [isinstance(stage, PosteriorStage) for stage in self.stages]
        counts = [stage.iterations for stage in self.stages]
        solvers = sum(count for count, solves in zip(counts, solving, strict=True) if solves)
        descents = self.iterations - solvers
        kept = min(solvers, total // 2) if descents else total
        pace = min(LARGEST_SPEEDUP, descents / max(1, total - kept))
        shares = {
            kind: _spread([c for c, solves in zip(counts, solving, strict=True) if solves is kind], whole)
            for kind, whole in ((True, kept), (False, total - kept))
        }
        stages = tuple(
            stage.scaled(shares[solves].pop(0), pace)
            for stage, solves in zip(self.stages, solving, strict=True)
        )
        return replace(self, stages=stages)

    def as_dict(self) -> dict[str, Any]:
        """Return plain data, stage names included, for the result's JSON."""
        return {
            "name": self.name,
            "light_fit": asdict(self.light_fit) if self.light_fit else None,
            "stages": [{"stage": stage.name, **asdict(stage)} for stage in self.stages],
        }


LONG_GLOBAL = GlobalStage(160, Rates(diffuse=0.02, specular=0.02))
"""Of the `default` recipe: the diffuse takes part, or its error would be left to the specular. Roughness does
not: one photo tells it from specular badly, and as a whole it moves away from the truth as often as not."""

MANY_PHOTOS = PosteriorStage(20, Widths(normal=0.14, diffuse=0.2, roughness=0.17, specular=0.14))
"""Of the recipe `several`: more photos do tell roughness, so its prior is as wide as errors were measured,
and the way down is longer."""

GAO_PIXELS = PixelStage(iterations=200)
"""Of the recipe `gao+`: Gao19's 200 steps, at the rates of Ours+."""

RECIPES: dict[str, Recipe] = {
    "default": Recipe("default", stages=(LONG_GLOBAL, PosteriorStage())),
    "paper": Recipe("paper", stages=(GlobalStage(), PixelStage())),
    "several": Recipe("several", stages=(LONG_GLOBAL, MANY_PHOTOS)),
    "fast": Recipe("fast", light_fit=LightFit(evaluations=0), stages=(PosteriorStage(iterations=3),)),
    "gao": Recipe("gao", stages=(LatentStage(),)),
    "gao+": Recipe("gao+", stages=(LatentStage(), GAO_PIXELS)),
}
"""By name. `default` is the best there is for one photo, and `several` takes its place for more. `paper` is
Ours+ of Table 1: global roughness and specular, then every map per pixel. `fast` believes the network's
direction of the light and takes three steps: real time. `gao` and `gao+` are Gao19 and Gao19+ of Table 1;
they start from `des19`."""


def find_recipe(name: str) -> Recipe:
    """Return a recipe by name.

    Raises:
        ValueError: naming the known ones.
    """
    if name not in RECIPES:
        raise ValueError(f"no recipe is called {name!r}; the known ones are {', '.join(sorted(RECIPES))}")
    return RECIPES[name]


def _spread(counts: list[int], total: int) -> list[int]:
    """Return counts in the same proportions that add up to a total."""
    ends = [0]
    for count in counts:
        ends.append(ends[-1] + count)
    marks = [round(end * total / max(1, ends[-1])) for end in ends]
    return [after - before for before, after in pairwise(marks)]
