"""`python -m eval.benchmarks.engine`: refinement engines side by side in one process.

For each size and number of threads: milliseconds per iteration of the per-pixel and of the global stage, the
time of a whole run of the recipe `paper`, and the memory it adds. Engines take turns, so that what else the
machine does hits them alike; the least time of several is told, and the ratio of the least times.
"""

from __future__ import annotations

import argparse
import json
import platform
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nets.render import Camera, PointLight, render, shading_geometry, surface_points
from nets.svbrdf import SVBRDF
from refine.capture import Capture
from refine.engine import ENGINES, find_descend
from refine.parametrization import Parameters
from refine.run import run_stages
from refine.stages import GlobalStage, PixelStage, find_recipe

LIGHT = PointLight.at((0.2, -0.1, 2.2))

SLOW_PIXELS = 1024**2
"""Photos larger than this are refined by the fused engine only, unless `--all` is said."""


@dataclass(frozen=True)
class Measurement:
    """One engine at one size.

    Attributes:
        engine: its name.
        size: side of the square photo, pixels.
        threads: of torch and of the engine.
        pixel_ms: per iteration of the per-pixel stage.
        global_ms: per iteration of the global stage.
        run_s: both stages of `paper`, all iterations; None if not run.
        memory_mib: most that the run added to what the process held; None if not run.
    """

    engine: str
    size: int
    threads: int
    pixel_ms: float
    global_ms: float
    run_s: float | None = None
    memory_mib: float | None = None


def random_problem(size: int, seed: int = 0) -> tuple[SVBRDF, Capture]:
    """Draw a smooth material and the photo of another one, `[1, 3, size, size]`."""
    truth, start = (_smooth_svbrdf(size, seed + n) for n in (0, 1))
    photo = render(truth, LIGHT)
    unsaturated = (photo < 1.0).all(dim=1, keepdim=True)
    return start, Capture(photo.clamp(max=1.0), unsaturated, Camera(), LIGHT)


def measure(
    size: int,
    threads: int,
    engines: Sequence[str],
    *,
    rounds: int = 3,
    budget: float = 2.0,
    whole: bool = True,
) -> list[Measurement]:
    """Time engines in turns.

    Args:
        size: side of the photo, pixels.
        threads: of torch and of the engines.
        engines: names in `ENGINES`.
        rounds: turns of each engine, after one that does not count.
        budget: seconds that one turn should take; a turn is 2 to 100 iterations.
        whole: also run all stages of `paper` once.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        svbrdf, capture = random_problem(size)
        parameters = Parameters.from_svbrdf(svbrdf)
        geometry = shading_geometry(surface_points(size, size), LIGHT, Camera())
        times: dict[tuple[str, str], float] = {}
        for stage in (PixelStage(), GlobalStage()):
            counts: dict[str, int] = {}
            for turn in range(rounds + 1):
                for engine in engines:
                    count = counts.get(engine, 2)
                    clock = time.perf_counter()
                    find_descend(engine)(
                        parameters,
                        stage.offsets(size, size),
                        capture,
                        geometry,
                        iterations=count,
                        rates=stage.rates.moving(),
                    )
                    # An iteration is an evaluation and a step; the last evaluation makes one more.
                    each = (time.perf_counter() - clock) / (count + 1)
                    counts[engine] = max(2, min(100, int(budget / each)))
                    if turn > 0:
                        key = engine, stage.name
                        times[key] = min(each, times.get(key, each))
        runs = {engine: _whole_run(engine, svbrdf, capture) if whole else (None, None) for engine in engines}
    finally:
        torch.set_num_threads(before)
    return [
        Measurement(
            engine,
            size,
            threads,
            1e3 * times[engine, "per-pixel"],
            1e3 * times[engine, "global"],
            *runs[engine],
        )
        for engine in engines
    ]


def table(measurements: Sequence[Measurement]) -> str:
    """Return the measurements as a Markdown table, with ratios to the reference where it was measured."""
    reference = {(m.size, m.threads): m.pixel_ms for m in measurements if m.engine == "reference"}
    lines = [
        "| size | threads | engine | per-pixel, ms/iteration | ratio | global, ms/iteration | run, s | MiB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for m in measurements:
        base = reference.get((m.size, m.threads))
        ratio = "" if base is None else f"{base / m.pixel_ms:.1f}x"
        run, memory = ("" if v is None else f"{v:.2f}" for v in (m.run_s, m.memory_mib))
        lines.append(
            f"| {m.size} | {m.threads} | {m.engine} | {m.pixel_ms:.3f} | {ratio} | {m.global_ms:.3f} "
            f"| {run} | {memory} |"
        )
    return "\n".join(lines)


def plot(measurements: Sequence[Measurement], path: Path) -> None:
    """Draw time per iteration against size, both logarithmic, one line per engine and number of threads."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.add_subplot()
    for engine, threads in sorted({(m.engine, m.threads) for m in measurements}):
        of_line = [m for m in measurements if (m.engine, m.threads) == (engine, threads)]
        axes.loglog(
            [m.size for m in of_line],
            [m.pixel_ms for m in of_line],
            marker="o",
            label=f"{engine}, {threads} thread{'s' if threads > 1 else ''}",
        )
    axes.set_xlabel("side of the photo, pixels")
    axes.set_ylabel("per-pixel stage, ms per iteration")
    axes.legend()
    figure.savefig(path, dpi=150)


def _smooth_svbrdf(size: int, seed: int) -> SVBRDF:
    generator = torch.Generator().manual_seed(seed)

    def field(channels: int, low: float, high: float) -> Float[Tensor, "1 c h w"]:
        coarse = torch.rand(1, channels, 16, 16, generator=generator)
        return low + (high - low) * torch.nn.functional.interpolate(coarse, (size, size), mode="bilinear")

    normal = torch.cat([field(2, -0.3, 0.3), torch.ones(1, 1, size, size)], dim=1)
    normal = torch.nn.functional.normalize(normal, dim=1)
    return SVBRDF(normal, field(3, 0.05, 0.7), field(1, 0.2, 0.8), field(3, 0.02, 0.2))


def _whole_run(engine: str, svbrdf: SVBRDF, capture: Capture) -> tuple[float, float | None]:
    held, peak, done = _resident(), 0.0, threading.Event()

    def watch() -> None:
        nonlocal peak
        while not done.wait(0.02):
            peak = max(peak, _resident())

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    clock = time.perf_counter()
    run_stages(svbrdf, replace(capture, light=LIGHT), find_recipe("paper"), {}, None, engine)
    seconds = time.perf_counter() - clock
    peak = max(peak, _resident())
    done.set()
    watcher.join()
    return seconds, (peak - held if held > 0.0 else None)


def _resident() -> float:
    # MiB held by this process; 0 where the system does not say.
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20
    except OSError:
        return 0.0


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m eval.benchmarks.engine", description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[128, 256, 512, 1024])
    parser.add_argument("--threads", type=int, nargs="+", default=[torch.get_num_threads()])
    parser.add_argument("--engines", nargs="+", choices=sorted(ENGINES), default=list(ENGINES))
    parser.add_argument("--rounds", type=int, default=3, help="turns of each engine")
    parser.add_argument("--budget", type=float, default=2.0, help="seconds of one turn")
    parser.add_argument("--no-runs", action="store_true", help="only single iterations")
    parser.add_argument("--all", action="store_true", help="every engine at every size")
    parser.add_argument("--out", type=Path, default=Path("benchmark-engine"), help="folder")
    options = parser.parse_args(arguments)
    measurements: list[Measurement] = []
    for size in options.sizes:
        engines = [e for e in options.engines if options.all or e == "fused" or size**2 <= SLOW_PIXELS]
        for threads in options.threads:
            measurements += measure(
                size,
                threads,
                engines,
                rounds=options.rounds,
                budget=options.budget,
                whole=not options.no_runs,
            )
    options.out.mkdir(parents=True, exist_ok=True)
    record = {
        "machine": {"processor": platform.processor() or platform.machine(), "torch": torch.__version__},
        "measurements": [asdict(m) for m in measurements],
    }
    (options.out / "engine.json").write_text(json.dumps(record, indent=2) + "\n")
    text = table(measurements)
    (options.out / "engine.md").write_text(text + "\n")
    plot(measurements, options.out / "engine.png")
    print(text)


if __name__ == "__main__":
    main()
