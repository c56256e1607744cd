"""The built-in test set: its names, its cache, and that no training sees its families."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
import torch

from eval import held_out
from nets.data.pool import plan
from nets.data.pool_format import decode, from_planes
from nets.data.procedural import TRAINING_FAMILIES, generate


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_132_materials_of_families_that_no_pool_holds() -> None:
    names = held_out.scene_names()
    assert len(names) == len(set(names)) == 132
    families = Counter(name.rpartition("_")[0] for name in names)
    assert set(families.values()) == {33}
    assert not set(families) & set(TRAINING_FAMILIES)
    assert not set(families) & {entry.collection for entry in plan([], size=64, procedural=200, seed=0)}


def test_materials_are_made_once_and_kept(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = held_out.material("mosaic_tile_05")
    exact = from_planes(generate("mosaic_tile", 256, held_out.FIRST_SEED + 5))
    assert float((decode(made).diffuse - exact.diffuse).abs().max()) < 0.005  # 8 bits of the root
    (kept,) = cache.rglob("*.npy")
    monkeypatch.setattr(held_out, "generate", None)  # not called again
    assert torch.equal(held_out.material("mosaic_tile_05"), made)
    assert [path.name for path in kept.parent.iterdir()] == ["mosaic_tile_05.npy"]


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY torn", b"words"])
def test_a_damaged_cache_is_mended(cache: Path, content: bytes) -> None:
    made = held_out.material("knit_fabric_00")
    (kept,) = cache.rglob("*.npy")
    whole = kept.read_bytes()
    kept.write_bytes(content)
    assert torch.equal(held_out.material("knit_fabric_00"), made)
    assert kept.read_bytes() == whole


def test_no_cache_is_no_hindrance(cache: Path) -> None:
    cache.write_bytes(b"a file where the folder would be")
    assert held_out.material("cracked_mud_01").shape == (1, 10, 256, 256)
