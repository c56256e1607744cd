"""`python -m eval.benchmarks.batch`: one batch of photos with one worker process, and with several.

The photos are crops of those in `examples/`, some mirrored, drawn from a seed. Every run is the command
`refine` as a person types it, into an empty folder, with one thread of refinement per worker. Numbers of
workers take turns, so that what else the machine does hits them alike; told are medians over the rounds, of
ratios, too.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np
import OpenImageIO as oiio

from eval.report import markdown_table, number, origin, provenance
from refine.errors import UserError

EXAMPLES = Path(__file__).parents[2] / "examples"

SMALLEST_CROP = 0.7
"""Side of a crop, as a share of the example's."""


def write_photos(folder: Path, count: int, seed: int, examples: Path = EXAMPLES) -> None:
    """Write so many photos, `00.png` and on: crops of the examples, taken in turns, some mirrored."""
    sources = sorted(examples.glob("*.jpg"))
    random = np.random.default_rng(seed)
    for place in range(count):
        pixels = np.asarray(oiio.ImageBuf(str(sources[place % len(sources)])).get_pixels(oiio.UINT8))
        shorter = min(pixels.shape[:2])
        side = int(random.integers(int(SMALLEST_CROP * shorter), shorter + 1))
        top, left = (int(random.integers(0, length - side + 1)) for length in pixels.shape[:2])
        crop = pixels[top : top + side, left : left + side]
        for axis in (0, 1):
            if random.random() < 0.5:
                crop = np.flip(crop, axis)
        oiio.ImageBuf(np.ascontiguousarray(crop)).write(str(folder / f"{place:02d}.png"))


def run_batch(photos: Path, workers: int, options: Sequence[str] = ()) -> float:
    """Refine all photos of a folder into an empty one; return the seconds from start to end of the command.

    Raises:
        UserError: photos failed.
    """
    with tempfile.TemporaryDirectory(prefix="refine-") as folder:
        command = [sys.executable, "-m", "refine.cli", str(photos), "--out", str(Path(folder) / "mats")]
        command += ["--workers", str(workers), "--threads", "1", "--quiet", *options]
        clock = time.perf_counter()
        done = subprocess.run(command, stderr=subprocess.PIPE, text=True)
        seconds = time.perf_counter() - clock
    if done.returncode != 0:
        raise UserError(f"The batch cannot be timed: {done.stderr.strip()}")
    return seconds


def table(seconds: dict[int, list[float]], photos: int) -> list[str]:
    """Return the lines of a Markdown table of runs, by number of workers; the first is compared with."""
    first = next(iter(seconds))
    heads = ["workers", "batch, s", "photo, s", f"ratio to {first}", "fastest", "slowest"]
    rows = []
    for workers, runs in seconds.items():
        ratio = median(run / base for run, base in zip(runs, seconds[first], strict=True))
        numbers = (median(runs), median(runs) / photos, ratio, min(runs), max(runs))
        rows.append([str(workers), *(number(value, 2) for value in numbers)])
    return markdown_table(heads, rows, 1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; options it does not know are for `refine`."""
    parser = argparse.ArgumentParser(prog="python -m eval.benchmarks.batch", description=__doc__)
    parser.add_argument("--photos", type=int, default=24, help="how many")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=3, help="turns of each number of workers")
    parser.add_argument("--seed", type=int, default=0, help="of the crops")
    parser.add_argument("--out", type=Path, default=Path("docs/results"), help="folder")
    options, others = parser.parse_known_args(arguments)
    seconds: dict[int, list[float]] = {workers: [] for workers in options.workers}
    with tempfile.TemporaryDirectory(prefix="refine-") as folder:
        write_photos(Path(folder), options.photos, options.seed)
        for turn in range(options.rounds):
            for workers, runs in seconds.items():
                runs.append(run_batch(Path(folder), workers, others))
                print(f"round {turn + 1}, workers {workers}: {runs[-1]:.1f} s", flush=True)
    said = f" (`{' '.join(others)}`)" if others else ""
    caption = (
        f"`refine` on a folder of {options.photos} photos{said}, from shell to index, one thread of "
        f"refinement per worker; median of {options.rounds} rounds, ratio within a round; "
        f"{origin(provenance())}."
    )
    text = "\n".join(["# Batches", "", caption, "", *table(seconds, options.photos)])
    settings = {"photos": options.photos, "seed": options.seed, "options": others, **provenance()}
    record = {"settings": settings, "seconds": {str(workers): runs for workers, runs in seconds.items()}}
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "batch.json").write_text(json.dumps(record, indent=2) + "\n")
    (options.out / "batch.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
