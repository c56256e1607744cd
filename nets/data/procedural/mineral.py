"""Ground and stone without joints: plaster, concrete, gravel, marble, granite, sand, mud, moss."""

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
from nets.data.procedural.noise import (
    Field,
    Real,
    bent,
    cells,
    grid,
    lean,
    log_uniform,
    patches,
    pick,
    smoothstep,
    spectral,
    strokes,
    unit,
    veins,
)

_EARTH = ("#6b5139", "#8a7152", "#4f3d2c", "#a58d6c", "#7a6a58", "#93694a")
_CHIPS = ("#e0dbd0", "#8a5a4c", "#4a4d4a", "#b99a72", "#6f7f72", "#2c2b2b", "#c9a596")
_GREY = ("#9b9893", "#7f7d79", "#b5b1a8", "#8d8f90", "#6d6b68")

# Body and vein colours that occur together: Carrara, Nero Marquina, Crema, Verde, Rosso, Emperador.
_MARBLES = (
    (("#e4e2de", "#cfd0d0"), ("#6d7176", "#8a8c90")),
    (("#26262a", "#38383a"), ("#d8d4cc", "#b8b4ac")),
    (("#dccbb0", "#cdb592"), ("#9a7048", "#b58a60")),
    (("#44584c", "#2f4038"), ("#b9c4b4", "#8aa08e")),
    (("#8f5548", "#a86f5e"), ("#e0d0c4", "#5a3830")),
    (("#5f4838", "#765a46"), ("#c9ad88", "#3a2a20")),
)


def plaster(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Painted plaster or stucco: trowelled, dashed or knocked down, with hairline cracks and stains."""
    trowel = spectral(rng, size, 4, slope=2.2, stretch=rng.uniform(1, 4), angle=rng.uniform(0, np.pi))
    style = rng.choice(["trowelled", "dashed", "knocked"])
    if style == "dashed":
        relief = np.abs(spectral(rng, size, log_uniform(rng, 15, 40), slope=2.2))
    elif style == "knocked":  # lumps pressed flat
        relief = smoothstep(-0.1, 0.5, spectral(rng, size, log_uniform(rng, 8, 20), slope=2.5)) + 0.1 * trowel
    else:
        relief = trowel + 0.1 * spectral(rng, size, 40, slope=1)
    height = tilted(relief, rng.uniform(3, 14)) + tilted(
        spectral(rng, size, 40, slope=0.8), rng.uniform(1, 4)
    )
    crack = veins(spectral(rng, size, 2, slope=1.3), 0.02) * patches(
        spectral(rng, size, 2), rng.uniform(0, 0.3)
    )
    height = height - 0.01 * crack
    stain = unit(spectral(rng, size, 2, slope=1.4))
    base = np.maximum(dye(rng, (0, 0.5)), 0.12)
    diffuse = shade(shades(rng, base, stain, 0.12), (1 - 0.6 * crack) * (1 - 0.08 * cavity(height, 0.04)))
    sheen = rng.uniform(0.3, 0.5) if rng.random() < 0.3 else rng.uniform(0.6, 0.9)
    roughness = sheen + 0.03 * cavity(height, 0.03) + 0.1 * (1 - stain) + 0.2 * crack
    return finish(rng, height, diffuse, roughness, 0.04, grain=0.9)


def concrete(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Cast concrete: clouds, air holes, the seam of a formwork, wet patches; raw or ground and sealed."""
    x, y = grid(size)
    clouds, fine = spectral(rng, size, 2, slope=1.2), spectral(rng, size, 30, slope=0.8)
    holes = cells(rng, x, y, log_uniform(rng, 12, 35))
    radius = pick(rng, holes.index) ** 4 * rng.uniform(0.01, 0.03) + 1e-4
    hole = (1 - smoothstep(0.6, 1.0, holes.near / radius)) * (pick(rng, holes.index) < rng.uniform(0.2, 0.8))
    height = tilted(clouds, rng.uniform(1, 4)) + tilted(fine, rng.uniform(2, 6)) - 0.015 * hole
    if rng.random() < 0.5:
        period, along = rng.uniform(0.35, 1.2), (x, y)[int(rng.integers(2))]
        seam = np.exp(-((np.mod(along + 0.3, period) - period / 2) ** 2) / 0.006**2)
        height, clouds = height + 0.008 * seam, clouds + 0.6 * np.sign(np.sin(np.pi * (along + 0.3) / period))
    colour = shades(rng, choose(rng, _GREY, 0.15), unit(clouds), rng.uniform(0.12, 0.35))
    diffuse = shade(colour, (1 + 0.08 * fine) * (1 - 0.5 * hole))
    wet = patches(spectral(rng, size, 1.5, slope=1.6), rng.uniform(0.1, 0.5), 0.1) * float(
        rng.random() < 0.25
    )
    sealed = rng.uniform(0.2, 0.4) if rng.random() < 0.3 else rng.uniform(0.6, 0.85)
    roughness = lerp(sealed + 0.05 * clouds + 0.04 * fine + 0.3 * hole, 0.18, wet)
    return finish(rng, height, shade(diffuse, 1 - 0.45 * wet), roughness, 0.04 - 0.015 * hole, grain=1.2)


def gravel(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Loose pebbles in three layers over soil, angular or round, each of its own colour."""
    x, y = grid(size)
    height = tilted(spectral(rng, size, 12, slope=1.2), 8) * np.float32(0.5)
    diffuse = shade(choose(rng, _EARTH), 0.5 + 0.3 * unit(height / height.std()))
    roughness = np.full_like(x, 0.92)
    count, hue = log_uniform(rng, 9, 22), choose(rng, (*_GREY, "#a0917c", "#7a6f66", "#b39b84"))
    angular, polish = rng.uniform(0.3, 1.0), rng.uniform(0.0, 0.45)
    for layer in range(3):
        u, v = bent(rng, x, y, 0.012, low=10, slope=2)
        stones = cells(rng, u, v, count * (1.3 - 0.15 * layer))
        reach = 1 / count
        inside = stones.edge - reach * rng.uniform(0.08, 0.2)
        bulge = np.clip(inside / (rng.uniform(0.4, 0.6) * reach), 0, 1)
        crown = bulge * (2 - bulge) ** (1 - angular)  # round to faceted
        askew = lean(rng, stones.index, stones.dx, stones.dy, 0.25)
        chosen = pick(rng, stones.index) < (0.95, 0.55, 0.35)[layer]
        top = 0.12 * reach * layer + 0.3 * reach * crown * pick(rng, stones.index, 0.7, 1.2) + askew
        mask = (chosen & (inside > 0) & (top > height)).astype(np.float32)
        body = spectral(rng, size, 12, slope=1.2)
        stone = shade(shades(rng, hue, pick(rng, stones.index), 0.55), 1 + 0.12 * body)
        height = lerp(height, top + tilted(body, 3), mask)
        diffuse = blend(diffuse, stone, mask)
        roughness = lerp(roughness, 0.8 - polish * pick(rng, stones.index) + 0.04 * body, mask)
    deep = smoothstep(0, 2.0, cavity(height, 0.06))
    return finish(rng, height, shade(diffuse, 1 - 0.5 * deep), roughness, 0.04 - 0.012 * deep)


def marble(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Clouded stone with veins of several widths, polished with faint scratches, or honed."""
    angle, stretch = rng.uniform(0, np.pi), rng.uniform(1.5, 4)
    fold = spectral(rng, size, 1.5, slope=1.7, stretch=stretch, angle=angle)
    second = 0.5 * fold + spectral(rng, size, 3, slope=1.9, stretch=stretch, angle=angle + 0.6)
    # Strong over some stretches, gone over others: veins heal.
    strength = smoothstep(-0.3, 1.2, spectral(rng, size, 2, slope=1.8))
    broad = veins(fold, rng.uniform(0.2, 0.7)) * strength
    thin = veins(second, 0.08) * smoothstep(-0.5, 1, spectral(rng, size, 2, slope=1.8))
    body, vein = (choose(rng, codes) for codes in _MARBLES[int(rng.integers(len(_MARBLES)))])
    clouds = unit(0.7 * fold + 0.5 * spectral(rng, size, 8, slope=1.2))
    diffuse = shades(rng, body, clouds, rng.uniform(0.1, 0.35))
    diffuse = blend(diffuse, vein, np.clip(0.75 * broad**1.5 + 0.8 * thin, 0, 0.92))
    scratch = strokes(rng, size, int(rng.integers(20, 250)), 0.5, curl=0.3)
    height = tilted(spectral(rng, size, 3, slope=2), rng.uniform(0.3, 2)) - 0.0006 * scratch - 0.0015 * thin
    gloss = rng.uniform(0.08, 0.25) if rng.random() < 0.7 else rng.uniform(0.4, 0.65)
    smear = unit(spectral(rng, size, 3, slope=1.2, stretch=2))
    roughness = gloss + 0.08 * smear + 0.12 * scratch + 0.12 * thin
    return finish(rng, height, diffuse, roughness, 0.045 + 0.01 * broad, grain=0.35)


def granite(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Crystals of feldspar, quartz and mica of several sizes; polished, or flamed and rough."""
    x, y = bent(rng, *grid(size), 0.008, low=12, slope=1.6)
    count = log_uniform(rng, 45, 130)
    colours = np.stack(
        [choose(rng, c) for c in (("#b8a79a", "#a8746a", "#c9c3ba", "#8f9a94"), _GREY, ("#2a2928",))]
    )
    diffuse, gleam = np.broadcast_to(colours[0], (*x.shape, 3)), np.zeros_like(x)
    facet = np.zeros_like(x)
    for scale, share in ((1.0, 1.0), (1.7, 0.5), (2.3, 0.35)):
        crystal = cells(rng, x, y, count / scale)
        kind = rng.choice(3, int(crystal.index.max()) + 1, p=[0.5, 0.3, 0.2])[crystal.index]
        mask = (pick(rng, crystal.index) < share).astype(np.float32)
        diffuse = blend(diffuse, shade(colours[kind], pick(rng, crystal.index, 0.7, 1.25)), mask)
        gleam = lerp(gleam, (kind == 2).astype(np.float32), mask)
        facet = lerp(facet, pick(rng, crystal.index), mask)
    polished = rng.random() < 0.55
    relief = tilted(
        facet + 0.4 * spectral(rng, size, 10, slope=1.4), rng.uniform(0.5, 1.5) if polished else 11
    )
    base = rng.uniform(0.1, 0.28) if polished else rng.uniform(0.6, 0.85)
    roughness = base + 0.1 * facet - 0.1 * gleam * (not polished) + 0.06 * gleam
    return finish(rng, relief, diffuse, roughness, 0.04 + 0.03 * gleam, grain=0.4 if polished else 1.2)


def terrazzo(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Marble chips of a few colours and all sizes ground flat in a cement or resin bed."""
    x, y = grid(size)
    bed = choose(rng, (*_GREY, "#d8d2c6", "#3c3f42", "#b59a8a", "#7f9088"))
    diffuse: Colour = shade(bed, 1 + 0.06 * spectral(rng, size, 20, slope=0.6))
    chips = [choose(rng, _CHIPS, 0.2) for _ in range(int(rng.integers(2, 5)))]
    inlay = np.zeros_like(x)
    for count in (60.0, 30.0, log_uniform(rng, 8, 18)):
        u, v = bent(rng, x, y, 0.3 / count, low=count / 2, slope=2)
        chip = cells(rng, u, v, count)
        chosen = (pick(rng, chip.index) < rng.uniform(0.35, 0.7)).astype(np.float32)
        mask = chosen * smoothstep(0, 0.008, chip.edge - pick(rng, chip.index, 0.05, 0.35) / count)
        tint = np.stack(chips)[rng.integers(0, len(chips), int(chip.index.max()) + 1)][chip.index]
        veined = 1 + 0.1 * spectral(rng, size, 10, slope=1.2)
        diffuse = blend(diffuse, shade(tint, veined * pick(rng, chip.index, 0.75, 1.2)), mask)
        inlay = np.maximum(inlay, mask)
    pores = patches(spectral(rng, size, 50, slope=2), 0.02, 0.2) * (1 - inlay)
    height = 0.002 * inlay - 0.006 * pores + tilted(spectral(rng, size, 3, slope=2), 0.8)
    gloss = rng.uniform(0.1, 0.5)
    roughness = lerp(gloss + rng.uniform(0.05, 0.3), gloss, inlay) + 0.3 * pores
    return finish(rng, height, diffuse, roughness, lerp(0.038, 0.05, inlay), grain=0.45)


def sand(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Grains under wind ripples or footprints, a few of them glinting; dry, or damp in the troughs."""
    angle = rng.uniform(0, np.pi)
    dunes = spectral(rng, size, 3, slope=2.2)
    x, y = bent(rng, *grid(size), rng.uniform(0.03, 0.1), low=3)
    wave = np.sin((x * np.cos(angle) + y * np.sin(angle)) * log_uniform(rng, 15, 50) + dunes)
    ripple = (wave + 0.3 * wave**2) * float(rng.random() < 0.65)
    grains = spectral(rng, size, 60, slope=0.5)
    height = tilted(dunes, rng.uniform(3, 8)) + tilted(ripple + 1e-6 * dunes, rng.uniform(4, 12)) * (
        ripple.std() > 0
    )
    height = height + tilted(grains, rng.uniform(5, 10))
    colour = choose(rng, ("#c8ab7d", "#b08d62", "#d9c8a4", "#9a7b5c", "#c58f62", "#7f786e"))
    mineral = rng.random(grains.shape, dtype=np.float32)
    diffuse = shade(shades(rng, colour, unit(grains + 0.5 * ripple), 0.22), 1 - 0.5 * (mineral > 0.96))
    damp = smoothstep(0, 1.5, cavity(height - 0.3 * grains * height.std(), 0.15)) * float(rng.random() < 0.4)
    roughness = 0.9 - 0.04 * unit(grains) - 0.45 * damp - 0.4 * (mineral > 0.992)
    return finish(rng, height, shade(diffuse, 1 - 0.4 * damp), roughness, 0.035 + 0.01 * damp, grain=1.4)


def cracked_mud(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Dried plates with curled rims between cracks of two generations."""
    x, y = bent(rng, *grid(size), 0.015, low=6, slope=2)
    count = log_uniform(rng, 4, 11)
    major, minor = cells(rng, x, y, count), cells(rng, x, y, 2.2 * count)
    wide = rng.uniform(0.04, 0.12) / count
    plate = smoothstep(wide, 3 * wide, major.edge) * (0.6 + 0.4 * smoothstep(0, 0.6 * wide, minor.edge))
    curl = np.exp(-major.edge * count * 2.5) * rng.uniform(0, 0.12)
    body = spectral(rng, size, 8, slope=1.4)
    tilt = lean(rng, major.index, major.dx, major.dy, 0.08)
    height = plate * (0.12 / count + curl / count + tilt) + tilted(body, rng.uniform(4, 9))
    colour = shades(
        rng, choose(rng, (*_EARTH, "#a89878", "#8a5f48")), unit(0.6 * body + spectral(rng, size, 2)), 0.2
    )
    diffuse = blend(colour * np.float32(0.35), shade(colour, pick(rng, major.index, 0.9, 1.1)), plate)
    wet = rng.uniform(0, 0.5) * float(rng.random() < 0.3)
    roughness = lerp(0.95, 0.82 + 0.05 * body - wet, plate)
    return finish(
        rng, height, shade(diffuse, np.full_like(x, 1 - 0.6 * wet)), roughness, 0.03 + 0.01 * plate, grain=1.3
    )


def moss_ground(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Tufts of moss over soil, with needles and small leaves fallen on it."""
    soil_relief = spectral(rng, size, 6, slope=1.3)
    tufts = patches(spectral(rng, size, log_uniform(rng, 2, 5), slope=1.7), rng.uniform(0.25, 0.85), 0.35)
    blades = np.abs(spectral(rng, size, 35, slope=1.3))
    lumps = spectral(rng, size, 12, slope=2)
    height = tilted(soil_relief, rng.uniform(6, 12)) + tilted(
        tufts * (1 + 0.4 * lumps + 0.4 * blades), rng.uniform(10, 18)
    )
    green = shades(
        rng, choose(rng, ("#4f6a2a", "#6f8a35", "#3b4f25", "#7f7a3a", "#5f6f3f")), unit(blades + lumps), 0.45
    )
    soil = shades(rng, choose(rng, _EARTH), unit(soil_relief), 0.35)
    diffuse, roughness = blend(soil, green, tufts), lerp(0.88, 0.8, tufts) - 0.08 * unit(blades)
    for length, width in ((0.15, 0.5), (0.06, 1.2)):
        litter = np.clip(
            1.6 * strokes(rng, size, int(rng.integers(5, 160)), length, curl=0.6, width=width), 0, 1
        )
        diffuse = blend(diffuse, choose(rng, ("#a07b4a", "#7a5230", "#c2a56a")), litter)
        height, roughness = height + 0.008 * litter, lerp(roughness, 0.6, litter)
    damp = rng.uniform(0, 0.3) * _hollow(height)
    return finish(rng, height, shade(diffuse, 1 - damp), roughness - damp, 0.035 + 0.01 * tufts, grain=1.5)


def _hollow(height: Real) -> Field:
    """Where water stays, in [0, 1]."""
    return smoothstep(0, 2, cavity(height, 0.1))
