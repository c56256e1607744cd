"""How a pool stores a material: its entry in the index, its 8-bit encoding, its part. No array files here.

Channels are normal (n + 1) / 2, diffuse as its square root (dark albedo needs the codes), roughness as it
is, specular as its square root.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from nets.data.images import ROUGHNESS_FLOOR, unit_normal
from nets.data.procedural import MaterialMaps
from nets.svbrdf import SVBRDF

LICENCES = {"infinigen": "BSD-3-Clause (generator)", "unity_measured": "MIT"}
"""Licences of folder collections (`collection__name`); see `licence_of`."""

DEFAULT_LICENCE = "CC0-1.0"
"""Licence of the other collections of the training data (ambientCG, cgbookcase, Poly Haven)."""

Part = Literal["train", "validation"]


@dataclass(frozen=True)
class Entry:
    """Where one material of a pool comes from.

    Attributes:
        name: of the source; variants of one source share it.
        kind: `procedural` or `pbr`.
        collection: procedural family, or the folder's name up to `__`.
        variant: `whole` or `crop`.
        seed: of the generator or the crop.
        licence: as far as known.
        source: the folder, or empty.
    """

    name: str
    kind: Literal["procedural", "pbr"]
    collection: str
    variant: Literal["whole", "crop"]
    seed: int
    licence: str
    source: str = ""


def encode(svbrdf: SVBRDF) -> UInt8[Tensor, "batch 10 h w"]:
    """Quantise materials to the pool's 8-bit encoding."""
    maps = [(svbrdf.normal + 1.0) / 2.0, svbrdf.diffuse.sqrt(), svbrdf.roughness, svbrdf.specular.sqrt()]
    return (torch.cat(maps, dim=1).clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)


def decode(stored: UInt8[Tensor, "batch 10 h w"]) -> SVBRDF:
    """Invert `encode`; returns legal float32 materials."""
    maps = stored.float().mul_(1.0 / 255.0)  # in place from here on: this runs for every training batch
    maps[:, 3:6].square_()
    maps[:, 7:10].square_()
    maps[:, 6].clamp_(min=ROUGHNESS_FLOOR)
    maps[:, :3] = unit_normal(maps[:, :3].mul_(2.0).sub_(1.0))
    return SVBRDF.from_channels(maps)


def part_of(name: str, holdout: float = 0.05) -> Part:
    """Say whether a source is trained on or kept for validation: by a hash of its name, so for good.

    Args:
        name: of the source (`Entry.name`); all its variants fall in one part.
        holdout: share of names kept for validation.
    """
    digest = hashlib.sha256(name.encode()).digest()
    return "validation" if int.from_bytes(digest[:8], "big") < holdout * 2**64 else "train"


def licence_of(folder: Path) -> str:
    """Return the licence of a material folder: first line of its LICENSE file, or its collection's."""
    for name in ("LICENSE", "LICENSE.txt", "LICENCE", "LICENCE.txt"):
        if (folder / name).is_file():
            return (folder / name).read_text(encoding="utf-8", errors="replace").strip().split("\n")[0]
    return LICENCES.get(folder.name.split("__")[0], DEFAULT_LICENCE)


def from_planes(maps: MaterialMaps) -> SVBRDF:
    """Turn a generated material (numpy, HWC) into a batch of one, validated."""
    planes = [maps.normal, maps.diffuse, maps.roughness[..., None], maps.specular]
    stacked = np.ascontiguousarray(np.concatenate(planes, axis=2).transpose(2, 0, 1), dtype=np.float32)
    return SVBRDF.from_channels(torch.from_numpy(stacked)[None]).validate()
