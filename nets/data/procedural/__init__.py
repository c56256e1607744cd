"""Procedural materials: endless, seeded training data that agrees with itself.

    maps = generate("brick", size=320, seed=7)      # maps.height, .normal, .diffuse, .roughness, .specular
    family, maps = random_material(320, seed=8)     # never one of HELD_OUT_FAMILIES

Each family composes one height field and derives colour, roughness and F0 from the same structure.
Pure numpy and scipy; reads no files and no global state. Conventions: see `MaterialMaps`.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence

import numpy as np

from nets.data.procedural import (
    fabric,
    manmade,
    masonry,
    metal,
    mineral,
    pavement,
    plate,
    sheet,
    upholstery,
    wood,
)
from nets.data.procedural.compose import MaterialMaps, normal_from_height

__all__ = [
    "FAMILIES",
    "HELD_OUT_FAMILIES",
    "TRAINING_FAMILIES",
    "MaterialMaps",
    "generate",
    "normal_from_height",
    "random_material",
]

Family = Callable[[np.random.Generator, int], MaterialMaps]

_ALL: tuple[Family, ...] = (
    *(wood.wood_planks, wood.raw_wood, wood.parquet, wood.bark),
    *(masonry.brick, masonry.cobblestone, masonry.stone_wall, masonry.slate),
    *(masonry.glazed_tile, masonry.mosaic_tile, masonry.terracotta),
    *(mineral.plaster, mineral.concrete, mineral.gravel, mineral.marble, mineral.granite, mineral.terrazzo),
    *(mineral.sand, mineral.cracked_mud, mineral.moss_ground),
    *(fabric.woven_fabric, fabric.denim, fabric.knit_fabric, fabric.carpet, fabric.leather),
    *(metal.brushed_metal, metal.scratched_metal, metal.hammered_metal, metal.diamond_plate),
    *(metal.galvanized, metal.rusted_paint, metal.flake_paint),
    *(manmade.paper, manmade.cardboard, manmade.plastic_grain, manmade.printed_plastic),
    *(manmade.rubber_mat, manmade.cracked_paint),
    *(plate.tread_plate, plate.stamped_sheet, plate.knurled_metal, plate.wire_mesh),
    *(sheet.corrugated_sheet, sheet.riveted_panel, sheet.pressed_tin),
    *(pavement.setts, pavement.rounded_cobbles, pavement.pillowed_tile),
    *(upholstery.tufted_leather, upholstery.quilted_leather),
)

FAMILIES: dict[str, Family] = {family.__name__: family for family in _ALL}

# One laid, one cast, one textile, one metal: unseen in training, kept for the built-in test set.
HELD_OUT_FAMILIES: frozenset[str] = frozenset({"mosaic_tile", "cracked_mud", "knit_fabric", "hammered_metal"})

TRAINING_FAMILIES: tuple[str, ...] = tuple(name for name in FAMILIES if name not in HELD_OUT_FAMILIES)


def generate(family: str, size: int, seed: int) -> MaterialMaps:
    """A `size` x `size` material of the named family; the same arguments give the same bytes."""
    if family not in FAMILIES:
        raise ValueError(f"unknown family {family!r}; known are {', '.join(sorted(FAMILIES))}")
    if size < 16:
        raise ValueError(f"size must be at least 16 pixels, got {size}")
    # The name enters the seed, so that two families of one seed do not share their noise.
    rng = np.random.default_rng([zlib.crc32(family.encode()), seed])
    return FAMILIES[family](rng, size)


def random_material(size: int, seed: int, families: Sequence[str] | None = None) -> tuple[str, MaterialMaps]:
    """A seeded draw of a family (of `families`, or of all but the held-out ones) and of a material in it."""
    names = TRAINING_FAMILIES if families is None else tuple(families)
    if not names:
        raise ValueError("no families to choose from")
    family = names[int(np.random.default_rng([zlib.crc32(b"family"), seed]).integers(len(names)))]
    return family, generate(family, size, seed)
