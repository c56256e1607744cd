"""Cloth and hide: woven, twill and denim, knit, carpet, leather."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nets.data.procedural.compose import (
    MaterialMaps,
    blend,
    choose,
    dye,
    finish,
    shade,
    shades,
    tilted,
)
from nets.data.procedural.layout import Weave, weave
from nets.data.procedural.noise import (
    Field,
    Index,
    Real,
    bent,
    cells,
    grid,
    log_uniform,
    patches,
    pick,
    rotated,
    smoothstep,
    spectral,
    strokes,
    unit,
    veins,
)


def _twist(rng: np.random.Generator, along: Real, across: Real, plies: float) -> Field:
    """Plies winding around a yarn, in [-1, 1]: slanted stripes that crowd towards its sides."""
    phase = plies * along + rng.uniform(0.3, 0.8) * np.arcsin(np.clip(across, -1, 1))
    return np.cos(2 * np.pi * phase).astype(np.float32)


def _folds(rng: np.random.Generator, size: int) -> Field:
    """The soft hills of cloth that does not lie quite flat."""
    return tilted(spectral(rng, size, 1.5, 8, 3), rng.uniform(1, 6))


def _stripes(rng: np.random.Generator, thread: Index) -> Field:
    """Which threads of a set are of the second colour: none, stripes of a few threads, as 0 or 1."""
    if rng.random() < 0.5:
        return np.zeros(thread.shape, dtype=np.float32)
    bands = np.repeat(rng.random(24) < 0.4, rng.integers(1, 7, 24)).astype(np.float32)
    return bands[thread % len(bands)]


def _cloth(rng: np.random.Generator, size: int, cloth: Weave, warp: Real, weft: Real) -> MaterialMaps:
    """Maps of a weave with the given colours of its two sets of threads (`[H, W, 3]`)."""
    twist = _twist(rng, cloth.along, cloth.across, rng.uniform(0.8, 2))
    fuzz = strokes(rng, size, 900, 0.07, curl=1.5)
    relief = cloth.height + 0.18 * twist + 0.25 * fuzz + 0.15 * spectral(rng, size, 40, slope=0.8)
    height = tilted(relief, rng.uniform(12, 20)) + _folds(rng, size)
    gap = 1 - smoothstep(-1.0, 0.4, cloth.height)
    thread = pick(rng, cloth.thread, 0.85, 1.15) * (1 + 0.12 * twist)
    diffuse = shade(blend(weft, warp, cloth.warp_on_top), thread * (1 - 0.7 * gap))
    diffuse = blend(diffuse, np.clip(diffuse * 1.6 + 0.03, 0, 0.9), np.clip(0.5 * fuzz, 0, 1))
    silk = float(rng.random() < 0.3)
    worn = unit(spectral(rng, size, 2, slope=1.5))
    fibre = rng.uniform(0.3, 0.5) if silk else rng.uniform(0.65, 0.92)
    roughness = fibre + 0.1 * gap - 0.1 * worn - 0.04 * twist
    return finish(rng, height, diffuse, roughness, (0.035 + 0.02 * silk) * (1 - 0.4 * gap), grain=1.1)


def woven_fabric(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Plain, basket or satin weave, plain coloured, striped or checked; cotton, linen, canvas, silk."""
    x, y = rotated(*bent(rng, *grid(size), rng.uniform(0.003, 0.012), low=3), rng.uniform(-0.2, 0.2))
    pattern = _PATTERNS[rng.choice(["plain", "plain", "basket", "satin"])]
    cloth = weave(x, y, log_uniform(rng, 16, 50), pattern, rng.uniform(0.8, 1))
    first, second = dye(rng), dye(rng)
    stripes = _stripes(rng, cloth.thread)
    warp = blend(first, second, stripes)
    weft = warp if rng.random() < 0.6 else blend(second, second, stripes)
    return _cloth(rng, size, cloth, warp, weft)


def denim(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Twill: diagonal ribs of dyed warp over pale weft, washed out where it is rubbed."""
    x, y = rotated(*bent(rng, *grid(size), 0.005, low=3), rng.uniform(-0.3, 0.3))
    i, j = np.indices((4, 4))
    cloth = weave(x, y, log_uniform(rng, 32, 80), (i + j) % 4 > 0, 1.0)
    indigo = rng.random() < 0.6
    warp = choose(rng, ("#26364f", "#34496b", "#1d2433", "#5a7592")) if indigo else dye(rng)
    washed = patches(spectral(rng, size, 2, slope=1.6), rng.uniform(0, 0.5), 0.8)
    weft = choose(rng, ("#b9b7ae", "#d2cfc4")) if indigo else warp * np.float32(1.3)
    rubbed = blend(warp, np.float32(0.5) * warp + np.float32(0.5) * weft, 0.6 * washed)
    return _cloth(rng, size, cloth, rubbed, np.broadcast_to(weft, (size, size, 3)))


def _pattern(rows: str) -> NDArray[np.bool_]:
    """A weaving draft from text: `x` where the warp is on top."""
    return np.array([[mark == "x" for mark in row] for row in rows.split()])


_PATTERNS = {
    "plain": _pattern("x. .x"),
    "basket": _pattern("xx.. xx.. ..xx ..xx"),
    "satin": _pattern("xxxx. x.xxx xxx.x .xxxx xx.xx"),
}


def knit_fabric(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Stockinette: columns of V-shaped stitches of plied, hairy yarn, plain or in coloured rows."""
    x, y = bent(rng, *grid(size), rng.uniform(0.004, 0.015), low=3)
    wales = log_uniform(rng, 9, 26)
    u, v = x * wales / 2, y * wales / 2 * rng.uniform(1.1, 1.5)
    column = np.floor(u)
    side = 2 * (u - column) - 1  # -1..1 over a wale, a leg of the V on either side
    leg = 2 * np.abs(side) - 1
    lifted = v - 0.75 * np.abs(side)
    course = np.floor(lifted)
    across = 2 * (lifted - course) - 1 + 0.35 * leg * np.sign(leg) * leg
    body = np.sqrt(np.clip(1 - leg**2, 0, 1)) * np.sqrt(np.clip(1 - 0.85 * across**2, 0, 1))
    twist = _twist(rng, (leg + 0.4 * across).astype(np.float32), across.astype(np.float32), 1.5)
    fuzz = strokes(rng, size, int(rng.integers(300, 2500)), 0.1, curl=2.5)
    height = tilted(body + 0.07 * twist + 0.1 * fuzz, rng.uniform(14, 22)) + _folds(rng, size)
    rows = (course - course.min()).astype(np.intp)
    colour = blend(dye(rng), dye(rng), _stripes(rng, rows))
    gap = 1 - smoothstep(0, 0.5, body.astype(np.float32))
    stitch = pick(rng, rows * int(wales + 4) + (column - column.min()).astype(np.intp), 0.9, 1.1)
    diffuse = shade(colour, stitch * (1 - 0.65 * gap) * (1 + 0.1 * twist + 0.25 * fuzz))
    roughness = rng.uniform(0.65, 0.9) + 0.08 * gap - 0.05 * twist
    return finish(rng, height, diffuse, roughness, 0.035 - 0.01 * gap, grain=1.3)


def carpet(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Loops or cut pile, in tufts with flecks of other colours, trodden in places."""
    x, y = bent(rng, *grid(size), 0.015, low=10, slope=1.5)
    count = log_uniform(rng, 22, 60)
    tuft = cells(rng, x, y, count, jitter=rng.uniform(0.4, 1))
    loop = np.clip(1 - (tuft.near * count / 2 * 1.5) ** 2, 0, 1)
    pile = strokes(rng, size, 5000, rng.uniform(0.04, 0.1), curl=2)
    trodden = unit(spectral(rng, size, 2, slope=1.7))
    relief = loop * (1 - 0.5 * trodden) + 0.5 * pile + 0.2 * pick(rng, tuft.index)
    height = tilted(relief, rng.uniform(14, 22))
    base, fleck = dye(rng, (0, 0.7)), dye(rng)
    flecks = (pick(rng, tuft.index) < rng.uniform(0, 0.4)).astype(np.float32)
    if rng.random() < 0.35:  # a woven-in lattice instead of flecks
        period = rng.uniform(0.3, 0.8)
        flecks = ((np.mod(x + y, period) < period / 3) | (np.mod(x - y, period) < period / 3)).astype(
            np.float32
        )
    colour = shade(blend(base, fleck, flecks), pick(rng, tuft.index, 0.75, 1.2) * (0.75 + 0.4 * pile))
    diffuse = shade(colour, (0.45 + 0.55 * loop) * (0.9 + 0.2 * trodden))
    roughness = rng.uniform(0.78, 0.96) - 0.1 * pile - 0.08 * trodden
    return finish(rng, height, diffuse, roughness, 0.025 + 0.01 * loop, grain=1.5)


def leather(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Pebbled grain with pores and creases; polished on the pebbles, dull and dark between."""
    x, y = bent(rng, *grid(size), 0.015, low=8, slope=1.8)
    count = log_uniform(rng, 18, 55)
    grain = cells(rng, x, y, count, aspect=rng.uniform(0.75, 1.3))
    pebble = smoothstep(0, rng.uniform(0.3, 0.8) / count, grain.edge) * pick(rng, grain.index, 0.7, 1)
    angle = rng.uniform(0, np.pi)
    wrinkle = veins(
        spectral(rng, size, 3, slope=1.9, stretch=rng.uniform(1, 3), angle=angle), rng.uniform(0.1, 0.3)
    )
    crease = wrinkle * unit(spectral(rng, size, 2)) * rng.uniform(0, 1.2)
    pores = patches(spectral(rng, size, 60, slope=2), 0.03, 0.2)
    height = tilted(pebble - 1.2 * crease - 0.4 * pores, rng.uniform(5, 14))
    height = height + tilted(spectral(rng, size, 2, 10, 2.5), rng.uniform(1, 4))
    base = (
        dye(rng)
        if rng.random() < 0.35
        else choose(rng, ("#5a3a26", "#2b211c", "#8a5a36", "#a87b52", "#6b2f25", "#1c1b1b"))
    )
    valley = np.clip(1 - pebble + 0.6 * crease, 0, 1)
    patina = unit(spectral(rng, size, 2, slope=1.5))
    diffuse = shade(shades(rng, base, patina, 0.18), 1.1 - 0.45 * valley)
    rub = patches(spectral(rng, size, 2, slope=1.3) + 0.6 * pebble, rng.uniform(0, 0.15), 0.3) * pebble
    diffuse = blend(diffuse, np.clip(diffuse * 1.8 + 0.02, 0, 0.8), 0.6 * rub)
    gloss = rng.uniform(0.25, 0.65)
    roughness = gloss + 0.22 * valley + 0.1 * patina + 0.1 * rub
    return finish(rng, height, diffuse, roughness, 0.042 - 0.015 * valley, grain=0.7)
