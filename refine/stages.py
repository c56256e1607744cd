"""Stages of refinement and the recipes made of them: data that can be printed, saved and replayed."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch

from nets.svbrdf import CHANNELS, MAPS
from refine.light import LightFit

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


@dataclass(frozen=True)
class GlobalStage:
    """Move some maps as a whole: every pixel by the gradient averaged over all pixels (paper Sec. 6.1)."""

    iterations: int = 40
    rates: Rates = Rates(roughness=0.005, specular=0.005)

    @property
    def name(self) -> str:
        """How logs and files call this stage."""
        return "global"

    def offsets(self, height: int, width: int) -> dict[str, torch.Tensor]:
        """Return the zero offsets that this stage optimises: one per channel."""
        return {name: torch.zeros(1, _parameters(name), 1, 1) for name in self.rates.moving()}


@dataclass(frozen=True)
class PixelStage:
    """Move some maps pixel by pixel."""

    iterations: int = 260
    rates: Rates = Rates(normal=0.0015, diffuse=0.01, roughness=0.0006, specular=0.006)

    @property
    def name(self) -> str:
        """How logs and files call this stage."""
        return "per-pixel"

    def offsets(self, height: int, width: int) -> dict[str, torch.Tensor]:
        """Return the zero offsets that this stage optimises: one per channel and pixel."""
        return {name: torch.zeros(1, _parameters(name), height, width) for name in self.rates.moving()}


Stage = GlobalStage | PixelStage


@dataclass(frozen=True)
class Recipe:
    """A named sequence of stages.

    Attributes:
        name: how it is asked for.
        light_fit: how an unknown light is found; None takes the light head's word.
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
        more steps follow the same path more finely instead of drifting on.
        """
        if total < 0:
            raise ValueError(f"iterations must be 0 or more, got {total}")
        ends = [0]
        for stage in self.stages:
            ends.append(ends[-1] + stage.iterations)
        pace = min(LARGEST_SPEEDUP, ends[-1] / max(1, total))
        marks = [round(end * total / max(1, ends[-1])) for end in ends]
        stages = tuple(
            replace(stage, iterations=after - before, rates=stage.rates.scaled(pace))
            for stage, before, after in zip(self.stages, marks[:-1], marks[1:], strict=True)
        )
        return replace(self, stages=stages)

    def as_dict(self) -> dict[str, Any]:
        """Return plain data, stage names included, for the result's JSON."""
        return {
            "name": self.name,
            "light_fit": asdict(self.light_fit) if self.light_fit else None,
            "stages": [{"stage": stage.name, **asdict(stage)} for stage in self.stages],
        }


RECIPES: dict[str, Recipe] = {
    "paper": Recipe("paper", stages=(GlobalStage(), PixelStage())),
}
"""By name. `paper` is Ours+ of Table 1: global roughness and specular, then every map per pixel."""


def find_recipe(name: str) -> Recipe:
    """Return a recipe by name.

    Raises:
        ValueError: naming the known ones.
    """
    if name not in RECIPES:
        raise ValueError(f"no recipe is called {name!r}; the known ones are {', '.join(sorted(RECIPES))}")
    return RECIPES[name]


def _parameters(name: str) -> int:
    # A unit normal has two free numbers, its slopes.
    return 2 if name == "normal" else CHANNELS[name]
