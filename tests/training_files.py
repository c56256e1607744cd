"""What a tiny training needs on disk: a pool, a folder of strips, real pairs, a plan."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from nets.color import linear_to_srgb
from nets.data import pool as pool_module
from nets.data.images import write_image
from nets.data.pool import Entry, build_pool
from nets.data.strips import write_strip
from nets.render import render
from tests.helpers import random_light, random_svbrdf

GENERATOR = {"width": 2, "levels": 3, "deep_multiplier": 2}
CRITICS = {"width": 2, "layers": 1, "scales": 1}
NO_VGG = {"rendering": {"perceptual": 0.0}}
PHASES = [{"iterations": 4, "crop": 16, "batch": 2}]

STAGES: dict[str, dict[str, Any]] = {
    "l1": {"name": "l1", "objective": {"kind": "l1"}, "phases": PHASES},
    "syn": {"name": "syn", "objective": {"kind": "synthetic", **NO_VGG}, "phases": PHASES},
    "hyb": {
        "name": "hyb",
        "objective": {"kind": "hybrid", "synthetic": NO_VGG},
        "phases": PHASES,
        "pairs": 1,
    },
    "light": {"name": "light", "objective": {"kind": "light"}, "parts": ["light_head"], "phases": PHASES},
    "des18": {
        "name": "des18",
        "network": {"kind": "des18", **GENERATOR},
        "objective": {"kind": "des18"},
        "phases": PHASES,
    },
    "des19": {
        "name": "des19",
        "network": {"kind": "des19", **GENERATOR},
        "objective": {"kind": "des19"},
        "phases": PHASES,
    },
    "gao19": {
        "name": "gao19",
        "network": {"kind": "autoencoder", "width": 2},
        "objective": {"kind": "gao19"},
        "phases": [{"iterations": 4, "crop": 32, "batch": 2}],
    },
}


def entry(name: str, kind: str, collection: str, seed: int) -> Entry:
    return Entry(name, kind, collection, "whole", seed, "Apache-2.0")


def write_pool(folder: Path, entries: Sequence[Entry], size: int = 24) -> Path:
    """Store random materials under the given names and kinds."""

    def make(entry: Entry, size: int) -> torch.Tensor:
        return pool_module.encode(random_svbrdf(1, size, size, seed=entry.seed))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool_module, "make", make)
        patch.setattr(pool_module, "plan", lambda *arguments, **more: list(entries))
        build_pool(folder, size=size, procedural=len(entries), workers=0)
    return folder


def write_strips(folder: Path, count: int, size: int = 24) -> Path:
    """Write strips of four tiles, named by number."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        write_strip(folder / f"{number:03}.png", random_svbrdf(1, size, size, seed=number))
    return folder


def write_pairs(folder: Path, scenes: int = 2, size: int = 24) -> Path:
    """Write scenes of two photos of one surface."""
    for scene in range(scenes):
        (folder / f"scene{scene}").mkdir(parents=True, exist_ok=True)
        surface = random_svbrdf(1, size, size, seed=50 + scene)
        for number in range(2):
            photo = linear_to_srgb(render(surface, random_light(1, seed=number)).clamp(0.0, 1.0))
            pixels = np.rint(photo[0].permute(1, 2, 0).numpy() * 255.0).astype(np.uint8)
            write_image(folder / f"scene{scene}" / f"{number}.png", pixels)
    return folder


def write_plan(path: Path, *stages: dict[str, Any], **entries: Any) -> Path:
    """Write a plan of tiny networks."""
    plan = {"generator": GENERATOR, "critics": CRITICS, "stages": list(stages), **entries}
    path.write_text(yaml.safe_dump(plan), encoding="utf-8")
    return path
