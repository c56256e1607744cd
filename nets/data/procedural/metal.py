"""Metals, bare and coated: brushed, scratched, hammered, tread plate, zinc, rust on paint, flake paint."""

from __future__ import annotations

import numpy as np

from nets.data.procedural.compose import (
    MaterialMaps,
    blend,
    cavity,
    choose,
    dye,
    finish,
    lerp,
    metal,
    rgb,
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
    rotated,
    smoothstep,
    spectral,
    strokes,
    unit,
)

_RUST = ("#6b3a20", "#8a4a24", "#4a2a1c", "#a5622f")


def _tarnish(rng: np.random.Generator, size: int, strength: float) -> Field:
    """Uneven films, smears and finger marks on a bare metal, in [0, `strength`]."""
    film = unit(spectral(rng, size, 2, slope=1.2))
    smear = unit(spectral(rng, size, 4, slope=1.5, stretch=3, angle=rng.uniform(0, np.pi)))
    return np.float32(strength) * film * (0.5 + 0.5 * smear)


def _bare(
    rng: np.random.Generator, height: Real, f0: Real, roughness: Real, tarnish: Real, grime: Real
) -> MaterialMaps:
    """A bare metal: hardly any diffuse, but for grime where it settles; tarnish dulls and darkens."""
    dirt = choose(rng, ("#3a332c", "#4a4038", "#2a2826"))
    diffuse = blend(rgb(0.008, 0.008, 0.008) + 0.02 * f0, dirt, np.clip(grime + 0.15 * tarnish, 0, 1))
    specular = blend(shade(np.asarray(f0), 1 - 0.5 * tarnish), rgb(0.04, 0.04, 0.04), 0.85 * grime)
    return finish(rng, height, diffuse, lerp(roughness + 0.3 * tarnish, 0.85, grime), specular, grain=0.5)


def brushed_metal(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Long parallel hairlines, straight or in circles around a turning centre."""
    angle = rng.choice([0.0, np.pi / 2, rng.uniform(0, np.pi)])
    lines = spectral(rng, size, 30, slope=0.6, stretch=rng.uniform(25, 80), angle=angle)
    broad = spectral(rng, size, 4, slope=1.0, stretch=20, angle=angle)
    stray = strokes(rng, size, int(rng.integers(10, 200)), 0.8, angle, rng.choice([0.03, np.pi]), curl=0.05)
    if rng.random() < 0.25:  # turned on a lathe: wind the lines around a centre
        x, y = grid(size)
        radius = np.hypot(x - rng.uniform(-1.5, 1.5), y - rng.uniform(-1.5, 1.5))
        groove = np.interp(radius, np.linspace(0, 4, 4 * size), rng.standard_normal(4 * size))
        lines = (groove / groove.std()).astype(np.float32)
    height = tilted(lines + 0.5 * broad, rng.uniform(2, 7)) - 0.001 * stray
    roughness = rng.uniform(0.18, 0.5) + 0.04 * lines + 0.03 * broad + 0.15 * stray
    shine = shade(metal(rng), 1 - 0.06 * unit(lines) - 0.05 * unit(broad))
    tarnish = _tarnish(rng, size, rng.uniform(0, 0.5))
    return _bare(rng, height, shine, roughness, tarnish, np.zeros_like(lines))


def scratched_metal(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Sheet with scratches of all lengths, dents, and grime left in them; polished to dull."""
    deep = strokes(rng, size, int(rng.integers(15, 120)), rng.uniform(0.4, 1.2), curl=0.4, width=0.7)
    fine = strokes(rng, size, int(rng.integers(300, 2500)), 0.25, curl=0.5, width=0.4)
    dents = -np.maximum(spectral(rng, size, 4, slope=2.5) - 1.2, 0)
    height = tilted(spectral(rng, size, 2, 12, 2.5), rng.uniform(0.5, 2.5)) + 0.01 * dents
    height = height - 0.006 * deep - 0.0015 * fine
    tarnish = _tarnish(rng, size, rng.uniform(0.1, 0.8))
    grime = np.clip(
        patches(spectral(rng, size, 3, slope=1.1), rng.uniform(0, 0.2), 0.3) * 0.7 + 0.3 * deep, 0, 1
    )
    roughness = rng.uniform(0.12, 0.45) + 0.25 * np.clip(deep, 0, 1) + 0.12 * fine
    return _bare(rng, height, metal(rng), roughness, tarnish, grime * rng.uniform(0, 1))


def hammered_metal(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Overlapping round dimples of a planishing hammer, dark patina in the ridges."""
    x, y = bent(rng, *grid(size), 0.01, low=5)
    count = log_uniform(rng, 7, 22)
    blow = cells(rng, x, y, count, jitter=rng.uniform(0.6, 1))
    bowl = (blow.near * count / 2) ** 2 + 0.2 * pick(rng, blow.index)
    ridge = 1 - smoothstep(0, 0.25 / count, blow.edge)
    height = tilted(bowl - 0.08 * ridge, rng.uniform(8, 18)) + tilted(spectral(rng, size, 20, slope=1), 1.5)
    marks = strokes(rng, size, int(rng.integers(50, 800)), 0.12, curl=0.5)
    height = height - 0.001 * marks
    tarnish = _tarnish(rng, size, rng.uniform(0, 0.7))
    patina = np.clip(
        rng.uniform(0, 0.8) * smoothstep(0.2, 2, -cavity(height, 0.05)) * unit(spectral(rng, size, 3)), 0, 1
    )
    names = ("copper", "brass", "bronze", "silver", "iron", "gold", "aluminium")
    roughness = rng.uniform(0.15, 0.45) + 0.1 * marks + 0.08 * ridge + pick(rng, blow.index, 0, 0.08)
    return _bare(rng, height, metal(rng, names), roughness, tarnish, patina)


def diamond_plate(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Tread plate: raised lens-shaped bars at alternating right angles, rubbed bright on top; or painted."""
    x, y = rotated(*grid(size), rng.choice([0.0, np.pi / 4]))
    pitch = log_uniform(rng, 0.16, 0.4)
    i, j = np.floor(x / pitch), np.floor(y / pitch)
    u, v = x / pitch - i - 0.5, y / pitch - j - 0.5
    sign = np.where(np.mod(i + j, 2) > 0, 1, -1) * np.float32(np.sqrt(0.5))
    along, across = u * np.sqrt(0.5) + v * sign, v * np.sqrt(0.5) - u * sign
    lens = 1 - (along / rng.uniform(0.4, 0.52)) ** 2 - np.abs(across) / rng.uniform(0.13, 0.2)
    bar = smoothstep(0, 0.6, lens.astype(np.float32))
    rolled = spectral(rng, size, 12, slope=1.2)
    scratch = strokes(rng, size, int(rng.integers(100, 1200)), 0.3, curl=0.2)
    height = pitch * rng.uniform(0.08, 0.16) * bar + tilted(rolled, rng.uniform(1, 4)) - 0.0015 * scratch
    tarnish = _tarnish(rng, size, rng.uniform(0.2, 0.8)) * (1 - 0.7 * bar)
    f0 = metal(rng, ("iron", "aluminium", "zinc", "chromium"))
    roughness = rng.uniform(0.25, 0.5) - 0.12 * bar + 0.1 * scratch + 0.04 * rolled
    if rng.random() < 0.3:
        paint = 1 - patches(4 * bar + rolled, rng.uniform(0.02, 0.15), 0.2)  # worn off where feet tread
        diffuse = blend(rgb(0.02, 0.02, 0.02), dye(rng), paint)
        specular = blend(f0, rgb(0.04, 0.04, 0.04), paint)
        return finish(rng, height, diffuse, roughness + 0.1 * paint, specular, grain=0.7)
    grime = rng.uniform(0, 0.9) * (1 - bar) * patches(rolled + spectral(rng, size, 2), 0.4, 0.5)
    return _bare(rng, height, f0, roughness, tarnish, grime)


def galvanized(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Zinc spangle: crystals with feathered grain, each of its own brightness; white rust in places."""
    x, y = bent(rng, *grid(size), 0.008, low=10, slope=1.8)
    crystal = cells(rng, x, y, log_uniform(rng, 6, 20))
    turn = pick(rng, crystal.index, 0, np.pi)
    feather = np.sin(
        (crystal.dx * np.cos(turn) + crystal.dy * np.sin(turn)) * 150 + 2 * spectral(rng, size, 20)
    )
    tone = pick(rng, crystal.index)
    tilt = lean(rng, crystal.index, crystal.dx, crystal.dy, 0.006)
    height = (
        tilt + tilted(feather, rng.uniform(1, 3)) + tilted(spectral(rng, size, 3, slope=2), rng.uniform(1, 3))
    )
    roughness = rng.uniform(0.22, 0.42) + 0.25 * tone + 0.03 * feather
    shine = shade(metal(rng, ("zinc",)), 0.55 + 0.5 * tone + 0.05 * feather)
    bloom = patches(spectral(rng, size, 3, slope=1.1), rng.uniform(0, 0.2), 0.8) * rng.uniform(0.1, 0.7)
    diffuse = blend(rgb(0.015, 0.015, 0.016), choose(rng, ("#a9aeb0", "#b8b9b5")), bloom)
    specular = blend(shine, rgb(0.05, 0.05, 0.05), 0.8 * bloom)
    return finish(rng, height, diffuse, lerp(roughness, 0.8, bloom), specular, grain=0.6)


def rusted_paint(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Paint blistering off steel: glossy coat, bare metal at torn edges, rust that eats and stains."""
    eaten = spectral(rng, size, log_uniform(rng, 2, 5), slope=1.35)
    coverage = rng.uniform(0.1, 0.6)
    rust = patches(eaten, coverage, 0.06)
    halo = patches(eaten, coverage * 1.35, 0.35)
    chipped = patches(eaten, coverage * 1.08, 0.03) * (1 - rust)
    coat = 1 - np.clip(rust + chipped, 0, 1)
    scale_relief = spectral(rng, size, 15, slope=1.1)
    peel = tilted(spectral(rng, size, 20, 60, 1), rng.uniform(0.5, 3))  # orange peel of the sprayed coat
    height = (
        coat * (rng.uniform(0.006, 0.015) + peel)
        + 0.004 * halo * coat
        + tilted(scale_relief, rng.uniform(8, 15)) * rust
    )
    colour = shades(rng, choose(rng, _RUST), unit(scale_relief + 0.8 * spectral(rng, size, 5)), 0.5)
    paint = blend(dye(rng), choose(rng, _RUST), 0.45 * halo)
    steel = metal(rng, ("iron", "titanium"))
    diffuse = blend(blend(colour, rgb(0.03, 0.03, 0.03), chipped), paint, coat)
    gloss = rng.uniform(0.12, 0.55)
    roughness = lerp(lerp(0.88 + 0.05 * scale_relief, 0.4, chipped), gloss + 0.2 * halo, coat)
    bare = np.clip(chipped * 0.8 + 0.06 * rust * (scale_relief > 1), 0, 1)
    return finish(rng, height, diffuse, roughness, blend(rgb(0.04, 0.04, 0.04), steel, bare), grain=0.9)


def flake_paint(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Metallic lacquer: tiny mirrors at random tilts in a coloured coat, orange peel, wash swirls."""
    x, y = grid(size)
    flake = cells(rng, x, y, log_uniform(rng, 60, 130))
    bright = pick(rng, flake.index) ** 2
    colour = dye(rng, (0.2, 0.95))
    tilt = lean(rng, flake.index, flake.dx, flake.dy, 0.12)
    swirls = strokes(rng, size, int(rng.integers(20, 500)), 0.35, curl=1.2, width=0.4)
    peel = tilted(spectral(rng, size, 14, 40, 1.5), rng.uniform(0.5, 3.5))
    height = peel + rng.uniform(0.2, 1) * tilt - 0.0008 * swirls
    shine = np.clip(0.06 + (0.3 + 0.6 * bright[..., None]) * (0.35 * colour + 0.65 * colour.mean()), 0, 1)
    diffuse = shade(colour * np.float32(0.6), 0.8 + 0.4 * bright)
    haze = unit(spectral(rng, size, 2, slope=1.5))
    roughness = rng.uniform(0.12, 0.4) + 0.1 * bright + 0.1 * swirls + 0.06 * haze
    return finish(rng, height, diffuse, roughness, shine.astype(np.float32), grain=0.4)
