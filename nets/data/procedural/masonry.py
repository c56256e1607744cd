"""Things laid in courses or set side by side: brick, cobble, rubble stone, slate, tiles."""

from __future__ import annotations

import numpy as np

from nets.data.procedural.compose import (
    Colour,
    MaterialMaps,
    blend,
    cavity,
    choose,
    dye,
    finish,
    lerp,
    shade,
    shades,
    tilted,
)
from nets.data.procedural.layout import Blocks, basket, courses, herringbone
from nets.data.procedural.noise import (
    Field,
    bent,
    cells,
    grid,
    lean,
    log_uniform,
    patches,
    pick,
    rotated,
    scattered,
    smoothstep,
    spectral,
    strokes,
    unit,
)

_CLAY = ("#9c4a34", "#7d3b2c", "#b5654a", "#c98f6b", "#5f3a33", "#d0b090", "#a8553a", "#8f8578")
_STONE = ("#8b857b", "#6f6c68", "#a59a86", "#5d5a57", "#b8ab94", "#7d7263", "#9a8f8a", "#6a6f74")
_LIME: Colour = np.array([0.6, 0.57, 0.52], dtype=np.float32)  # efflorescence
_MORTAR = ("#a9a49a", "#8c8780", "#c2bbae", "#6a6661", "#b8a890")


def _mortar(rng: np.random.Generator, size: int) -> tuple[Colour, Field]:
    """Colour `[3]` and sandy relief `[H, W]` of what fills the joints."""
    sand = spectral(rng, size, 30, slope=0.7)
    return choose(rng, _MORTAR), tilted(sand, rng.uniform(5, 10))


def brick(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Fired or painted bricks in running, stack or herringbone bond, chipped, with sandy mortar."""
    x, y = bent(rng, *grid(size), rng.uniform(0.002, 0.006), low=8)
    width = log_uniform(rng, 0.15, 0.42)
    bond = rng.choice(["running", "running", "third", "stack", "herringbone"])
    if bond == "herringbone":
        blocks = herringbone(*rotated(x, y, rng.choice([0.0, np.pi / 4])), width, 2)
    else:
        shift = {"running": [0, 0.5], "third": [0, 0.33, 0.66], "stack": [0.0]}[bond]
        blocks = courses(x, y, width * rng.uniform(2.2, 3.3), width, np.array(shift))
    gap, chips = width * rng.uniform(0.04, 0.09), spectral(rng, size, 12, slope=1.2)
    edge = blocks.edge - gap - width * rng.uniform(0.005, 0.03) * chips
    face = smoothstep(0, width * rng.uniform(0.06, 0.15), edge)

    body = scattered(rng, spectral(rng, size, 3, slope=1.1), blocks.index)
    pits = patches(spectral(rng, size, 35, slope=1.5), rng.uniform(0.0, 0.15), 0.4) * face
    filler, sand = _mortar(rng, size)
    clay = shades(rng, choose(rng, _CLAY), pick(rng, blocks.index), rng.uniform(0.1, 0.5))
    clay = shade(clay, 1 + 0.16 * body - 0.3 * pits)
    if rng.random() < 0.25:  # painted over, flaking
        paint = patches(0.6 * body + spectral(rng, size, 3, slope=1.2), rng.uniform(0.5, 1), 0.1)
        clay, filler = blend(clay, dye(rng, (0, 0.3)), paint), filler * np.float32(0.9)
    soot = unit(spectral(rng, size, 2, slope=1.5))
    diffuse = shade(blend(shade(filler, 1 + 0.1 * chips), clay, face), 0.8 + 0.35 * soot)
    fired = rng.uniform(0.45, 0.85)
    height = (
        face * (width * rng.uniform(0.06, 0.14) + lean(rng, blocks.index, blocks.along, blocks.across, 0.05))
        + (1 - face) * sand
    )
    height = height + face * tilted(body - 2 * pits, rng.uniform(4, 10))
    roughness = lerp(0.93, fired + 0.05 * body + 0.12 * pits, face)
    return finish(rng, height, diffuse, roughness, lerp(0.03, 0.042, face), grain=1.2)


def cobblestone(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Rounded setts or river cobbles in sandy joints, polished on their crowns; sometimes wet."""
    x, y = bent(rng, *grid(size), 0.015, low=5, slope=3)
    count = log_uniform(rng, 4.5, 11)
    stones = cells(rng, x, y, count, jitter=rng.uniform(0.45, 0.9))
    reach = 1.0 / count
    edge = stones.edge - reach * (rng.uniform(0.08, 0.18) + 0.04 * spectral(rng, size, 8, slope=2))
    bulge = np.clip(edge / (reach * rng.uniform(0.4, 0.8)), 0, 1)
    crown = np.sqrt(bulge * (2 - bulge))  # round at the rim, level on top
    face = smoothstep(0, 0.25, crown)
    body = scattered(rng, spectral(rng, size, 6, slope=1.2), stones.index)
    filler, sand = _mortar(rng, size)
    filler = filler * np.float32(rng.uniform(0.25, 0.8))
    stone = shades(rng, choose(rng, _STONE), pick(rng, stones.index), 0.35)
    diffuse = blend(shade(filler, 1 + 0.2 * unit(sand)), shade(stone, 1 + 0.15 * body), face)
    height = reach * rng.uniform(0.15, 0.35) * crown * pick(rng, stones.index, 0.75, 1.0)
    height = height + tilted(body, rng.uniform(2, 5)) * face + 0.7 * sand * (1 - face)
    wet = float(rng.random() < 0.35) * smoothstep(-1.0, 1.5, cavity(height, 0.1) + spectral(rng, size, 2))
    diffuse = shade(diffuse, 1 - 0.45 * wet)
    polish = rng.uniform(0.1, 0.4) * smoothstep(0.6, 1, crown)
    roughness = lerp(0.92, 0.78 - polish + 0.05 * body, face) * (1 - 0.7 * wet)
    return finish(rng, height, diffuse, roughness, 0.04 - 0.01 * (1 - face) * (1 - wet))


def stone_wall(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Rough hewn blocks, flat or bulging, in irregular courses."""
    x, y = bent(rng, *grid(size), 0.035, low=3, slope=2)
    stones = cells(
        rng, x, y, rng.uniform(2.5, 6), aspect=rng.uniform(1.0, 2.0), jitter=rng.uniform(0.5, 0.85)
    )
    hewn = spectral(rng, size, 5, slope=1.7)
    edge = stones.edge - rng.uniform(0.012, 0.03) - 0.006 * hewn
    face = smoothstep(0, rng.uniform(0.02, 0.06), edge)
    body = scattered(rng, spectral(rng, size, 3, slope=1.5), stones.index)
    chisel = tilted(body + 0.4 * scattered(rng, np.abs(hewn), stones.index), rng.uniform(6, 12))
    tilt = lean(rng, stones.index, stones.dx, stones.dy, 0.15)
    filler, sand = _mortar(rng, size)
    colour = shades(rng, choose(rng, _STONE), pick(rng, stones.index), rng.uniform(0.2, 0.5))
    stain = unit(spectral(rng, size, 2, slope=1.3))
    colour = blend(shade(colour, 1 + 0.14 * body), choose(rng, _STONE), 0.4 * stain)
    height = face * (0.035 + tilt + chisel) + (1 - face) * sand
    roughness = lerp(0.92, 0.74 + 0.06 * body - 0.1 * stain, face)
    return finish(rng, height, blend(filler, colour, face), roughness, lerp(0.03, 0.04, face), grain=1.3)


def slate(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Riven slate: flat terraces that end in thin broken steps, as slabs or one face; sometimes sealed."""
    x, y = grid(size)
    angle = rng.uniform(0, np.pi)
    sheet = spectral(rng, size, 1.5, slope=1.9, stretch=rng.uniform(1, 2.5), angle=angle)
    level = sheet * rng.uniform(2, 5)
    terraces = np.floor(level) + smoothstep(0.8, 1.0, level - np.floor(level))
    ripple = spectral(rng, size, 10, slope=1.4, stretch=2, angle=angle)
    height = tilted(terraces + 0.35 * ripple, rng.uniform(5, 11))
    colour = choose(rng, ("#4a4f55", "#5c6065", "#3b3f3f", "#5b5a4e", "#544a50", "#6b6a66"))
    rust = patches(spectral(rng, size, 2.5, slope=1.4), rng.uniform(0, 0.3), 0.4)
    diffuse = shades(rng, colour, unit(terraces - terraces.mean() + ripple), 0.2)
    diffuse = blend(diffuse, choose(rng, ("#8a6a45", "#7a5a40")), 0.5 * rust)
    sealed = rng.uniform(0.2, 0.45) if rng.random() < 0.5 else rng.uniform(0.5, 0.75)
    roughness = sealed + 0.05 * ripple + 0.15 * rust
    specular = np.full_like(x, 0.045)
    if rng.random() < 0.6:
        width = log_uniform(rng, 0.4, 0.9)
        blocks = courses(x, y, width * rng.uniform(1, 2), width, np.array([0, rng.choice([0, 0.5])]))
        face = smoothstep(0, 0.02, blocks.edge - 0.015 - 0.004 * ripple)
        height = face * (0.03 + scattered(rng, height, blocks.index)) + tilted(ripple, 6) * (1 - face)
        diffuse = blend(choose(rng, _MORTAR), shade(diffuse, pick(rng, blocks.index, 0.75, 1.2)), face)
        roughness, specular = lerp(0.9, roughness, face), lerp(0.03, 0.045, face)
    return finish(rng, height, diffuse, roughness, specular, grain=0.9)


def _tiles(rng: np.random.Generator, size: int, width: float) -> Blocks:
    """Square or oblong tiles, straight or on the diagonal."""
    x, y = rotated(*grid(size), rng.choice([0.0, 0.0, np.pi / 4]))
    if rng.random() < 0.2:
        return basket(x, y, width / 2, 2)
    aspect = rng.choice([1.0, 1.0, 2.0])
    return courses(x, y, width * aspect, width, np.array([0, rng.choice([0, 0.5])]))


def glazed_tile(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Ceramic under a wavy glaze that pools and thins at the rims; rough grout; crazing or a motif."""
    width = log_uniform(rng, 0.22, 0.7)
    blocks = _tiles(rng, size, width)
    gap = width * rng.uniform(0.015, 0.05)
    face = smoothstep(0, 0.012, blocks.edge - gap)
    rim = np.exp(-np.maximum(blocks.edge - gap, 0) / (0.06 * width))
    pool = scattered(rng, spectral(rng, size, 3, slope=2.5), blocks.index)
    colour = shades(rng, dye(rng), pick(rng, blocks.index), rng.uniform(0.02, 0.25))
    if rng.random() < 0.35:  # a painted motif, repeated on every tile
        reach = np.hypot(blocks.along, blocks.across) / width
        petals = np.cos(4 * rng.integers(1, 3) * np.arctan2(blocks.across, blocks.along))
        motif = smoothstep(-0.01, 0.01, rng.uniform(0.22, 0.4) + 0.12 * petals - reach)
        colour = blend(colour, dye(rng), motif * (0.9 + 0.1 * unit(pool)))
    craze = cells(rng, *bent(rng, *grid(size), 0.01, low=8), rng.uniform(18, 40))
    crack = (1 - smoothstep(0.0, 0.006, craze.edge)) * float(rng.random() < 0.3)
    colour = shade(colour, (1 + 0.12 * pool + 0.15 * rim) * (1 - 0.4 * crack))
    filler, sand = _mortar(rng, size)
    height = face * (
        0.012 + 0.2 * gap * pool + lean(rng, blocks.index, blocks.along, blocks.across, 0.03) - 0.006 * rim
    )
    height = height + face * tilted(pool, rng.uniform(1, 4)) + (1 - face) * sand
    gloss = rng.uniform(0.08, 0.3) if rng.random() < 0.75 else rng.uniform(0.35, 0.6)
    dirt = unit(spectral(rng, size, 3, slope=1.2)) ** 3
    roughness = lerp(0.9, gloss + 0.15 * dirt + 0.25 * crack + 0.05 * rim, face)
    return finish(rng, height, blend(filler, colour, face), roughness, lerp(0.03, 0.05, face), grain=0.35)


def mosaic_tile(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Small tesserae, cut square or broken, of several colours, glass or stone, each set askew."""
    x, y = bent(rng, *grid(size), 0.008, low=4)
    width = log_uniform(rng, 0.08, 0.2)
    if rng.random() < 0.6:
        blocks = courses(x, y, width, width, np.zeros(1))
    else:
        shards = cells(rng, x, y, 2 / width, jitter=0.75)
        blocks = Blocks(shards.dx, shards.dy, shards.edge, shards.index, np.zeros(x.shape, dtype=bool))
    face = smoothstep(0, 0.012, blocks.edge - 0.05 * width - 0.003 * spectral(rng, size, 20, slope=1.5))
    tints = np.stack([dye(rng) for _ in range(int(rng.integers(2, 6)))])
    share = rng.integers(0, len(tints), int(blocks.index.max()) + 1)
    colour = shade(tints[share][blocks.index], pick(rng, blocks.index, 0.6, 1.25))
    body = scattered(rng, spectral(rng, size, 5, slope=1.5), blocks.index)
    glass = rng.random() < 0.6
    base = rng.uniform(0.08, 0.25) if glass else rng.uniform(0.4, 0.7)
    filler, sand = _mortar(rng, size)
    height = (
        face * (0.008 + lean(rng, blocks.index, blocks.along, blocks.across, 0.1))
        + face * tilted(body, 3)
        + (1 - face) * sand
    )
    roughness = lerp(0.9, base + pick(rng, blocks.index, 0, 0.15) + 0.03 * body, face)
    diffuse = blend(filler, shade(colour, 1 + 0.12 * body), face)
    return finish(rng, height, diffuse, roughness, lerp(0.03, 0.05 if glass else 0.04, face), grain=0.5)


def terracotta(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Unglazed fired tiles with fire clouds, lime bloom and worn, polished middles; now and then waxed."""
    width = log_uniform(rng, 0.45, 1.0)
    blocks = _tiles(rng, size, width)
    body = scattered(rng, spectral(rng, size, 2, slope=1.3), blocks.index)
    face = smoothstep(0, 0.04, blocks.edge - 0.03 * width - 0.006 * spectral(rng, size, 8, slope=1.5))
    filler, sand = _mortar(rng, size)
    clay = shades(
        rng, choose(rng, ("#b5673f", "#a65a3c", "#c98058", "#8f4a35")), pick(rng, blocks.index), 0.2
    )
    clay = shade(clay, 1 + 0.2 * body)
    bloom = patches(spectral(rng, size, 3, slope=1.0), rng.uniform(0, 0.3), 0.6) * face
    pores = patches(spectral(rng, size, 40, slope=2), 0.05, 0.3) * face
    lines = strokes(rng, size, 60, 0.5, spread=0.15, curl=0.1) * face
    diffuse = blend(blend(filler, shade(clay, 1 - 0.3 * pores), face), _LIME, 0.35 * bloom)
    worn = smoothstep(0.1 * width, 0.45 * width, blocks.edge)
    height = face * (
        0.03
        + lean(rng, blocks.index, blocks.along, blocks.across, 0.04)
        + tilted(body - pores, rng.uniform(3, 7))
    ) + sand * (1 - face)
    height = height - 0.002 * lines
    base = rng.uniform(0.3, 0.5) if rng.random() < 0.4 else rng.uniform(0.65, 0.85)
    roughness = lerp(0.92, base - 0.1 * worn + 0.15 * bloom + 0.1 * lines, face)
    return finish(rng, height, diffuse, roughness, lerp(0.03, 0.04, face))
