"""What benchmarks of engines time: one problem of any size, turns at a stage, whole recipes."""

from __future__ import annotations

import ctypes
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nets.render import Camera, PointLight, render
from nets.svbrdf import SVBRDF
from refine.capture import Capture
from refine.engine import find_descend
from refine.parametrization import Parameters
from refine.run import run_stages
from refine.stages import GlobalStage, PixelStage, find_recipe

LIGHT = PointLight.at((0.2, -0.1, 2.2))

WATCHED_EVERY = 0.01
"""Seconds between two looks at the memory a process holds."""

ITERATIONS = (2, 100)
"""Fewest and most of a turn."""


@dataclass(frozen=True)
class Problem:
    """A smooth material and the photo of another one, `[1, 3, size, size]`, under a known light."""

    start: SVBRDF
    capture: Capture

    @staticmethod
    def random(size: int, seed: int = 0) -> Problem:
        """Draw one."""
        truth, start = (_smooth_svbrdf(size, seed + n) for n in (0, 1))
        photo = render(truth, LIGHT)
        unsaturated = (photo < 1.0).all(dim=1, keepdim=True)
        return Problem(start, Capture(photo.clamp(max=1.0), unsaturated, Camera(), LIGHT))


@dataclass(frozen=True)
class Turns:
    """What engines took, by name: milliseconds per iteration, one number a round, and MiB."""

    milliseconds: dict[str, list[float]]
    memory_mib: dict[str, float]


def take_turns(
    problem: Problem, stage: PixelStage | GlobalStage, engines: Sequence[str], rounds: int, seconds: float
) -> Turns:
    """Let engines run a stage in turns.

    Args:
        problem: what is refined.
        stage: of which only the rates are used.
        engines: names in `refine.engine.ENGINES`.
        rounds: turns of each, after one that does not count: in it, what is compiled is compiled.
        seconds: that a turn's iterations should take.
    """
    parameters = Parameters.from_svbrdf(problem.start)
    counts = dict.fromkeys(engines, ITERATIONS[0])
    turns = Turns({engine: [] for engine in engines}, {})
    for turn in range(rounds + 1):
        for engine in engines:

            def seconds_of(iterations: int, engine: str = engine) -> float:
                clock = time.perf_counter()
                find_descend(engine)(
                    parameters,
                    stage.offsets(*problem.start.size),
                    problem.capture,
                    iterations=iterations,
                    rates=stage.rates.moving(),
                )
                return time.perf_counter() - clock

            with peak_memory() as memory:
                # What a stage pays once (packing, first touch of its memory) is in both.
                once = seconds_of(0)
                each = max(seconds_of(counts[engine]) - once, 1e-9) / counts[engine]
            turns.memory_mib[engine] = memory()
            if turn > 0:
                turns.milliseconds[engine].append(1e3 * each)
            counts[engine] = min(max(int(seconds / each), ITERATIONS[0]), ITERATIONS[1])
    return turns


def whole_run(problem: Problem, recipe: str, engine: str) -> float:
    """Run all stages of a recipe and return the seconds they took."""
    clock = time.perf_counter()
    run_stages(problem.start, problem.capture, find_recipe(recipe), {}, None, engine)
    return time.perf_counter() - clock


class Memory:
    """How far the memory of this process has risen, in MiB; 0 where the system does not say."""

    def __init__(self) -> None:
        """Begin now."""
        self.held = self.peak = _resident()

    def look(self) -> None:
        """Take note of the present."""
        self.peak = max(self.peak, _resident())

    def __call__(self) -> float:
        """Return the rise since the beginning."""
        return self.peak - self.held


@contextmanager
def peak_memory() -> Iterator[Memory]:
    """Watch the memory of this process from a thread."""
    _give_back()
    memory, done = Memory(), threading.Event()

    def watch() -> None:
        while not done.wait(WATCHED_EVERY):
            memory.look()

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield memory
    finally:
        memory.look()
        done.set()
        watcher.join()


def _give_back() -> None:
    # What was freed but is still held would be taken again unnoticed. Only glibc has this.
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError, TypeError):
        return


def _resident() -> float:
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0.0
    return pages * 4096 / 2**20


def _smooth_svbrdf(size: int, seed: int) -> SVBRDF:
    generator = torch.Generator().manual_seed(seed)

    def field(channels: int, low: float, high: float) -> Float[Tensor, "1 c h w"]:
        coarse = torch.rand(1, channels, 16, 16, generator=generator)
        return low + (high - low) * torch.nn.functional.interpolate(coarse, (size, size), mode="bilinear")

    normal = torch.cat([field(2, -0.3, 0.3), torch.ones(1, 1, size, size)], dim=1)
    normal = torch.nn.functional.normalize(normal, dim=1)
    return SVBRDF(normal, field(3, 0.05, 0.7), field(1, 0.2, 0.8), field(3, 0.02, 0.2))
