"""How much memory a refinement takes, estimated before it starts, and whether there is so much.

The estimate is a line through measured peaks of whole runs, the report included, by engine.
"""

from __future__ import annotations

import math
from pathlib import Path

from refine.errors import UserError

GIB = 2**30

BASE = 640 * 2**20
"""Bytes of a run on a small photo: libraries, network, one band of pixels."""

PER_PIXEL = {"fused": 500, "reference": 1700, "compiled": 1700}
"""Bytes per pixel of the maps, by engine. Measured: `fused` 758 MiB at 512 pixels a side, 1,750 at 1,536;
`reference` 988 at 512, 2,239 at 1,024. Not measured: `compiled`, whose steps take less than those."""

PER_FURTHER_PHOTO = 60
"""The same of every further photo of one surface, for the fused engine; for the others in proportion."""

WORTH_SAYING = GIB
"""What takes less is not announced."""


def memory_needed(size: tuple[int, int], engine: str, photos: int = 1) -> int:
    """Estimate the peak memory of a run, in bytes.

    Args:
        size: height and width of the maps.
        engine: that refines.
        photos: of the surface.
    """
    share = 1.0 + (photos - 1) * PER_FURTHER_PHOTO / PER_PIXEL["fused"]
    return BASE + int(PER_PIXEL[engine] * share * size[0] * size[1])


def free_memory() -> int | None:
    """Return how many bytes this machine can still give, or None if it does not say."""
    try:
        text = Path("/proc/meminfo").read_text(encoding="ascii")
        return int(text.partition("MemAvailable:")[2].split()[0]) * 1024
    except (OSError, ValueError, IndexError):
        return None


def require_memory(
    size: tuple[int, int], engine: str, photos: int = 1, *, allowed: float | None = None
) -> int:
    """Check that a run fits, and return its estimate in bytes.

    Args:
        size: height and width of the maps.
        engine: that refines.
        photos: of the surface.
        allowed: GiB it may take; None allows what is free.

    Raises:
        UserError: it does not, with a size that does.
    """
    needed = memory_needed(size, engine, photos)
    if allowed is None:
        free = free_memory()
        if free is None or needed - BASE <= free:
            return needed
        most, limit = free + BASE, f"{free / GIB:.1f} GiB are free"
    else:
        most, limit = int(allowed * GIB), f"--max-memory allows {allowed:g}"
        if needed <= most:
            return needed
    least = memory_needed((1, 1), engine, photos)
    room = max(0, most - least) / max(1, needed - least)
    side = int(math.sqrt(room) * max(size))
    raise UserError(
        f"Maps of {size[1]} x {size[0]} pixels take about {needed / GIB:.1f} GiB of memory but {limit}; "
        + (f"ask for --resolution {side} or less." if side >= 16 else "allow more, or free some.")
    )
