"""Stones and tiles with rounded backs in deep joints: setts, cobbles, pillowed tiles."""

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
    rgb,
    shade,
    shades,
    tilted,
)
from nets.data.procedural.layout import courses, herringbone
from nets.data.procedural.noise import (
    Field,
    Index,
    Real,
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
from nets.data.procedural.relief import box, hexagons, padded, scales, shoulder, softened

_STONE = ("#8b857b", "#6f6c68", "#a59a86", "#5d5a57", "#b8ab94", "#7d7263", "#9a8f8a", "#6a6f74", "#8f6f5f")
_SOIL = ("#4a4036", "#6b5d4a", "#8a7d68", "#3a352f", "#9a9488", "#58503f")


def _joint(rng: np.random.Generator, size: int) -> tuple[Colour, Field]:
    """Colour and relief of sand, soil, small gravel or moss between stones."""
    grains = cells(rng, *grid(size), rng.uniform(50, 110))
    lumps = spectral(rng, size, 15, slope=1.2)
    kind = str(rng.choice(["sand", "soil", "gravel", "moss"]))
    if kind == "gravel":
        colour = shade(choose(rng, _SOIL), pick(rng, grains.index, 0.5, 1.5))
        relief = shoulder(grains.edge, 0.008, 45, 2)
    else:
        green = choose(rng, ("#4a5a2a", "#5f6a35", "#3b4520")) if kind == "moss" else choose(rng, _SOIL)
        colour = shades(rng, green, unit(lumps), 0.4)
        relief = tilted(spectral(rng, size, 30, slope=0.8), rng.uniform(5, 12))
    return colour, np.asarray(relief + tilted(lumps, rng.uniform(3, 9)), dtype=np.float32)


def _stones(
    rng: np.random.Generator,
    inside: Real,
    index: Index,
    u: Real,
    v: Real,
    reach: float,
    roundness: tuple[float, float],
) -> MaterialMaps:
    """Stones from the distance into their outlines.

    `reach` is half of a stone's width; `roundness` the range of how much of it the shoulders take.
    """
    size = inside.shape[0]
    body = scattered(rng, spectral(rng, size, 5, slope=rng.uniform(1.0, 1.7)), index)
    rough = spectral(rng, size, 14, slope=1.3)
    gnaw = 0.03 * body + rng.uniform(0.005, 0.04) * spectral(rng, size, 10, 40, slope=2)
    gnawed = inside - reach * gnaw
    bevel = reach * log_uniform(rng, *roundness)
    shoulders = softened(shoulder(gnawed, bevel, rng.uniform(38, 58), rng.uniform(1.3, 2.6)), 0.006)
    crown = shoulder(gnawed, 1.1 * reach, rng.uniform(2, 25), 2.0)
    crown = padded(shoulders + crown, gnawed, 0.2 * reach)
    split = float(rng.random() < 0.4)  # riven with a hammer, or worn smooth
    facets = scattered(rng, np.abs(spectral(rng, size, 3, slope=1.8)), index)
    face = smoothstep(0, 0.35 * bevel, gnawed)
    tilt = lean(rng, index, u, v, rng.uniform(0.02, 0.1)) + pick(rng, index, -0.06, 0.06) * reach
    texture = tilted(body + 0.5 * rough, rng.uniform(2, 6)) + split * tilted(facets, rng.uniform(4, 9))
    filling, grit = _joint(rng, size)
    fill = rng.uniform(0.0, 0.45) * float(shoulders.max())  # how high the joints are filled
    stones = crown + face * (tilt + texture)
    height = np.maximum(stones, fill + grit)
    buried = smoothstep(-0.2 * bevel, 0.25 * bevel, fill + grit - stones)

    speckle = np.abs(spectral(rng, size, 45, slope=0.7)) * rng.uniform(0, 1)
    second = pick(rng, index) < rng.uniform(0, 0.4)
    colour = blend(choose(rng, _STONE), choose(rng, _STONE), second.astype(np.float32))
    colour = shade(colour, np.exp(rng.uniform(0.1, 0.4) * pick(rng, index, -1, 1)))
    colour = shade(colour, 1 + 0.12 * body + 0.1 * unit(rough) - 0.3 * np.clip(speckle - 0.8, 0, 1))
    stain = unit(spectral(rng, size, 2, slope=1.3))
    colour = blend(
        colour, colour * choose(rng, ("#c8b8a0", "#8a8478", "#b0a898")), rng.uniform(0, 0.8) * stain
    )
    depth = cavity(height, 0.6 * reach)
    soiled = np.clip(rng.uniform(0.2, 0.9) * smoothstep(0.3, 1.8, depth) * (0.5 + 0.5 * unit(rough)), 0, 1)
    diffuse = blend(blend(colour, filling, soiled), filling, buried)
    diffuse = shade(diffuse, 1 - 0.5 * smoothstep(0.8, 2.2, depth))
    lichen = patches(spectral(rng, size, 6, slope=1.1), rng.uniform(0, 0.12), 0.15) * (1 - buried)
    diffuse = blend(diffuse, choose(rng, ("#b5b58a", "#a9b0a0", "#c2bda5")), 0.5 * lichen)

    polish = rng.uniform(0, 0.45) * smoothstep(0.0, -1.2, depth) * unit(spectral(rng, size, 3) + 1)
    wet = float(rng.random() < 0.3) * smoothstep(-1.2, 1.0, depth + spectral(rng, size, 2))
    diffuse = shade(diffuse, 1 - 0.45 * wet)
    dry = lerp(rng.uniform(0.6, 0.85) - polish + 0.05 * body + 0.1 * soiled, 0.94, buried)
    roughness = np.clip(dry + 0.1 * lichen, 0, 1) * (1 - 0.72 * wet)
    return finish(rng, height, diffuse, roughness, 0.04 - 0.012 * buried * (1 - wet), grain=1.1)


def setts(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Cut stones with rounded shoulders in rows, arcs or herringbone; joints of sand, soil or moss."""
    x, y = rotated(*grid(size), rng.choice([0.0, np.pi / 4, rng.uniform(0, np.pi)]))
    x, y = bent(rng, x, y, rng.uniform(0.002, 0.013), low=4, slope=2.5)
    width = log_uniform(rng, 0.17, 0.5)
    if rng.random() < 0.3:  # segmental arcs
        span = width * rng.uniform(6, 10)
        y = y - np.float32(rng.uniform(0.06, 0.13) * span) * np.abs(np.sin(np.pi * x / span))
    ratio = rng.choice([1.0, rng.uniform(1.0, 2.0)])
    if rng.random() < 0.2:
        ratio = 2.0
        blocks = herringbone(x, y, width, 2)
    else:
        shift = rng.random(23) if rng.random() < 0.5 else np.array([0, 0.5])
        blocks = courses(x, y, width * ratio, width, shift)
    reach = width / 2
    joint = reach * rng.uniform(0.03, 0.16)
    smaller = pick(rng, blocks.index, 0, 0.12) * reach
    half = (width * ratio / 2 - joint - smaller, reach - joint - 0.7 * smaller)
    inside = box(blocks.along, blocks.across, *half, reach * rng.uniform(0.08, 0.5))
    return _stones(rng, inside, blocks.index, blocks.along, blocks.across, reach, (0.12, 0.6))


def rounded_cobbles(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Field stones of many sizes and polygonal pavers, round-backed, deep in their bed."""
    x, y = rotated(*grid(size), rng.uniform(0, np.pi))
    x, y = bent(rng, x, y, rng.uniform(0.01, 0.03), low=5, slope=2.5)
    count = log_uniform(rng, 4, 12)
    stones = cells(rng, x, y, count, aspect=rng.uniform(0.6, 1.4), jitter=rng.uniform(0.3, 1.0))
    reach = 0.8 / count
    blunt = rng.uniform(0.05, 0.35) * reach  # corners are rounder than the borders between two stones
    inside = softened(stones.edge, blunt) - reach * rng.uniform(0.06, 0.22) - 0.3 * blunt
    inside = inside - np.maximum(stones.near - reach * rng.uniform(1.1, 1.6), 0) * np.float32(0.7)
    return _stones(rng, inside, stones.index, stones.dx, stones.dy, reach, (0.25, 1.0))


def pillowed_tile(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Hand-made tiles with cushioned faces: square, oblong, hexagonal or scales, each of its own glaze."""
    x, y = rotated(*grid(size), rng.choice([0.0, 0.0, np.pi / 4, rng.uniform(0, np.pi)]))
    x, y = bent(rng, x + rng.uniform(0, 1), y + rng.uniform(0, 1), rng.uniform(0.001, 0.008), low=5)
    width = log_uniform(rng, 0.17, 0.65)
    radius, joint = width * rng.uniform(0.01, 0.14), width * rng.uniform(0.01, 0.035)
    design = str(rng.choice(["square", "square", "oblong", "herringbone", "hexagon", "scale"]))
    if design == "hexagon":
        places, edge = hexagons(x, y, width)
        u, v, index, inside = places.u, places.v, places.index, softened(edge, 0.3 * radius) - joint
    elif design == "scale":
        places, edge = scales(x, y, width)
        u, v, index, inside = places.u, places.v, places.index, softened(edge, 0.3 * radius) - joint
    else:
        ratio = 1.0 if design == "square" else rng.choice([2.0, 3.0])
        shift = np.array([0, rng.choice([0, 0.5, 0.33])])
        square = design == "herringbone"
        blocks = herringbone(x, y, width, 2) if square else courses(x, y, width * ratio, width, shift)
        half = (width * (2.0 if square else ratio) / 2 - joint, width / 2 - joint)
        u, v, index = blocks.along, blocks.across, blocks.index
        inside = box(u, v, *half, radius)
    return _glazed(rng, inside, index, u, v, width)


def _glazed(
    rng: np.random.Generator, inside: Real, index: Index, u: Real, v: Real, width: float
) -> MaterialMaps:
    """Tiles from the distance into their outlines: cushioned, glazed thick and thin, in rough grout."""
    size = inside.shape[0]
    hand = rng.uniform(0.2, 1)  # how much of it was made by hand
    body = scattered(rng, spectral(rng, size, 2.5, slope=2.2), index)
    ripple = scattered(rng, spectral(rng, size, 8, 60, slope=1.6), index)
    outline = inside - hand * 0.006 * width * spectral(rng, size, 12, slope=1.5)
    cushion = width * log_uniform(rng, 0.05, 0.35)
    pillow = shoulder(outline, cushion, rng.uniform(20, 55), rng.uniform(1.6, 3.0))
    domed = shoulder(outline, 0.5 * width, rng.uniform(0, 14), 2.0)
    pillow = padded(pillow + domed, outline, width * rng.uniform(0.01, 0.08))
    face = smoothstep(0, 0.018, outline)
    askew = lean(rng, index, u, v, 0.09 * hand) + pick(rng, index, 0, 0.02 * width * hand)
    wavy = hand * (tilted(body, rng.uniform(1, 4)) + tilted(ripple, rng.uniform(0.5, 4)))
    grout_relief = tilted(spectral(rng, size, 30, slope=0.8), rng.uniform(4, 9))
    grout_level = rng.uniform(0.0, 0.4) * float(pillow.max())
    height = lerp(grout_level + grout_relief, pillow + askew + wavy, face)

    colour = blend(dye(rng), dye(rng), (pick(rng, index) < rng.choice([0.0, 0.0, 0.3])).astype(np.float32))
    colour = shade(colour, np.exp(rng.uniform(0.03, 0.35) * pick(rng, index, -1, 1)))
    thin = np.exp(-np.maximum(outline, 0) / (0.3 * cushion))  # glaze runs off the edge, and the clay shows
    clay = choose(rng, ("#b5673f", "#c9a888", "#d8cdb8", "#6a4a3c", "#8f8578"))
    colour = shade(colour, 1 + hand * (0.18 * body + 0.08 * ripple))
    colour = blend(colour, clay, np.clip(rng.uniform(0, 0.9) * hand * thin * unit(ripple + body), 0, 1))
    chips = patches(1.2 * thin + 0.8 * spectral(rng, size, 12, slope=1.2), rng.uniform(0, 0.05), 0.1) * face
    craze = cells(rng, *bent(rng, *grid(size), 0.01, low=8), rng.uniform(18, 45))
    crack = (1 - smoothstep(0.0, 0.006, craze.edge)) * float(rng.random() < 0.2) * face
    spots = patches(spectral(rng, size, 30, slope=2), rng.uniform(0, 0.04), 0.2) * hand
    colour = shade(blend(colour, clay, chips), (1 - 0.4 * crack) * (1 - 0.5 * spots))
    height = height - 0.004 * chips

    filler = choose(rng, ("#a9a49a", "#8c8780", "#d8d4ca", "#5a5753", "#3a3836", "#b8a890"))
    grime = unit(spectral(rng, size, 3, slope=1.2))
    filler_colour = shade(filler, (0.6 + 0.6 * grime) * (1 + 2 * np.clip(grout_relief, -0.05, 0.05)))
    film = rng.uniform(0, 0.3) * unit(spectral(rng, size, 2, slope=1.4)) ** 2
    scuffs = strokes(rng, size, int(rng.integers(5, 200)), 0.3, curl=0.4)
    matt = rng.random() < 0.2
    gloss = rng.uniform(0.35, 0.6) if matt else rng.uniform(0.06, 0.26)
    glaze = gloss + film + 0.1 * scuffs + 0.25 * crack + 0.4 * chips + 0.02 * hand * ripple + 0.2 * spots
    diffuse = blend(filler_colour, blend(colour, rgb(0.25, 0.22, 0.18), 0.3 * film), face)
    return finish(rng, height, diffuse, lerp(0.9, glaze, face), lerp(0.03, 0.05, face), grain=0.35)
