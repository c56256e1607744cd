"""Where training materials come from: a pool, or a folder of strips (Deschaintre's layout)."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch

from nets.data.images import DataError, listed
from nets.data.pool import INDEX, MaterialPool, Part, decode
from nets.data.strips import check_square_tiles, read_strip
from nets.svbrdf import SVBRDF

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_END = b"IEND\xaeB`\x82"
"""Last bytes of a whole PNG: what a truncated one has lost."""

HEADER_BYTES = 24
"""Signature, length and type of the first chunk, width and height."""


@runtime_checkable
class Materials(Protocol):
    """A source of square materials."""

    def draw(self, count: int, generator: torch.Generator) -> SVBRDF:
        """Return a batch, drawn with replacement."""
        ...


class PoolMaterials:
    """Materials of a pool, some collections more often than others."""

    skipped: tuple[str, ...] = ()

    def __init__(self, pool: MaterialPool, shares: Mapping[str, float] | None = None) -> None:
        """Wrap a pool; shares of collections that it lacks are left out, none draws every entry alike."""
        wanted = shares or {}
        held = {entry.collection if entry.collection in wanted else entry.kind for entry in pool.index}
        self.pool = pool
        self.shares = {name: share for name, share in wanted.items() if name in held} or None

    def draw(self, count: int, generator: torch.Generator) -> SVBRDF:
        """Return a batch, drawn with replacement."""
        return decode(self.pool.sample(count, generator, self.shares))


class StripMaterials:
    """Materials of a folder of strips, read when they are drawn: 85 GB do not fit in memory.

    Attributes:
        paths: the strips that are used, sorted.
        skipped: a sentence for every file that is not used.
    """

    def __init__(self, folder: Path, part: Part | None = None, holdout: float = 0.02) -> None:
        """Look at every file's head and tail, so that no bad one stops a training at hour ten.

        Args:
            folder: holds `.png` strips of one size, maps linear.
            part: `train` or `validation`: all but, or only, every so manieth; None takes all.
            holdout: share of strips in `validation`, at least one strip.

        Raises:
            DataError: no folder, or no usable strip in it.
        """
        if not folder.is_dir():
            raise DataError(f"{folder} is not a folder")
        sizes: dict[Path, tuple[int, int]] = {}
        skipped: list[str] = []
        for path in sorted(path for path in folder.iterdir() if path.suffix.lower() == ".png"):
            try:
                sizes[path] = strip_size(path)
            except DataError as error:
                skipped.append(str(error))
        if not sizes:
            raise DataError(f"{folder} holds no usable strip ({listed(skipped) or '.png'})")
        common = Counter(sizes.values()).most_common(1)[0][0]
        usable = [path for path, size in sizes.items() if size == common]
        skipped += [
            f"{path} is {size[0]} x {size[1]} pixels, most others are {common[0]} x {common[1]}"
            for path, size in sizes.items()
            if size != common
        ]
        every = max(2, round(1.0 / holdout))
        if part is not None and len(usable) > 1:
            held = set(usable[every // 2 :: every]) or {usable[-1]}
            usable = [path for path in usable if (path in held) == (part == "validation")]
        self.paths, self.skipped = usable, tuple(skipped)

    def draw(self, count: int, generator: torch.Generator) -> SVBRDF:
        """Return a batch, drawn with replacement.

        In place of a strip that is damaged inside, which only reading it shows, stands the next one, with a
        warning.

        Raises:
            DataError: none can be read.
        """
        chosen = torch.randint(len(self.paths), (count,), generator=generator).tolist()
        return SVBRDF.from_channels(torch.cat([self._read(number).channels() for number in chosen]))

    def _read(self, number: int) -> SVBRDF:
        for step in range(len(self.paths)):
            try:
                return read_strip(self.paths[(number + step) % len(self.paths)]).svbrdf
            except DataError as error:
                warnings.warn(f"skipped: {error}", stacklevel=2)
        raise DataError(f"none of the {len(self.paths)} strips such as {self.paths[number]} can be read")


def open_materials(
    folder: Path, part: Part | None = None, shares: Mapping[str, float] | None = None
) -> PoolMaterials | StripMaterials:
    """Open a pool or a folder of strips.

    Args:
        folder: what `python -m nets.data.pool` wrote, or a folder of strips.
        part: `train` or `validation`; None takes all.
        shares: of a pool's collections, see `PoolMaterials`.

    Raises:
        DataError: it is neither, or incomplete.
    """
    if (folder / INDEX).is_file():
        return PoolMaterials(MaterialPool(folder, part=part), shares)
    return StripMaterials(folder, part)


def strip_size(path: Path) -> tuple[int, int]:
    """Return a strip's width and height from its header.

    Raises:
        DataError: not a PNG, truncated, or not four or five square tiles.
    """
    try:
        with path.open("rb") as file:
            head = file.read(HEADER_BYTES)
            file.seek(-len(PNG_END), os.SEEK_END)
            tail = file.read()
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error})") from None
    if not head.startswith(PNG_SIGNATURE):
        raise DataError(f"{path} is not a PNG")
    if tail != PNG_END:
        raise DataError(f"{path} is truncated")
    width, height = int.from_bytes(head[16:20]), int.from_bytes(head[20:24])
    check_square_tiles(path, width, height)
    return width, height
