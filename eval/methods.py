"""The rows of the paper's tables: which weights, which recipe, and the figures the paper prints for them.

Adding a row is adding an entry to `METHODS`. Weights are looked for among the shipped checkpoints by name; a
row whose weights are not there stays in the tables as a visible gap. Gao19 starts from the maps of Des19, so
it needs those weights and its recipe's auto-encoder.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from nets.checkpoint import CheckpointError, load_model, resolve
from nets.ensemble import FlipAverage, Predictor
from nets.render import Camera
from refine.latent import require_weights
from refine.memory import StageMemory
from refine.refiner import Refiner
from refine.stages import LARGEST_SPEEDUP, LatentStage, Recipe, Stage, find_recipe

QUICK_LATENT = 400
"""Steps in latent space of a quick table, a tenth of Gao19's."""


@dataclass(frozen=True)
class Method:
    """One row.

    Attributes:
        name: of the row, as the paper writes it.
        checkpoint: name of the shipped weights, or a file.
        recipe: of refinement; None is the network's answer as it is.
        table1: the paper's figures by name of the score, as far as it prints them.
        table2: likewise.
        load: from the checkpoint's name or file to the network.
    """

    name: str
    checkpoint: str
    recipe: str | None = None
    table1: Mapping[str, float] = field(default_factory=dict)
    table2: Mapping[str, float] = field(default_factory=dict)
    load: Callable[[Path], Predictor] = load_model


@dataclass(frozen=True)
class Row:
    """A method whose weights are there.

    Attributes:
        method: the row.
        weights: its file.
        digest: sha256 of the file, the first 16 digits.
        recipe: of refinement, as it is run; None is the network's answer as it is.
    """

    method: Method
    weights: Path
    digest: str
    recipe: Recipe | None = None

    @property
    def shortened(self) -> bool:
        """Whether the recipe is not the method's own, but a quick one."""
        return self.recipe is not None and self.recipe != find_recipe(self.recipe.name)

    def refiner(
        self, camera: Camera, size: int, seed: int, *, flips: bool, memory: StageMemory | None = None
    ) -> Refiner:
        """Load the weights; the recipe is the paper's where the row has none, and is not run there."""
        network = self.method.load(self.weights)
        model = FlipAverage(network) if flips else network
        recipe = self.recipe or "paper"
        return Refiner(model, recipe, camera=camera, resolution=size, seed=seed, memory=memory)

    def sources(self) -> str:
        """Return names and digests of the files its answers come from, for a caption."""
        files = (self.weights, *self._auto_encoders())
        return f"{self.method.name} {' + '.join(f'{file.name} {_digest(file)[:8]}' for file in files)}"

    def _auto_encoders(self) -> list[Path]:
        stages = self.recipe.stages if self.recipe else ()
        return [resolve(stage.checkpoint) for stage in stages if isinstance(stage, LatentStage)]

    def settings(self) -> dict[str, Any]:
        """Return what the row's answers depend on: digests of weights and recipe."""
        if self.recipe is None:
            return {"row": self.method.name, "checkpoint": self.digest, "recipe": None}
        known = json.dumps(asdict(self.recipe), sort_keys=True)
        digests = [_digest(file) for file in self._auto_encoders()]
        recipe = hashlib.sha256("".join([known, *digests]).encode()).hexdigest()[:16]
        return {
            "row": self.method.name,
            "checkpoint": self.digest,
            "recipe": f"{self.recipe.name} {recipe}",
        }


def _table1(*figures: float) -> dict[str, float]:
    return dict(
        zip(("normal", "diffuse", "roughness", "specular", "rendering", "lpips"), figures, strict=True)
    )


def _table2(lpips: float, rendering: float) -> dict[str, float]:
    return {"lpips": lpips, "rendering": rendering}


_ROWS = (
    Method(
        "Des18",
        "des18",
        table1=_table1(0.065, 0.058, 0.175, 0.129, 0.086, 0.278),
        table2=_table2(0.349, 0.131),
    ),
    Method(
        "Des19",
        "des19",
        table1=_table1(0.092, 0.062, 0.129, 0.066, 0.100, 0.223),
        table2=_table2(0.335, 0.168),
    ),
    Method(
        "Gao19",
        "des19",
        "gao",
        table1=_table1(0.068, 0.065, 0.123, 0.065, 0.072, 0.274),
        table2=_table2(0.419, 0.132),
    ),
    Method(
        "Ours_syn",
        "syn",
        table1=_table1(0.054, 0.062, 0.100, 0.065, 0.078, 0.193),
        table2=_table2(0.306, 0.148),
    ),
    Method(
        "Ours_hyb",
        "hyb",
        table1=_table1(0.056, 0.062, 0.104, 0.066, 0.074, 0.187),
        table2=_table2(0.279, 0.138),
    ),
    Method(
        "Gao19+",
        "des19",
        "gao+",
        table1=_table1(0.069, 0.065, 0.123, 0.070, 0.068, 0.177),
        table2=_table2(0.307, 0.133),
    ),
    Method(
        "Ours_syn+",
        "syn",
        "paper",
        table1=_table1(0.053, 0.063, 0.115, 0.079, 0.058, 0.153),
        table2=_table2(0.275, 0.121),
    ),
    Method(
        "Ours_hyb+",
        "hyb",
        "paper",
        table1=_table1(0.054, 0.063, 0.124, 0.090, 0.059, 0.155),
        table2=_table2(0.256, 0.119),
    ),
    # Sec. 6.2 prints LPIPS and RMSE of renderings only.
    Method("Ours_l1", "l1", table1={"rendering": 0.073, "lpips": 0.236}),
    Method("Ours_no_render", "no_render"),
    Method("Ours_hyb default", "hyb", "default"),
)

METHODS: dict[str, Method] = {method.name: method for method in _ROWS}
"""Rows by name, in the paper's order: Tables 1 and 2, the ablations of Sec. 6.2, then what `refine` does."""


def choose(names: Sequence[str] | None) -> list[Method]:
    """Return rows by name, in the order of the table; all if None.

    Raises:
        ValueError: naming one that does not exist, and the known ones.
    """
    for name in names or ():
        if name not in METHODS:
            raise ValueError(f"no row is called {name!r}; the known ones are {', '.join(METHODS)}")
    return [method for name, method in METHODS.items() if names is None or name in names]


def parse_inits(inits: Sequence[str]) -> dict[str, str]:
    """Return checkpoints by row from `ROW=CHECKPOINT`.

    Raises:
        ValueError: naming what is not of that form, or a row that does not exist.
    """
    found = {}
    for text in inits:
        name, sign, checkpoint = text.partition("=")
        if not sign or not checkpoint:
            raise ValueError(f"--init {text} is not ROW=CHECKPOINT, for example Ours_syn=syn.safetensors")
        choose([name])
        found[name] = checkpoint
    return found


def find_weights(
    methods: Sequence[Method], inits: Mapping[str, str] | None = None, *, quick: bool = False
) -> tuple[list[Row], dict[str, str]]:
    """Return the rows whose weights can be loaded, and the reason for every other, by name.

    Args:
        methods: in the order of the table.
        inits: checkpoints by row, in place of the registry's.
        quick: shorten the search in latent space, see `quickened`.
    """
    rows, gaps = [], {}
    for method in methods:
        checkpoint = (inits or {}).get(method.name, method.checkpoint)
        recipe = None if method.recipe is None else find_recipe(method.recipe)
        try:
            weights = resolve(checkpoint)
            method.load(weights)
            if recipe is not None:
                require_weights(recipe)
        except CheckpointError as error:
            gaps[method.name] = f"no weights: {error}"
            continue
        if recipe is not None and quick:
            recipe = quickened(recipe)
        rows.append(Row(method, weights, _digest(weights), recipe))
    return rows, gaps


def quickened(recipe: Recipe) -> Recipe:
    """Return a recipe with no more than `QUICK_LATENT` steps in latent space, each as much longer."""

    def shortened(stage: Stage) -> Stage:
        if not isinstance(stage, LatentStage) or stage.iterations <= QUICK_LATENT:
            return stage
        return stage.scaled(QUICK_LATENT, min(LARGEST_SPEEDUP, stage.iterations / QUICK_LATENT))

    return replace(recipe, stages=tuple(shortened(stage) for stage in recipe.stages))


def note_of_quick(rows: Sequence[Row]) -> str:
    """Return a sentence of a caption on rows that take fewer steps than they should, or nothing."""
    names = ", ".join(row.method.name for row in rows if row.shortened)
    return f"Quick: {names} with {QUICK_LATENT} steps in latent space only. " if names else ""


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
