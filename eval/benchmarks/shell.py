"""`python -m eval.benchmarks.shell`: a photo from the shell to all files, by size of the photo.

Every run is the command `refine` as a person types it, into an empty folder: Python's start, the network, the
light, refinement, maps and report. The photo is an example, enlarged to every size; maps are as large as it.
Compiled loops are compiled before the clock starts. Told are seconds and peak memory of the process, and what
refinement takes of them, as the result's own record says.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import OpenImageIO as oiio

from eval.benchmarks.startup import run_python
from eval.report import markdown_table, number, origin, provenance
from refine.errors import UserError

EXAMPLE = Path(__file__).parents[2] / "examples" / "slate.jpg"

NOT_REFINEMENT = ("initialization", "light")
"""Entries of a record's seconds that are before the maps move."""


@dataclass(frozen=True)
class Run:
    """One run of the command.

    Attributes:
        recipe: its name.
        size: side of the photo and the maps, pixels.
        seconds: from start to end.
        refinement: seconds of the stages of the recipe.
        memory_mib: most that the process held.
    """

    recipe: str
    size: int
    seconds: float
    refinement: float
    memory_mib: float


def write_photo(path: Path, size: int, example: Path = EXAMPLE) -> None:
    """Write the example as a square JPEG of this size."""
    whole = oiio.ImageBuf(str(example))
    oiio.ImageBufAlgo.resize(whole, roi=oiio.ROI(0, size, 0, size, 0, 1, 0, 3)).write(str(path), oiio.UINT8)


def run(photo: Path, recipe: str, size: int, options: Sequence[str] = ()) -> Run:
    """Refine a photo of this size once.

    Raises:
        UserError: the command failed.
    """
    with tempfile.TemporaryDirectory(prefix="refine-") as folder:
        command = ["-m", "refine.cli", str(photo), "--out", folder, "--recipe", recipe]
        try:
            seconds, usage = run_python(
                [*command, "--resolution", str(size), "--quiet", *options], subprocess.PIPE
            )
        except subprocess.CalledProcessError as error:
            raise UserError(f"The run of {size} px cannot be timed: {error.stderr.strip()}") from error
        record = json.loads((Path(folder) / f"{photo.stem}.json").read_text(encoding="utf-8"))
    stages = [value for name, value in record["seconds"].items() if name not in NOT_REFINEMENT]
    return Run(recipe, size, seconds, sum(stages), usage.ru_maxrss / 1024)


def table(runs: Sequence[Run]) -> list[str]:
    """Return the lines of a Markdown table, medians over the runs of a recipe and a size."""
    heads = ["recipe", "size", "all, s", "refinement, s", "per megapixel, s", "MiB"]
    rows = []
    for recipe, size in dict.fromkeys((one.recipe, one.size) for one in runs):
        same = [one for one in runs if (one.recipe, one.size) == (recipe, size)]
        seconds, refinement = median(one.seconds for one in same), median(one.refinement for one in same)
        memory = median(one.memory_mib for one in same)
        each = 1e6 * seconds / size**2
        rows.append(
            [recipe, str(size), *(number(x, 1) for x in (seconds, refinement, each)), number(memory, 0)]
        )
    return markdown_table(heads, rows, 1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; options it does not know are for `refine`."""
    parser = argparse.ArgumentParser(prog="python -m eval.benchmarks.shell", description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512, 1024, 2048, 4096])
    parser.add_argument("--rounds", type=int, default=1, help="runs of every recipe and size")
    parser.add_argument("--out", type=Path, default=Path("docs/results"), help="folder")
    options, others = parser.parse_known_args(arguments)
    planned = [("paper", options.sizes[0]), *(("default", size) for size in options.sizes)]
    runs: list[Run] = []
    with tempfile.TemporaryDirectory(prefix="refine-") as folder:
        for size in options.sizes:
            write_photo(Path(folder) / f"{size}.jpg", size)
        for recipe, size in planned[:2]:
            run(Path(folder) / f"{size}.jpg", recipe, size, others)
        for _ in range(options.rounds):
            for recipe, size in planned:
                runs.append(run(Path(folder) / f"{size}.jpg", recipe, size, others))
                print(f"{recipe}, {size} px: {runs[-1].seconds:.1f} s", file=sys.stderr, flush=True)
    said = f" {' '.join(others)}" if others else ""
    caption = (
        f"`refine PHOTO --resolution SIZE --recipe RECIPE{said}`, from shell to files, compiled loops on "
        f"disk; median of {options.rounds} runs, by `python -m eval.benchmarks.shell`; "
        f"{origin(provenance())}."
    )
    text = "\n".join(["# From the shell to files", "", caption, "", *table(runs), ""])
    options.out.mkdir(parents=True, exist_ok=True)
    record = {"settings": {"options": others, **provenance()}, "runs": [asdict(one) for one in runs]}
    (options.out / "shell.json").write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    (options.out / "shell.md").write_text(text, encoding="utf-8")
    print(text, end="")


if __name__ == "__main__":
    main()
