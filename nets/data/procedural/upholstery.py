"""Padded covers: leather or cloth pulled down by buttons, or quilted along stitched seams."""

from __future__ import annotations

import numpy as np

from nets.data.procedural.compose import (
    MaterialMaps,
    blend,
    cavity,
    choose,
    dye,
    finish,
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
    log_uniform,
    patches,
    pick,
    rotated,
    smoothstep,
    spectral,
    strokes,
    unit,
)
from nets.data.procedural.relief import hexagons, lattice, padded, shoulder, softened, swell

_HIDE = ("#5a3a26", "#2b211c", "#8a5a36", "#a87b52", "#6b2f25", "#1c1b1b", "#c9b79a", "#3c2a22")


def _cover(
    rng: np.random.Generator, padding: Real, crease: Real, reach: float, thread: Real | None = None
) -> MaterialMaps:
    """Hide, vinyl or cloth over a padded height; `crease` and `thread` mark folds and stitches in [0, 1]."""
    size = padding.shape[0]
    cloth = rng.random() < 0.17
    x, y = bent(rng, *grid(size), 0.015, low=8, slope=1.8)
    count = log_uniform(rng, 24, 80)
    pebbles = cells(rng, x, y, count, aspect=rng.uniform(0.75, 1.3))
    pebble = smoothstep(0, rng.uniform(0.3, 0.8) / count, pebbles.edge) * pick(rng, pebbles.index, 0.6, 1)
    if cloth:
        pebble = unit(spectral(rng, size, 50, slope=0.8) + strokes(rng, size, 1500, 0.06, curl=1.5))
    folds = spectral(rng, size, 4, 30, slope=1.8, stretch=rng.uniform(1, 3), angle=rng.uniform(0, np.pi))
    sag = tilted(spectral(rng, size, 2, 8, 2.5), rng.uniform(0.5, 4))
    stretched = 1 - 0.5 * crease
    height = padding + sag + tilted(folds, rng.uniform(0.5, 4))
    height = height + tilted(pebble, rng.uniform(3, 11)) * stretched

    base = dye(rng) if cloth or rng.random() < 0.45 else choose(rng, _HIDE)
    depth = cavity(padding, reach)
    patina = unit(spectral(rng, size, 2, slope=1.4))
    colour = shade(shades(rng, base, patina, rng.uniform(0.05, 0.3)), 1.08 - 0.4 * (1 - pebble))
    soiled = np.clip(rng.uniform(0.2, 0.8) * smoothstep(0.2, 2.2, depth) + 0.5 * crease, 0, 1)
    diffuse = shade(colour, 1 - 0.7 * soiled)
    rub_at = spectral(rng, size, 3, slope=1.2) - depth + 0.5 * pebble
    rubs = patches(rub_at, rng.uniform(0, 0.2), 0.4) * smoothstep(0.8, -0.2, depth)
    diffuse = blend(diffuse, np.clip(1.7 * diffuse + 0.02, 0, 0.85), rng.uniform(0.2, 0.7) * rubs)
    gloss = rng.uniform(0.6, 0.85) if cloth else rng.uniform(0.15, 0.5)
    shine = rng.uniform(-0.1, 0.15) * rubs + 0.1 * patina + 0.03 * np.tanh(folds)
    roughness = gloss + shine + 0.1 * (1 - pebble) + 0.12 * soiled
    if thread is not None:
        yarn = dye(rng) if rng.random() < 0.5 else np.clip(base * np.float32(rng.uniform(0.5, 2)), 0, 0.9)
        diffuse = blend(diffuse, yarn, thread)
        roughness = roughness + (0.7 - roughness) * thread
    return finish(rng, height, diffuse, roughness, 0.042 - 0.015 * soiled, grain=1.0 if cloth else 0.6)


def tufted_leather(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Deep buttons in a diamond or square pattern, pleats between them, cushions that swell around."""
    x, y = rotated(*grid(size), rng.choice([0.0, 0.0, rng.uniform(-0.4, 0.4), np.pi / 2]))
    x, y = bent(rng, x + rng.uniform(0, 1), y + rng.uniform(0, 1), rng.uniform(0.004, 0.02), low=3)
    pitch = log_uniform(rng, 0.3, 0.95)
    tall = pitch * rng.uniform(0.85, 1.6)
    diamond = rng.random() < 0.7
    p, q = (x / pitch + y / tall, x / pitch - y / tall) if diamond else (x / pitch, y / tall)
    # Pleats run where p or q is whole, buttons sit where both are: from there to the middle of a cushion.
    s, t = np.abs(p - np.round(p)), np.abs(q - np.round(q))
    puff = rng.uniform(0.5, 0.9)
    cushion = (np.sin(np.pi * s) * np.sin(np.pi * t)) ** puff
    side = pitch * (0.6 if diamond else 1.0)
    steep = np.tan(np.radians(rng.uniform(18, 42)))
    padding = np.asarray(0.28 * side * steep * cushion, dtype=np.float32)
    pleat_width = rng.uniform(0.02, 0.07)
    fold = np.exp(-((np.minimum(s, t) / pleat_width) ** 2)) * rng.uniform(0.2, 1.0)

    if diamond:  # back from (p, q) to the nearest button
        du = ((p - np.round(p)) + (q - np.round(q))) * pitch / 2
        dv = ((p - np.round(p)) - (q - np.round(q))) * tall / 2
    else:
        du, dv = (p - np.round(p)) * pitch, (q - np.round(q)) * tall
    away = np.hypot(du, dv)
    button = side * rng.uniform(0.07, 0.14)
    pull = np.exp(-away / (button * rng.uniform(1.5, 3.0)))
    rays = np.cos(np.arctan2(dv, du) * int(rng.integers(8, 18)) + 2 * spectral(rng, size, 6))
    puckers = 0.1 * button * rays * np.exp(-away / (1.5 * button)) * smoothstep(0.9, 1.6, away / button)
    padding = padding - button * rng.uniform(0.8, 2.0) * pull - 0.05 * side * fold + puckers
    inside = button - away
    seat = -button * rng.uniform(0.6, 1.3)
    head = seat + shoulder(inside, button, rng.uniform(35, 55), 2.0)
    has_button = rng.random() < 0.85
    covered = smoothstep(-0.02 * button, 0.12 * button, inside) * float(has_button)
    height = softened(padding + (head - padding) * covered, 0.006)
    ring = np.exp(-np.abs(inside) / (0.18 * button)) * float(has_button)
    crease = np.clip(0.8 * fold * (1 - covered) + ring, 0, 1)
    return _cover(rng, height, np.asarray(crease, dtype=np.float32), 0.3 * side)


def _seams(rng: np.random.Generator, size: int, pitch: float) -> tuple[Field, Field]:
    """Distance to the nearest seam, and the way along it, of channels, squares, diamonds or hexagons."""
    x, y = rotated(*grid(size), rng.choice([0.0, np.pi / 2, rng.uniform(0, np.pi)]))
    x, y = bent(rng, x + rng.uniform(0, 1), y + rng.uniform(0, 1), rng.uniform(0.001, 0.012), low=3)
    design = str(rng.choice(["channels", "squares", "diamonds", "diamonds", "hexagons", "bricks"]))
    if design == "hexagons":
        places, edge = hexagons(x, y, pitch)
        angle = np.round(np.arctan2(places.v, places.u) / (np.pi / 3)) * np.float32(np.pi / 3)
        along = places.v * np.cos(angle) - places.u * np.sin(angle)
        return edge, np.asarray(along, dtype=np.float32)
    if design == "channels":
        places = lattice(x, y, 50.0, pitch)
        return np.asarray(pitch / 2 - np.abs(places.v), dtype=np.float32), x
    if design == "diamonds":
        half = rng.uniform(0.4, 0.9)
        p, q = rotated(x, y, half)[1], rotated(x, y, -half)[1]
        lines = (pitch / 2 - np.abs(t - (np.floor(t / pitch) + 0.5) * pitch) for t in (p, q))
        first, second = lines
        nearer = first < second
        along = np.where(nearer, rotated(x, y, half)[0], rotated(x, y, -half)[0])
        return np.minimum(first, second).astype(np.float32), along.astype(np.float32)
    rise = pitch * rng.uniform(0.5, 1)
    places = lattice(x, y, pitch, rise, 0.5 if design == "bricks" else 0.0)
    beside, over = pitch / 2 - np.abs(places.u), rise / 2 - np.abs(places.v)
    return np.minimum(beside, over), np.where(beside < over, y, x).astype(np.float32)


def quilted_leather(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Padding stitched down along seams, puckered beside them, with thread of its own or another colour."""
    pitch = log_uniform(rng, 0.17, 0.7)
    seam, along = _seams(rng, size, pitch)
    puff = pitch * rng.uniform(0.25, 0.5)
    padding = shoulder(seam, puff, rng.uniform(22, 55), rng.uniform(1.6, 3.0))
    padding = padded(padding, seam, rng.uniform(0.05, 0.12) * pitch)
    gather = spectral(rng, size, 12, 60, slope=1.0)
    near = np.exp(-seam / (0.16 * pitch)) * smoothstep(0, 0.02, seam)
    padding = padding + near * rng.uniform(0, 0.008) * gather
    groove = np.exp(-((seam / rng.uniform(0.008, 0.02)) ** 2))
    crease = np.asarray(groove * rng.uniform(0.2, 0.8), dtype=np.float32)
    double = rng.random() < 0.3  # a seam between two rows of stitches, or one row in the seam
    off = seam - rng.uniform(0.02, 0.035) if double else seam
    step, half = rng.uniform(0.03, 0.06), rng.uniform(0.005, 0.009)
    phase = along / step - np.floor(along / step) - 0.5
    stitch = 1 - (phase * step / (0.4 * step)) ** 2 - (off / half) ** 2
    thread = smoothstep(0, 0.5, np.asarray(stitch, dtype=np.float32))
    sewn = rng.random() < 0.8
    height = softened(padding - 0.004 * groove, 0.005)
    height = height + float(sewn) * swell(stitch * half, 0.8 * half, 38)
    return _cover(rng, height, crease * (1 - thread), 0.2 * pitch, thread if sewn else None)
