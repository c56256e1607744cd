"""`python -m eval.benchmarks.fuzz --executions 1000000`: a coverage-guided fuzzer on the readers of images.

Every execution hands one file to the readers of photos, of strips and of maps: a result, or one sentence. The
decoder runs in this process here, for speed and so that a crash is seen; every crash is then given to the
readers as users have them, whose decoder is a process of its own, and must end in one sentence there.
Atheris guides it by the branches of our code (pip install 'svbrdf-refine[fuzz]'); codecs are native code that
it does not see. Stopped, it goes on where it was.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from eval.benchmarks.corpus import seeds, with_checksums
from eval.benchmarks.progress import read_progress, write_progress
from eval.report import provenance
from nets.decoder import Limits

FORMAT = "svbrdf-refine fuzz 1"

MEMORY_MIB = 2048 + 700
"""Most memory of an execution: 2 GiB, and what the process holds before it reads anything."""

TRIED = Limits(memory=2**22)
"""Memory of a picture: 0.2 megapixels, so that time goes into kinds of files and not into pixels. And atheris
never lets go of the masks that watched code makes, one number for every pixel of a photo."""

SECONDS = 60
"""Longest execution, by the clock, however busy the machine is."""

LONGEST = 2**14
"""Bytes of a file that is tried."""

INSTRUMENTED = (
    "nets.decoder",
    "nets.decoding",
    "nets.data.images",
    "nets.data.strips",
    "refine.files",
    "refine.color_spaces",
    "refine.photo",
    "refine.maps",
)


@dataclass
class Fuzz:
    """What was found so far.

    Attributes:
        seed: of the fuzzer.
        executions: files that were tried.
        coverage: branches of our code that were reached, as the fuzzer counts them.
        corpus: files that reach something of their own.
        seconds: spent.
        crashes: files that ended the process, by digest: how, and what users see.
        parts: how often the fuzzer was started.
    """

    seed: int
    executions: int = 0
    coverage: int = 0
    corpus: int = 0
    seconds: float = 0.0
    crashes: dict[str, dict[str, str]] = field(default_factory=dict)
    parts: int = 0


def read_everything(path: Path) -> str:
    """Give a file to every reader of images; return what came of it, a word or a sentence each.

    Raises:
        Exception: whatever a reader raises that is no sentence for its user.
    """
    from nets.data.images import DataError
    from nets.data.strips import read_strip
    from refine.errors import UserError
    from refine.files import decode_image
    from refine.maps import _decode
    from refine.photo import read_photo, resize_photo

    def read_photo_and_shrink() -> None:
        photo = resize_photo(read_photo(path), 79)
        if not bool(photo.linear.isfinite().all()) or float(photo.linear.min()) < 0.0:
            raise AssertionError("light that is no number, or negative")

    def read_maps() -> None:
        decoded = decode_image(path)
        for name in ("normal", "roughness"):
            _decode(name, path, decoded)

    outcomes = []
    for read in (read_photo_and_shrink, lambda: read_strip(path), read_maps):
        try:
            read()
            outcomes.append("read")
        except (UserError, DataError) as error:
            sentence = str(error)
            if "\n" in sentence or not sentence.isprintable():
                raise AssertionError(f"not one line: {sentence!r}") from error
            outcomes.append(sentence)
    return " | ".join(outcomes)


def _decode_here() -> None:
    """Decode in this process, each file once, from now on."""
    from nets import decoder, decoding

    last: dict[str, Any] = {}

    def decode_file(path: Path | str, limits: Limits | None = None) -> decoding.Decoded:
        content = hashlib.sha256(Path(path).read_bytes()).digest()
        if last.get("content") != content:
            last.clear()
            try:
                last["found"] = decoding.as_decoded(*decoder.decode(str(path), TRIED))
            except decoder.Refused as refused:
                last["error"] = refused.args
            except MemoryError:
                last["error"] = ("memory", "")
            last["content"] = content
        if "error" in last:
            raise decoding.DecodingError(*last["error"])
        found: decoding.Decoded = last["found"]
        return found

    decoding.decode_file = decode_file


def fuzz_here(arguments: Sequence[str]) -> None:
    """Run the fuzzer in this process until its runs are done or it crashes; never returns."""
    import importlib

    import atheris
    import torch

    with atheris.instrument_imports(include=list(INSTRUMENTED)):
        for name in INSTRUMENTED:
            importlib.import_module(name)
    torch.set_num_threads(1)
    _decode_here()
    folder = Path(
        tempfile.mkdtemp(prefix="refine-fuzz-", dir="/dev/shm" if os.path.isdir("/dev/shm") else None)
    )
    path = folder / "file"

    def try_one(data: bytes) -> None:
        path.write_bytes(data)
        if data:
            read_everything(path)

    def mutate(data: bytes, longest: int, seed: int) -> bytes:
        return with_checksums(atheris.Mutate(data, longest))[:longest]

    atheris.Setup([sys.argv[0], *arguments], try_one, custom_mutator=mutate)
    atheris.Fuzz()


def run_part(found: Fuzz, runs: int, seconds: int, corpus: Path, artifacts: Path) -> None:
    """Run the fuzzer in a process of its own and add what it found."""
    clock = time.perf_counter()
    options = [
        f"-runs={runs}",
        f"-max_total_time={seconds}",
        f"-seed={found.seed + found.parts + 1}",
        f"-rss_limit_mb={MEMORY_MIB}",
        f"-timeout={SECONDS}",
        f"-max_len={LONGEST}",
        f"-artifact_prefix={artifacts}/",
        "-print_final_stats=1",
        "-verbosity=1",
    ]
    command = [sys.executable, "-m", "eval.benchmarks.fuzz", "--part", *options, str(corpus)]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace")
    log = done.stderr + done.stdout
    executed = re.findall(r"stat::number_of_executed_units:\s*(\d+)", log)
    reached = re.findall(r"\bcov: (\d+)", log)
    if not executed:
        raise RuntimeError(f"the fuzzer did not run: {log[-2000:]}")
    found.executions += int(executed[-1])
    found.coverage = max([found.coverage, *map(int, reached)])
    found.corpus = len(list(corpus.iterdir()))
    found.parts += 1
    found.seconds = round(found.seconds + time.perf_counter() - clock, 1)
    for artifact in artifacts.iterdir():
        if artifact.name not in found.crashes:
            found.crashes[artifact.name] = {"how": _how(log), "users see": _as_users_see(artifact)}


def _how(log: str) -> str:
    """Return the line of a log that says why the fuzzer stopped."""
    lines = [line.strip() for line in log.splitlines()]
    marks = ("Uncaught Python exception", "ERROR: libFuzzer", "SUMMARY")
    for number, line in enumerate(lines):
        if any(mark in line for mark in marks):
            return " ".join(lines[number : number + 3])[:300]
    return lines[-1][:300] if lines else "no word"


def _as_users_see(path: Path) -> str:
    try:
        return read_everything(path)
    except Exception as error:  # this is the finding
        return f"DEFECT {type(error).__name__}: {error}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return 0 if every file ended in a result or a sentence."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments[:1] == ["--part"]:
        fuzz_here(arguments[1:])
    parser = argparse.ArgumentParser(prog="python -m eval.benchmarks.fuzz", description=__doc__)
    parser.add_argument("--executions", type=int, default=1_000_000, help="in all, those of before included")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--part-runs", type=int, default=10_000, help="executions between two savings")
    parser.add_argument("--part-seconds", type=int, default=600, help="most seconds between two savings")
    parser.add_argument("--corpus", type=Path, default=Path("runs/fuzz"), help="working folder, kept")
    parser.add_argument("--out", type=Path, default=Path("docs/results/reliability/fuzz.json"))
    options = parser.parse_args(arguments)
    corpus, artifacts = options.corpus / "corpus", options.corpus / "crashes"
    for folder in (corpus, artifacts):
        folder.mkdir(parents=True, exist_ok=True)
    for name, data in seeds(options.seed).items():
        (corpus / f"seed {name}").write_bytes(data)
    for kept in sorted(Path("tests/fuzz/corpus").glob("*")):
        shutil.copy(kept, corpus / f"kept {kept.name}")
    earlier = read_progress(options.out, FORMAT, seed=options.seed)
    found = Fuzz(**earlier) if earlier else Fuzz(options.seed)
    while found.executions < options.executions:
        runs = min(options.part_runs, options.executions - found.executions)
        run_part(found, runs, options.part_seconds, corpus, artifacts)
        write_progress(options.out, FORMAT, asdict(found), provenance())
        print(
            f"{found.executions} executions, {len(found.crashes)} crashes, coverage {found.coverage}, "
            f"corpus {found.corpus}, {found.seconds:.0f} s",
            file=sys.stderr,
            flush=True,
        )
    return 1 if any("DEFECT" in crash["users see"] for crash in found.crashes.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
