"""Paper, plastics, rubber, old paint."""

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
from nets.data.procedural.noise import (
    Field,
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


def paper(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Rag, drawing or coated paper: felted fibres, cockles and creases, stains; coated sorts are glossy."""
    fibre = strokes(rng, size, 3500, 0.12, curl=2.5, width=0.6)
    felt = spectral(rng, size, 25, slope=0.9)
    crumple = np.abs(spectral(rng, size, 2, slope=1.9)) * float(rng.random() < 0.4)
    height = tilted(fibre + 0.4 * felt, rng.uniform(2, 7)) + tilted(
        spectral(rng, size, 2, 8, 2.5), rng.uniform(1, 4)
    )
    height = height + tilted(crumple + 1e-6 * felt, rng.uniform(6, 14)) * (crumple.std() > 0)
    base = (
        choose(rng, ("#e3dccb", "#cdbb97", "#b89a6c", "#e8e6e0"))
        if rng.random() < 0.6
        else dye(rng, (0, 0.6))
    )
    stain = patches(spectral(rng, size, 2, slope=1.5), rng.uniform(0, 0.3), 0.2)
    diffuse = shade(shades(rng, base, unit(spectral(rng, size, 3)), 0.08), 0.92 + 0.12 * fibre)
    diffuse = blend(diffuse, diffuse * rgb(0.8, 0.65, 0.45), 0.5 * stain)
    flecks = np.clip(2 * strokes(rng, size, int(rng.integers(0, 200)), 0.05, curl=1), 0, 1)
    diffuse = blend(diffuse, choose(rng, ("#5a4a3a", "#7a6a5a", "#3a4a6a")), 0.7 * flecks)
    coated = rng.uniform(0.25, 0.5) if rng.random() < 0.25 else rng.uniform(0.7, 0.92)
    fold = veins(spectral(rng, size, 2, slope=1.9), 0.03) * (crumple.std() > 0)
    roughness = coated + 0.05 * felt - 0.06 * stain + 0.1 * fold
    return finish(
        rng, height, blend(diffuse, np.clip(diffuse * 1.3, 0, 0.85), 0.5 * fold), roughness, 0.04, grain=0.8
    )


def cardboard(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Kraft board: flutes telegraphing through the liner, long fibres, dents, faded print."""
    x, y = grid(size)
    if rng.random() < 0.5:
        x, y = y, x
    flute = np.sin(x * log_uniform(rng, 25, 80) + 0.3 * spectral(rng, size, 2))
    fibre = strokes(rng, size, 4000, 0.15, spread=0.6, curl=1.2)
    dents = np.minimum(spectral(rng, size, 3, 12, slope=3) + 1.2, 0)
    fine = spectral(rng, size, 25, slope=0.9, stretch=4)
    height = tilted(flute, rng.uniform(1, 6)) + tilted(fibre + 0.4 * fine, rng.uniform(2, 5)) + 0.01 * dents
    kraft = shades(
        rng,
        choose(rng, ("#b08a5c", "#9a7448", "#c4a478", "#8a6a48")),
        unit(fine + spectral(rng, size, 2)),
        0.12,
    )
    diffuse = shade(kraft, 0.9 + 0.15 * fibre + 0.04 * flute)
    if rng.random() < 0.4:
        ink = (
            _print(rng, size)
            * (0.9 - 0.5 * patches(spectral(rng, size, 3, slope=1), 0.3, 0.3))
            * (1 - 0.4 * fibre)
        )
        diffuse = blend(diffuse, dye(rng, (0, 0.9), 0.6), np.clip(ink, 0, 1))
    shiny = float(rng.random() < 0.2)
    roughness = 0.82 - 0.4 * shiny + 0.05 * fine - 0.03 * flute + 0.05 * fibre
    return finish(rng, height, diffuse, roughness, 0.036)


def _print(rng: np.random.Generator, size: int) -> Field:
    """A printed design, 0 or 1 with soft edges: stripes, checks, dots, or rings."""
    x, y = rotated(*grid(size), rng.uniform(0, np.pi))
    period = log_uniform(rng, 0.15, 0.7)
    u, v = np.mod(x, period) / period - 0.5, np.mod(y, period) / period - 0.5
    soft = 2 / (size * period)
    design = rng.choice(["stripes", "checks", "dots", "rings"])
    if design == "stripes":
        level = rng.uniform(0.1, 0.35) - np.abs(u)
    elif design == "checks":
        level = 4 * u * v * np.where(np.abs(u) > 0.25, -1, 1)
    elif design == "dots":
        level = rng.uniform(0.2, 0.42) - np.hypot(u, v)
    else:
        level = 0.12 - np.abs(np.hypot(u, v) - 0.3)
    return smoothstep(-soft, soft, level.astype(np.float32))


def plastic_grain(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Moulded plastic with spark-eroded or leather-like grain, scuffed shiny; any colour."""
    count = log_uniform(rng, 30, 110)
    x, y = bent(rng, *grid(size), 0.01, low=12)
    if rng.random() < 0.5:
        texture = smoothstep(0, 0.5 / count, cells(rng, x, y, 0.7 * count).edge)
    else:
        texture = unit(spectral(rng, size, count / 2, slope=2.5))
    height = tilted(texture, rng.uniform(3, 12)) + tilted(spectral(rng, size, 2, 6, 3), rng.uniform(0.3, 2))
    scuff = strokes(rng, size, int(rng.integers(20, 400)), 0.3, curl=0.4)
    worn = patches(spectral(rng, size, 2, slope=1.6), rng.uniform(0, 0.4), 0.7)
    dust = rng.uniform(0, 0.3) * smoothstep(0, 2, cavity(height, 0.03)) * unit(spectral(rng, size, 2))
    diffuse = shade(dye(rng), 0.95 + 0.1 * texture + 0.3 * scuff * rng.uniform(-0.3, 1))
    diffuse = blend(diffuse, rgb(0.35, 0.33, 0.3), dust)
    roughness = rng.uniform(0.25, 0.6) + 0.08 * (1 - texture) - 0.12 * worn + 0.12 * scuff + dust
    return finish(rng, height - 0.001 * scuff, diffuse, roughness, 0.045 - 0.015 * dust, grain=0.5)


def printed_plastic(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Laminate or film with a printed design, gloss different in the ink, scratches through both."""
    ink = _print(rng, size)
    if rng.random() < 0.4:
        ink = np.abs(ink - _print(rng, size))
    scratch = strokes(rng, size, int(rng.integers(30, 500)), 0.5, curl=0.3)
    worn = patches(spectral(rng, size, 3, slope=1.2), rng.uniform(0, 0.2), 0.15)
    ink = ink * (1 - worn)
    peel = spectral(rng, size, 12, 50, 1.2)
    diffuse = shade(blend(dye(rng), dye(rng), ink), 1 + 0.1 * scratch)
    smear = unit(spectral(rng, size, 3, slope=1.3, stretch=3, angle=rng.uniform(0, np.pi)))
    base, step = rng.uniform(0.12, 0.45), rng.uniform(-0.08, 0.3)
    roughness = base + step * ink + 0.12 * smear + 0.15 * scratch + 0.1 * worn
    height = tilted(peel, rng.uniform(1, 4)) + rng.uniform(0, 0.006) * ink - 0.0012 * scratch
    return finish(rng, height, diffuse, roughness, lerp(0.05, 0.04, ink), grain=0.35)


def rubber_mat(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Moulded studs, ribs, or a grid on rubber; dusty in the recesses, rubbed on top."""
    x, y = rotated(*grid(size), rng.choice([0.0, np.pi / 4, rng.uniform(0, np.pi)]))
    pitch = log_uniform(rng, 0.1, 0.35)
    row = np.floor(y / pitch)
    stagger = 0.5 * np.mod(row, 2) * float(rng.random() < 0.5)
    u, v = np.mod(x / pitch + stagger, 1) - 0.5, y / pitch - row - 0.5
    design = rng.choice(["studs", "ribs", "grid", "pyramids"])
    distance = {
        "studs": rng.uniform(0.28, 0.42) - np.hypot(u, v),
        "ribs": rng.uniform(0.2, 0.35) - np.abs(v),
        "grid": np.maximum(np.abs(u), np.abs(v)) - rng.uniform(0.3, 0.42),
        "pyramids": 0.48 - np.maximum(np.abs(u), np.abs(v)),
    }[str(design)]
    edge = 0.4 if design == "pyramids" else rng.uniform(0.06, 0.15)
    raised = np.clip(distance / edge, 0, 1).astype(np.float32)
    fine, dust_noise = spectral(rng, size, 30, slope=0.8), unit(spectral(rng, size, 3, slope=1.2))
    scuff = strokes(rng, size, int(rng.integers(50, 500)), 0.2, curl=0.4)
    height = pitch * rng.uniform(0.08, 0.2) * raised + tilted(fine, rng.uniform(2, 5)) - 0.001 * scuff
    base = choose(rng, ("#1e1e1f", "#2b2a2a", "#3a3a3c")) if rng.random() < 0.6 else dye(rng)
    dust = rng.uniform(0.1, 0.8) * (1 - raised) * dust_noise
    diffuse = blend(shade(base, 1 + 0.1 * fine + 0.3 * scuff), choose(rng, ("#8a8070", "#9a958c")), dust)
    roughness = rng.uniform(0.45, 0.8) - 0.12 * raised + 0.2 * dust + 0.05 * fine + 0.06 * scuff
    return finish(rng, height, diffuse, roughness, 0.04 - 0.01 * dust, grain=0.9)


def cracked_paint(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Old paint in scales with lifted rims, some fallen off the primer or wood beneath."""
    x, y = bent(rng, *grid(size), 0.025, low=8, slope=1.7)
    count = log_uniform(rng, 6, 20)
    chip = cells(rng, x, y, count, aspect=rng.uniform(0.4, 1.2))
    crack = 1 - smoothstep(0, rng.uniform(0.06, 0.14) / count, chip.edge)
    loose = patches(spectral(rng, size, 2, slope=1.5), rng.uniform(0.05, 0.5), 0.01)
    fallen = (pick(rng, chip.index) < 0.75) * loose * smoothstep(0, 0.2 / count, chip.edge)
    coat = (1 - fallen) * (1 - crack)
    brush = spectral(rng, size, 15, slope=1.2, stretch=rng.uniform(4, 15), angle=np.pi / 2)
    wood = spectral(rng, size, 15, slope=1.0, stretch=25, angle=np.pi / 2)
    curl = np.exp(-chip.edge * count * 4) * pick(rng, chip.index) * rng.uniform(0.1, 0.6)
    height = coat * (0.015 + 0.08 / count * curl + tilted(brush, rng.uniform(1, 5))) + tilted(wood, 6) * (
        1 - coat
    )
    under = shades(rng, choose(rng, ("#8a7560", "#b5aa98", "#6a5a4a", "#9a9a94")), unit(wood), 0.3)
    paint: Colour = shade(shades(rng, dye(rng), unit(spectral(rng, size, 2)), 0.12), 1 + 0.05 * brush)
    diffuse = shade(blend(under, paint, coat), 1 - 0.5 * crack * (1 - fallen))
    gloss = rng.uniform(0.2, 0.6)
    roughness = lerp(0.86 + 0.05 * wood, gloss + 0.05 * brush + 0.15 * curl, coat)
    return finish(rng, height, diffuse, roughness, lerp(0.032, 0.045, coat), grain=0.9)
