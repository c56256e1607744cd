"""Wood: planks, parquet, raw timber, bark."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nets.data.procedural.compose import (
    Colour,
    MaterialMaps,
    blend,
    cavity,
    choose,
    finish,
    lerp,
    rgb,
    shade,
    shades,
    tilted,
)
from nets.data.procedural.layout import Blocks, basket, courses, herringbone
from nets.data.procedural.noise import (
    Field,
    Real,
    bent,
    cells,
    grid,
    log_uniform,
    patches,
    pick,
    rotated,
    scattered,
    smoothstep,
    spectral,
    unit,
)

_TIMBER = ("#a9794c", "#7a4e2d", "#c69c6d", "#5b3520", "#d8b98a", "#8d5a3a", "#4a3226", "#b58a63", "#93867a")


@dataclass(frozen=True)
class _Timber:
    """What the tree left in a sawn face, each `[H, W]` in [0, 1]."""

    late: Field  # the dark, hard end of a year's ring
    fibre: Field  # fine streaks along the grain
    pore: Field  # short open vessels: dark and deep


def _timber(rng: np.random.Generator, blocks: Blocks) -> _Timber:
    """Rings and fibres along each block; every block is cut from its own part of the tree."""
    size = blocks.edge.shape[0]
    # A board cuts the cone of rings at its own distance from the pith: straight lines or cathedral arches.
    pith = pick(rng, blocks.index, -0.4, 0.4)
    arch = pick(rng, blocks.index, 0.0, 0.25)
    along = blocks.along + pick(rng, blocks.index, -0.8, 0.8)
    wander = scattered(rng, spectral(rng, size, 1.5, 40, 2.2, stretch=5), blocks.index, blocks.turned)
    radius = np.hypot(blocks.across - pith, 0.06) + arch * along**2 + rng.uniform(0.015, 0.05) * wander
    ring = radius * log_uniform(rng, 8, 26)
    ring = ring - np.floor(ring)
    late = ring ** rng.uniform(1.5, 4) * (1 - smoothstep(0.9, 1, ring))
    fine = spectral(rng, size, 25, slope=1, stretch=rng.uniform(15, 40))
    fibre = unit(scattered(rng, fine, blocks.index, blocks.turned))
    dash = spectral(rng, size, 40, slope=2, stretch=rng.uniform(5, 12))
    pore = patches(scattered(rng, dash, blocks.index, blocks.turned), rng.uniform(0.0, 0.12), 0.3)
    return _Timber(late, fibre, pore)


def _wood(rng: np.random.Generator, blocks: Blocks, joint: float, board_spread: float) -> MaterialMaps:
    """Boards with open joints `joint` wide, anywhere from sanded and varnished to weathered raw."""
    size = blocks.edge.shape[0]
    timber = _timber(rng, blocks)
    varnish = float(rng.random() < 0.5) * rng.uniform(0.5, 1)
    wear = patches(spectral(rng, size, 2, slope=1.5), rng.uniform(0, 0.5), 1.2)
    board = smoothstep(0, 1.5 * joint, blocks.edge - 0.5 * joint)
    tone = pick(rng, blocks.index)

    colour: Colour = shades(rng, choose(rng, _TIMBER), tone, board_spread)
    colour = blend(colour, colour * rgb(0.5, 0.42, 0.36), timber.late * rng.uniform(0.3, 0.9))
    colour = shade(colour, (0.82 + 0.36 * timber.fibre) * (1 - 0.5 * timber.pore))
    grey = shade(rgb(0.9, 0.92, 0.95), 0.9 * colour.mean(-1) + 0.05)
    colour = blend(colour, grey, wear * (1 - varnish) * rng.uniform(0, 0.9))
    colour = blend(colour * np.float32(0.15), colour, board)

    relief = rng.uniform(2, 7) * (1 - 0.7 * varnish)
    fine = tilted(0.4 * timber.late + 0.5 * timber.fibre - timber.pore, relief) * board
    askew = (blocks.across * pick(rng, blocks.index, -1, 1) + 0.4 * blocks.along) * 0.02
    height = board * (rng.uniform(0.6, 1.2) * joint + 0.3 * joint * tone + askew) + fine

    raw = 0.75 - 0.15 * timber.late + 0.12 * timber.fibre + 0.1 * timber.pore
    coat = rng.uniform(0.12, 0.4) + 0.06 * (1 - timber.late) + 0.1 * timber.pore + 0.3 * wear
    roughness = lerp(0.9, lerp(raw, coat, np.full_like(raw, varnish)), board)
    specular = (0.035 + 0.012 * varnish) * (0.5 + 0.5 * board)
    return finish(rng, height, colour, roughness, specular, grain=1.1 - 0.8 * varnish)


def wood_planks(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Parallel boards of random offsets; floor boards, decking, sheds."""
    x, y = grid(size)
    if rng.random() < 0.5:
        x, y = y, -x
    x, y = bent(rng, x, y, 0.002)
    width = log_uniform(rng, 0.16, 0.55)
    blocks = courses(x, y, width * rng.uniform(4, 9), width, rng.random(23))
    return _wood(rng, _upright(blocks, size, x), log_uniform(rng, 0.006, 0.03), rng.uniform(0.1, 0.4))


def _upright(blocks: Blocks, size: int, x: Real) -> Blocks:
    """The blocks, marked as turned if the coordinates they were laid in were."""
    vertical = abs(float(x[0, -1] - x[0, 0])) < 1
    turned = np.full((size, size), vertical)
    return Blocks(blocks.along, blocks.across, blocks.edge, blocks.index, turned)


def raw_wood(rng: np.random.Generator, size: int) -> MaterialMaps:
    """One wide sawn or planed face, with knots now and then."""
    x, y = grid(size)
    if rng.random() < 0.5:
        x, y = y, -x
    for _ in range(int(rng.integers(0, 4))):  # rings flow around a knot: push the coordinate across the grain
        kx, ky, radius = rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(0.05, 0.14)
        far = ((x - kx) / (2.5 * radius)) ** 2 + ((y - ky) / radius) ** 2
        y = y - (y - ky) * np.exp(-far / 2) * np.float32(0.85)
    index = np.zeros(x.shape, dtype=np.intp)
    blocks = Blocks(x, y, np.ones_like(x), index, np.zeros(x.shape, dtype=bool))
    return _wood(rng, _upright(blocks, size, x), 0.01, 0.05)


def parquet(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Small blocks laid in herringbone or basket pattern, tightly jointed."""
    x, y = rotated(*grid(size), rng.choice([0.0, np.pi / 4]))
    width = log_uniform(rng, 0.09, 0.24)
    ratio = int(rng.integers(3, 6))
    blocks = herringbone(x, y, width, ratio) if rng.random() < 0.6 else basket(x, y, width, ratio)
    return _wood(rng, blocks, log_uniform(rng, 0.003, 0.01), rng.uniform(0.15, 0.5))


def bark(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Long plates between deep, ragged fissures, with lichen on some."""
    x, y = bent(rng, *grid(size), rng.uniform(0.03, 0.08), low=6, slope=2)
    plate = cells(rng, x, y, rng.uniform(5, 11), aspect=rng.uniform(0.25, 0.5))
    raised = smoothstep(0.0, rng.uniform(0.05, 0.12), plate.edge)
    ridges = spectral(rng, size, 8, slope=1.6, stretch=3, angle=np.pi / 2)
    flakes = cells(rng, x + 0.03 * ridges, y, 18, aspect=0.5)
    height = tilted(raised + 0.25 * ridges * raised + 0.3 * pick(rng, flakes.index), rng.uniform(14, 24))
    colour = choose(rng, ("#5a4636", "#6e5a49", "#3d2f26", "#857668", "#8a5f45"))
    diffuse = shades(rng, colour, unit(ridges + pick(rng, flakes.index, -1, 1)), 0.4)
    diffuse = blend(diffuse * np.float32(0.3), diffuse, raised)
    lichen = patches(spectral(rng, size, 4, slope=1.3), rng.uniform(0, 0.25), 0.2) * raised
    diffuse = blend(diffuse, choose(rng, ("#8f9a72", "#b5b58a", "#a9b0a0")), 0.7 * lichen)
    roughness = 0.88 - 0.1 * raised + 0.04 * cavity(height, 0.05)
    return finish(rng, height, diffuse, roughness, 0.03 + 0.01 * raised, grain=1.4)
