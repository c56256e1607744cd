"""`python -m eval.benchmarks.engine`: refinement engines side by side in one process.

For each number of threads and size of the photo: milliseconds per iteration of the per-pixel and of the
global stage, seconds of whole recipes under a known light, and the memory they add. Engines take turns, so
that what else the machine does hits them alike; told are medians over the rounds, of ratios, too. What would
take too much time or memory is left out, with the reason.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median

import torch

from eval.benchmarks.timing import Problem, take_turns, whole_run
from eval.report import markdown_table, number, origin, provenance
from refine.engine import ENGINES, obstacle
from refine.stages import GlobalStage, PixelStage, find_recipe

FREE_SHARE = 0.8
"""Share of the free memory that an engine may take."""


@dataclass
class Measurement:
    """One engine at one size; None for what was not measured.

    Attributes:
        engine: its name.
        size: side of the square photo, pixels.
        threads: of torch and of the engine.
        pixel_ms: per iteration of the per-pixel stage.
        global_ms: per iteration of the global stage.
        ratio: how many times longer `reference` takes per iteration of the per-pixel stage.
        memory_mib: most that a turn of the per-pixel stage added to what the process held.
        run_s: all stages of a recipe, by its name.
        left_out: what was not measured (an empty name for everything), to the reason.
    """

    engine: str
    size: int
    threads: int
    pixel_ms: float | None = None
    global_ms: float | None = None
    ratio: float | None = None
    memory_mib: float | None = None
    run_s: dict[str, float] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Limits:
    """How long things may take.

    Attributes:
        rounds: turns of each engine, after one that does not count.
        turn: seconds that one turn should take.
        longest_turn: seconds that the shortest turn may take.
        run: seconds that a recipe may take.
        recipes: those that are run.
    """

    rounds: int = 5
    turn: float = 0.4
    longest_turn: float = 5.0
    run: float = 45.0
    recipes: Sequence[str] = ("paper", "default")


def measure(
    size: int,
    threads: int,
    engines: Sequence[str],
    limits: Limits,
    smaller: Sequence[Measurement] = (),
) -> list[Measurement]:
    """Time engines in turns on one photo, but for what `smaller` photos tell would take too much."""
    results = [Measurement(engine, size, threads) for engine in engines]
    before = {m.engine: m for m in smaller if m.threads == threads}
    for result in results:
        reason = obstacle(result.engine, "cpu") or _too_much(result, before.get(result.engine), limits)
        if reason is not None:
            result.left_out[""] = reason
    able = [result for result in results if not result.left_out]
    names = [result.engine for result in able]
    held_threads = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        problem = Problem.random(size)
        pixel = take_turns(problem, PixelStage(), names, limits.rounds, limits.turn)
        together = take_turns(problem, GlobalStage(), names, limits.rounds, limits.turn)
        slow = pixel.milliseconds.get("reference")
        for result in able:
            own = pixel.milliseconds[result.engine]
            result.pixel_ms, result.global_ms = median(own), median(together.milliseconds[result.engine])
            result.memory_mib = pixel.memory_mib[result.engine]
            if slow is not None:
                result.ratio = median(a / b for a, b in zip(slow, own, strict=True))
            for recipe in limits.recipes:
                expected = _expected_run(result, before.get(result.engine), recipe)
                if expected > limits.run:
                    result.left_out[recipe] = f"would take some {expected:.0f} s"
                else:
                    result.run_s[recipe] = whole_run(problem, recipe, result.engine)
    finally:
        torch.set_num_threads(held_threads)
    return results


def _growth(result: Measurement, before: Measurement) -> float:
    return (result.size / before.size) ** 2


def _too_much(result: Measurement, before: Measurement | None, limits: Limits) -> str | None:
    if before is None:
        return None
    if before.pixel_ms is None:
        return f"as at {before.size} px"
    shortest = 3e-3 * before.pixel_ms * _growth(result, before)  # of two iterations, three evaluations
    if shortest > limits.longest_turn:
        return f"two iterations would take some {shortest:.1f} s"
    needed = (before.memory_mib or 0.0) * _growth(result, before)
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**20
    return f"would take some {needed / 1024:.0f} GiB" if needed > FREE_SHARE * free else None


def _expected_run(result: Measurement, before: Measurement | None, recipe: str) -> float:
    # By a smaller photo; else every step takes about as long as one of the per-pixel stage, or longer.
    if before is not None and recipe in before.run_s:
        return before.run_s[recipe] * _growth(result, before)
    return find_recipe(recipe).iterations * (result.pixel_ms or 0.0) / 1e3


def table(measurements: Sequence[Measurement], recipes: Sequence[str]) -> list[str]:
    """Return the lines of a Markdown table, and of a list of what was left out."""
    heads = ["engine", "size", "threads", "per-pixel, ms", "ratio", "global, ms", "MiB"]
    rows = [
        [
            m.engine,
            str(m.size),
            str(m.threads),
            number(m.pixel_ms, 2),
            "-" if m.ratio is None else f"{m.ratio:.1f}x",
            number(m.global_ms, 2),
            number(m.memory_mib, 0),
            *(number(m.run_s.get(recipe), 2) for recipe in recipes),
        ]
        for m in measurements
    ]
    lines = markdown_table([*heads, *(f"{recipe}, s" for recipe in recipes)], rows, 1)
    missing = [
        f"- {m.engine}{f', recipe {what}' if what else ''}, {m.size} px, threads {m.threads}: {reason}"
        for m in measurements
        for what, reason in m.left_out.items()
    ]
    return [*lines, "", "Left out:", "", *missing] if missing else lines


def plot(measurements: Sequence[Measurement], path: Path) -> None:
    """Draw time per iteration against size, both logarithmic, one line per engine and number of threads."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.add_subplot()
    for color, engine in enumerate(dict.fromkeys(m.engine for m in measurements)):
        for threads in sorted({m.threads for m in measurements}):
            of_line = [m for m in measurements if (m.engine, m.threads) == (engine, threads) and m.pixel_ms]
            axes.loglog(
                [m.size for m in of_line],
                [m.pixel_ms or 0.0 for m in of_line],
                color=f"C{color}",
                linestyle="--" if threads == 1 else "-",
                marker="o",
                label=f"{engine}, {threads} thread{'s' if threads > 1 else ''}",
            )
    sizes = sorted({m.size for m in measurements})
    axes.set_xticks(sizes, [str(size) for size in sizes])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.set_xlabel("side of the photo, pixels")
    axes.set_ylabel("per-pixel stage, ms per iteration")
    axes.legend(fontsize="small")
    figure.savefig(path, dpi=150)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    limits = Limits()
    parser = argparse.ArgumentParser(prog="python -m eval.benchmarks.engine", description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[128, 256, 512, 1024, 2048, 4096])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--engines", nargs="+", choices=list(ENGINES), default=list(ENGINES))
    parser.add_argument("--rounds", type=int, default=limits.rounds, help="turns of each engine")
    parser.add_argument("--turn", type=float, default=limits.turn, help="seconds of one turn")
    parser.add_argument("--longest-turn", type=float, default=limits.longest_turn, help="seconds")
    parser.add_argument("--run", type=float, default=limits.run, help="longest recipe, seconds")
    parser.add_argument("--recipes", nargs="*", default=limits.recipes, help="that are run whole")
    parser.add_argument("--out", type=Path, default=Path("benchmark-engine"), help="folder")
    options = parser.parse_args(arguments)
    limits = Limits(options.rounds, options.turn, options.longest_turn, options.run, options.recipes)
    measurements: list[Measurement] = []
    for threads in options.threads:
        for size in sorted(options.sizes):
            measurements += measure(size, threads, options.engines, limits, measurements)
            print(f"{size} px, threads {threads}: done", flush=True)
    measurements.sort(key=lambda m: (m.size, m.threads))
    caption = (
        f"Median of {limits.rounds} rounds in which engines take turns; ratio to `reference` in the same "
        f"round; memory of one turn; recipes under a known light; {origin(provenance())}."
    )
    text = "\n".join([caption, "", *table(measurements, limits.recipes)])
    record = {
        "settings": {**asdict(limits), **provenance()},
        "measurements": [asdict(m) for m in measurements],
    }
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "engine.json").write_text(json.dumps(record, indent=2) + "\n")
    (options.out / "engine.md").write_text(text + "\n")
    plot(measurements, options.out / "engine.png")
    print(text)


if __name__ == "__main__":
    main()
