"""A pool of materials on disk, sampled at training speed: one memory-mapped uint8 array and a JSON index.

    python -m nets.data.pool --out runs/pool --procedural 1200 --materials DIR --size 384 --seed 0

Each entry is [10, S, S], as `pool_format` says. Give only training folders: what it holds is trained on.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nets.data.images import DataError, resize, unit_normal
from nets.data.pbr import read_pbr_folder
from nets.data.pool_format import Entry, Part, decode, encode, from_planes, licence_of, part_of
from nets.data.procedural import FAMILIES, HELD_OUT_FAMILIES, generate
from nets.processes import end_with_parent
from nets.svbrdf import SVBRDF

__all__ = ["Entry", "MaterialPool", "Part", "build_pool", "decode", "encode", "make", "part_of", "plan"]

ARRAY = "materials.npy"
INDEX = "index.json"

VERSION = 2
"""Of what `build_pool` makes of one request; raised when that changes, so that older pools are built anew."""

CROP_FACTOR = 1.25
"""A source at least this many times the pool's size also gives a crop at its native resolution."""

MINIMUM_MEAN_Z = 0.6
"""Folders whose normals lean further on average are left out: bakes with relief in wrong units."""


class MaterialPool:
    """A pool opened for reading, or one part of it.

    Attributes:
        index: one `Entry` per material of this part.
        size: side of the stored tiles in pixels.
    """

    def __init__(self, path: Path, part: Part | None = None, *, holdout: float = 0.05) -> None:
        """Open a pool that `build_pool` wrote.

        Args:
            path: its folder.
            part: only the sources for training or validation; None takes all. See `part_of`.
            holdout: share of sources in `validation`.

        Raises:
            DataError: not a complete pool, or the part is empty.
        """
        folder = Path(path)
        try:
            entries = [Entry(**fields) for fields in json.loads((folder / INDEX).read_text())["entries"]]
            self._array = np.lib.format.open_memmap(folder / ARRAY, mode="r")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(f"{folder} is not a complete material pool: {error}") from error
        if self._array.shape[:2] != (len(entries), 10):
            raise DataError(f"{folder} holds an array {self._array.shape} for {len(entries)} entries")
        self._rows = [
            row for row, entry in enumerate(entries) if part in (None, part_of(entry.name, holdout))
        ]
        if not self._rows:
            raise DataError(f"{folder} holds no materials for {part or 'any use'}")
        self.index = [entries[row] for row in self._rows]
        self.size = int(self._array.shape[-1])

    def __len__(self) -> int:
        """Return the number of materials."""
        return len(self._rows)

    def __getitem__(self, position: int) -> UInt8[Tensor, "1 10 size size"]:
        """Read one material as stored; see `decode`."""
        return self._read([self._rows[position]])

    def sample(
        self, count: int, generator: torch.Generator, weights: Mapping[str, float] | None = None
    ) -> UInt8[Tensor, "count 10 size size"]:
        """Draw materials with replacement.

        Args:
            count: how many.
            generator: source of randomness.
            weights: share of each kind or, more closely, collection, for instance
                `{"procedural": 0.5, "pbr": 0.3, "infinigen": 0.2}`. An entry counts to its collection if that
                is listed, else to its kind, and is never drawn if neither is. None: every entry alike.

        Raises:
            ValueError: a weight is negative, or of nothing the pool holds, or all are zero.
        """
        chosen = torch.multinomial(self._probabilities(weights), count, replacement=True, generator=generator)
        return self._read([self._rows[position] for position in chosen.tolist()])

    def _probabilities(self, weights: Mapping[str, float] | None) -> Float[Tensor, "entries"]:
        if weights is None:
            return torch.ones(len(self))
        groups = [entry.collection if entry.collection in weights else entry.kind for entry in self.index]
        unknown = set(weights) - set(groups)
        if unknown:
            raise ValueError(f"the pool holds no {', '.join(sorted(unknown))}, which has a weight")
        if min(weights.values()) < 0.0 or sum(weights.values()) <= 0.0:
            raise ValueError(f"weights must not be negative and not all zero, got {dict(weights)}")
        return torch.tensor([weights.get(group, 0.0) / groups.count(group) for group in groups])

    def _read(self, rows: Sequence[int]) -> UInt8[Tensor, "count 10 size size"]:
        return torch.from_numpy(np.stack([self._array[row] for row in rows]))


def plan(folders: Sequence[Path], *, size: int, procedural: int, seed: int) -> list[Entry]:
    """List what a pool will hold, in order; see `build_pool` for the arguments."""
    entries = []
    for number, family in zip(range(procedural), _cycle(), strict=False):
        child = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
        entries.append(
            Entry(f"{family}_{child}", "procedural", family, "whole", child, "Apache-2.0 (this project)")
        )
    for folder in folders:
        if not folder.is_dir():
            raise DataError(f"{folder} is not a folder")
        for child_folder in sorted(path for path in folder.iterdir() if path.is_dir()):
            name = child_folder.name
            common = (licence_of(child_folder), str(child_folder))
            collection = name.split("__")[0] if "__" in name else folder.name
            entries.append(Entry(name, "pbr", collection, "whole", 0, *common))
            crop = int.from_bytes(hashlib.sha256(f"{seed} {name}".encode()).digest()[:4], "big")
            entries.append(Entry(name, "pbr", collection, "crop", crop, *common))
    return entries


def make(entry: Entry, size: int) -> UInt8[Tensor, "1 10 size size"] | None:
    """Generate or read one material of a pool.

    Args:
        entry: what to make.
        size: side in pixels; smaller sources are enlarged.

    Returns:
        The encoded material; None for a folder whose normals lean too far (`MINIMUM_MEAN_Z`), and for a crop
        of a source that is not `CROP_FACTOR` times larger.

    Raises:
        DataError: the source cannot be read.
    """
    if entry.kind == "procedural":
        return encode(from_planes(generate(entry.collection, size, entry.seed)))
    source = read_pbr_folder(Path(entry.source))
    if float(source.normal[:, 2].mean()) < MINIMUM_MEAN_Z:
        return None
    shorter = min(source.size)
    side = shorter if entry.variant == "whole" else size
    if entry.variant == "crop" and shorter < CROP_FACTOR * size:
        return None
    rng = np.random.default_rng(entry.seed)
    room = (source.size[0] - side, source.size[1] - side)
    if entry.variant == "whole":
        top, left = room[0] // 2, room[1] // 2
    else:
        top, left = (int(rng.integers(0, extent + 1)) for extent in room)
    square = source.map(lambda tensor: resize(tensor[..., top : top + side, left : left + side], size, size))
    return encode(SVBRDF(unit_normal(square.normal), square.diffuse, square.roughness, square.specular))


def build_pool(
    out: Path,
    *,
    size: int = 384,
    procedural: int = 1200,
    folders: Sequence[Path] = (),
    seed: int = 0,
    workers: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Build a pool; stopped, it goes on where it was; finished and asked for the same, it does nothing.

    Args:
        out: the pool's folder. `materials.npy` and, last, `index.json` appear in it whole or not at all.
        size: side of the stored tiles in pixels.
        procedural: number of generated materials, taking turns among the families that are not held out.
        folders: each holds material folders (`read_pbr_folder`). All are stored whole (centre square,
            resized); those of at least `CROP_FACTOR` times the size give a random crop besides. Sources that
            lean too far (`MINIMUM_MEAN_Z`) are left out and named in the index.
        seed: of everything random; the same seed and sources give the same pool.
        workers: processes; 0 works in this one.
        progress: called with the number of materials done and their total.

    Raises:
        DataError: a folder cannot be read as a material, or nothing is left to store.
    """
    out = Path(out)
    entries = plan([Path(folder) for folder in folders], size=size, procedural=procedural, seed=seed)
    if not entries:
        raise DataError(f"{out} would be a pool of no materials")
    listed = [asdict(entry) for entry in entries]
    request = {"version": VERSION, "size": size, "seed": seed, "entries": listed}
    key = hashlib.sha256(json.dumps(request).encode()).hexdigest()[:16]
    if (out / INDEX).is_file() and json.loads((out / INDEX).read_text()).get("request") == key:
        return
    parts = out / f".parts-{key}"
    parts.mkdir(parents=True, exist_ok=True)

    kept = []
    for done, present in enumerate(_make_all(entries, size, parts, workers), start=1):
        kept.append(present)
        if progress is not None:
            progress(done, len(entries))
    rows = [number for number, present in enumerate(kept) if present]
    if not rows:
        raise DataError(f"{out} would be a pool of no materials: all of them lean too far")
    partial = out / f".{key}.npy"
    array = np.lib.format.open_memmap(partial, mode="w+", dtype=np.uint8, shape=(len(rows), 10, size, size))
    for row, number in enumerate(rows):
        array[row] = np.load(parts / f"{number}.npy")[0]
    array.flush()
    del array
    (out / INDEX).unlink(missing_ok=True)  # an index never describes another array
    os.replace(partial, out / ARRAY)
    left_out = sorted({entry.name for entry in entries} - {entries[number].name for number in rows})
    index = {
        "request": key,
        "version": VERSION,
        "size": size,
        "seed": seed,
        "left_out": left_out,
        "entries": [listed[number] for number in rows],
    }
    _write_text(out / INDEX, json.dumps(index, indent=1))
    shutil.rmtree(parts)


def _make_all(entries: Sequence[Entry], size: int, parts: Path, workers: int) -> Iterator[bool]:
    arguments = (entries, [size] * len(entries), [parts] * len(entries), range(len(entries)))
    if workers == 0:
        yield from map(_make_part, *arguments)
        return
    with ProcessPoolExecutor(workers, get_context("spawn"), _begin) as executor:
        yield from executor.map(_make_part, *arguments)


def _make_part(entry: Entry, size: int, parts: Path, number: int) -> bool:
    """Make one material unless it is there already; return whether the pool holds it."""
    target = parts / f"{number}.npy"
    if not target.exists():
        made = make(entry, size)
        if made is None:
            return False
        partial = target.with_suffix(".partial")
        with partial.open("wb") as file:
            np.save(file, made.numpy())
        os.replace(partial, target)
    return True


def _begin() -> None:
    end_with_parent()
    torch.set_num_threads(1)


def _cycle() -> Iterator[str]:
    names = sorted(set(FAMILIES) - set(HELD_OUT_FAMILIES))
    while True:
        yield from names


def _write_text(path: Path, text: str) -> None:
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


def main(arguments: Sequence[str] | None = None) -> None:
    """Build a pool from the command line."""
    parser = argparse.ArgumentParser(prog="python -m nets.data.pool", description=build_pool.__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the pool")
    parser.add_argument("--procedural", type=int, default=1200, help="number of generated materials")
    parser.add_argument(
        "--materials", type=Path, action="append", default=[], help="folder of PBR folders; repeatable"
    )
    parser.add_argument("--size", type=int, default=384, help="side of the stored tiles in pixels")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2, help="processes")
    options = parser.parse_args(arguments)

    def progress(done: int, total: int) -> None:
        if done % 25 == 0 or done == total:
            print(f"{done}/{total}", flush=True)

    build_pool(
        options.out,
        size=options.size,
        procedural=options.procedural,
        folders=options.materials,
        seed=options.seed,
        workers=options.workers,
        progress=progress,
    )
    print(f"{options.out}: {len(MaterialPool(options.out))} materials")


if __name__ == "__main__":
    main()
