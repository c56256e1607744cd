"""`python -m eval.benchmarks.soak --count 20000`: random cases through every recipe and engine.

Every result must be finite, legal and explain its photos no worse than its start. Besides, some cases are run
with another number of threads, which must not matter, and in float64, whose distance from float32 is told.
Stopped, it goes on where it was: what it found so far is in the file of `--out`, and case `n` of a seed is
the same on every machine.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from eval.benchmarks.cases import Case, Seeded, draw_case
from eval.benchmarks.progress import read_progress, write_progress
from eval.report import provenance
from nets.svbrdf import MAPS, SVBRDF
from refine.bands import distance_in_bands
from refine.capture import Capture
from refine.run import run_stages
from refine.stages import RECIPES as ALL_RECIPES
from refine.stages import LatentStage

ENGINES = ("fused", "reference")

RECIPES = {
    name: recipe
    for name, recipe in ALL_RECIPES.items()
    if not any(isinstance(stage, LatentStage) for stage in recipe.stages)
}
"""Those that need no network of their own."""

SIDES = (8, 16)
"""Smallest and largest side of a case, pixels."""

COMPARED = 20
"""One case in so many is run again in float64 and with another number of threads."""

THREADS = 2
"""The other number of threads; the soak itself runs with one."""

SAME = 1e-5
"""Largest difference of any map that the number of threads may make."""

FORMAT = "svbrdf-refine soak 1"


@dataclass
class Soak:
    """What was found so far.

    Attributes:
        seed: of all cases.
        cases: how many are done.
        runs: refinements: a case has one for every recipe and engine.
        seconds: spent.
        failures: case, recipe, engine and what was wrong.
        refused: runs whose result was worse than the start and which therefore returned the start.
        threads: runs that were repeated with another number of threads, and the largest difference.
        precision: by engine, runs repeated in float64: relative differences of the final loss.
    """

    seed: int
    cases: int = 0
    runs: int = 0
    seconds: float = 0.0
    failures: list[dict[str, Any]] = field(default_factory=list)
    refused: int = 0
    threads: dict[str, float] = field(default_factory=lambda: {"runs": 0, "largest_difference": 0.0})
    precision: dict[str, list[float]] = field(default_factory=dict)


def check(case: Case, recipe: str, engine: str) -> tuple[SVBRDF, float, float]:
    """Refine a case; return the material, and the loss at the start and at the end.

    Raises:
        ValueError: the result is not what refinement promises; the message says why.
    """
    stages = RECIPES[recipe].with_iterations(case.iterations)
    refined, losses = run_stages(case.initial, case.captures, stages, {}, None, engine)
    refined.validate()
    for stage, history in losses.items():
        if not all(math.isfinite(loss) for loss in history):
            raise ValueError(f"a loss of {stage} is not finite")
    start = losses["initialization"][0]
    end = sum(distance_in_bands(refined, capture) for capture in case.captures)
    if not end <= start:
        raise ValueError(f"the loss rose from {start} to {end}")
    return refined, start, end


def soak_case(found: Soak, number: int, engines: Sequence[str] = ENGINES) -> None:
    """Run one case through every recipe and engine and add what is found."""
    case = draw_case(Seeded(found.seed, number), sides=SIDES)
    for recipe in RECIPES:
        for engine in engines:
            try:
                refined, _, end = check(case, recipe, engine)
                found.refused += case.iterations > 0 and refined is case.initial
                if number % COMPARED == 0:
                    _compare_threads(found, case, recipe, engine, refined)
                    _compare_precision(found, case, recipe, engine, end)
            except Exception as error:  # whatever it is, it is a finding
                what = f"{type(error).__name__}: {error}"
                found.failures.append({"case": number, "recipe": recipe, "engine": engine, "what": what})
            found.runs += 1
    found.cases = number + 1


def _compare_threads(found: Soak, case: Case, recipe: str, engine: str, single: SVBRDF) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    try:
        several, _, _ = check(case, recipe, engine)
    finally:
        torch.set_num_threads(before)
    largest = max(float((getattr(single, name) - getattr(several, name)).abs().max()) for name in MAPS)
    found.threads["runs"] += 1
    found.threads["largest_difference"] = max(found.threads["largest_difference"], largest)
    if largest > SAME:
        raise ValueError(f"{THREADS} threads give maps that differ by {largest}")


def _compare_precision(found: Soak, case: Case, recipe: str, engine: str, end: float) -> None:
    exact = replace(
        case,
        initial=case.initial.to(torch.float64),
        captures=tuple(_in_double(capture) for capture in case.captures),
    )
    _, _, end_of_exact = check(exact, recipe, engine)
    difference = abs(end - end_of_exact) / max(end_of_exact, 1e-6)
    found.precision.setdefault(engine, []).append(float(f"{difference:.3g}"))


def _in_double(capture: Capture) -> Capture:
    assert capture.light is not None
    return replace(capture, photo=capture.photo.double(), light=capture.light.to(torch.float64))


def summary(found: Soak) -> str:
    """Return one line that says what was found."""
    return (
        f"{found.cases} cases, {found.runs} runs, {len(found.failures)} failures, "
        f"{found.refused} kept their start, threads differ by {found.threads['largest_difference']:.1e}, "
        f"{found.seconds:.0f} s"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return 0 if every case so far held."""
    parser = argparse.ArgumentParser(prog="python -m eval.benchmarks.soak", description=__doc__)
    parser.add_argument("--count", type=int, default=20_000, help="cases in all, those of before included")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--engines", nargs="+", default=list(ENGINES))
    parser.add_argument("--save-every", type=int, default=50, help="cases between two savings")
    parser.add_argument("--out", type=Path, default=Path("docs/results/reliability/soak.json"))
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    kept = read_progress(options.out, FORMAT, seed=options.seed)
    found = Soak(**kept) if kept else Soak(options.seed)
    while found.cases < options.count:
        clock = time.perf_counter()
        for number in range(found.cases, min(found.cases + options.save_every, options.count)):
            soak_case(found, number, options.engines)
        found.seconds = round(found.seconds + time.perf_counter() - clock, 1)
        write_progress(options.out, FORMAT, asdict(found), provenance())
        print(summary(found), file=sys.stderr, flush=True)
    return 1 if found.failures else 0


if __name__ == "__main__":
    sys.exit(main())
