"""`procedural-132`: the test set that every machine has, made of the families that no network is trained on.

As many materials as in the paper's Table 1, from `HELD_OUT_FAMILIES`, kept in the user's cache in 8 bits.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from nets.data import procedural
from nets.data.pool_format import encode, from_planes
from nets.data.procedural import HELD_OUT_FAMILIES, generate

NAME = "procedural-132"

COUNT = 132
"""Materials of the paper's synthetic test set (Sec. 6.1)."""

PIXELS = 256
"""Of a material's side as it is kept; Sec. 5.1."""

FIRST_SEED = 132_000
"""Far from the seeds that tests and examples use."""

LIMITS = (
    "Four families of our own generator that were held out of all training, but share its noise and its "
    "palettes with those that were not: this says little of scanned materials"
)
"""What a caption owes the reader."""


def scene_names() -> list[str]:
    """Return the names of the materials, a family after the other."""
    families = sorted(HELD_OUT_FAMILIES)
    each = COUNT // len(families)
    return [f"{family}_{number:02}" for family in families for number in range(each)]


def material(name: str) -> UInt8[Tensor, "1 10 256 256"]:
    """Return one material as `nets.data.pool_format` stores it: from the cache, else made and put there."""
    kept = cache_folder() / f"{name}.npy"
    try:
        found = np.load(kept)
        if found.shape == (1, 10, PIXELS, PIXELS) and found.dtype == np.uint8:
            return torch.from_numpy(found)
    except (OSError, ValueError, EOFError):
        pass  # not there, or torn: made anew
    family, _, number = name.rpartition("_")
    made = encode(from_planes(generate(family, PIXELS, FIRST_SEED + int(number))))
    _keep(kept, made)
    return made


def cache_folder() -> Path:
    """Return where materials are kept for this user: another folder for another generator."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "svbrdf-refine" / f"{NAME}-{_generator_digest()}"


@cache
def _generator_digest() -> str:
    sources = sorted(Path(procedural.__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:12]


def _keep(path: Path, made: Tensor) -> None:
    partial = path.with_name(f".{path.name}.{os.getpid()}")  # several processes may make the same one
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("wb") as file:
            np.save(file, made.numpy())
        os.replace(partial, path)
    except OSError:  # a cache that cannot be written costs a tenth of a second a scene
        with suppress(OSError):
            partial.unlink()
