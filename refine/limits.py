"""How much memory a refinement takes, estimated before it starts, and whether there is so much.

The estimate is a line through measured peaks of whole runs, the report included, by engine; flatter for large
photos, of which `fused` has only some bands at work.
"""

from __future__ import annotations

from pathlib import Path

from refine.errors import UserError

GIB = 2**30

BASE = 640 * 2**20
"""Bytes of a run on a small photo: libraries, network, one band of pixels."""

PER_PIXEL = {"fused": 500, "reference": 1700, "compiled": 1700}
"""Bytes per pixel of the maps, by engine. Measured: `fused` 758 MiB at 512 pixels a side, 1,750 at 1,536;
`reference` 988 at 512, 2,239 at 1,024. Not measured: `compiled`, whose steps take less than those."""

LARGE = 1536**2
"""Pixels from which on `fused` takes `PER_PIXEL_OF_LARGE` for each more."""

PER_PIXEL_OF_LARGE = 240
"""Bytes. Measured: 1,674 MiB at 2,048 pixels a side and 4,558 at 4,096, of a photo."""

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
    pixels = size[0] * size[1]
    large = max(0, pixels - LARGE) if engine == "fused" else 0
    return BASE + int(share * (PER_PIXEL[engine] * (pixels - large) + PER_PIXEL_OF_LARGE * large))


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
    side = _largest_side(size, engine, photos, most)
    raise UserError(
        f"Maps of {size[1]} x {size[0]} pixels take about {needed / GIB:.1f} GiB of memory but {limit}; "
        + (f"ask for --resolution {side} or less." if side >= 16 else "allow more, or free some.")
    )


def _largest_side(size: tuple[int, int], engine: str, photos: int, most: int) -> int:
    """Return the longest side of this shape that fits; 0 if none does."""
    low, high = 0, max(size)
    while low < high:
        middle = (low + high + 1) // 2
        shape = tuple(max(1, round(side * middle / max(size))) for side in size)
        fits = memory_needed((shape[0], shape[1]), engine, photos) <= most
        low, high = (middle, high) if fits else (low, middle - 1)
    return low
