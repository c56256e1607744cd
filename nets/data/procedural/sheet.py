"""Sheet that is bent, joined or pressed: corrugated sheet, riveted panels, pressed tin."""

from __future__ import annotations

import numpy as np

from nets.data.procedural.coat import STEELS, dressed
from nets.data.procedural.compose import MaterialMaps
from nets.data.procedural.layout import Blocks, courses
from nets.data.procedural.noise import (
    Field,
    Real,
    bent,
    grid,
    lean,
    log_uniform,
    pick,
    rotated,
    smoothstep,
    spectral,
)
from nets.data.procedural.relief import Lattice, disc, lattice, runs, shoulder, softened, swell, zigzag


def corrugated_sheet(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Waves, ribs, trapezoids or standing seams along one direction, with dents, overlaps and screws."""
    angle = rng.choice([0.0, np.pi / 2, rng.uniform(0, np.pi)]) + rng.normal(0, 0.02)
    x, y = rotated(*grid(size), angle)
    x, y = bent(rng, x + rng.uniform(0, 1), y + rng.uniform(0, 1), rng.uniform(0, 0.006), low=2)
    pitch = log_uniform(rng, 0.08, 0.5)
    steep, t = rng.uniform(15, 55), x / pitch
    design = str(rng.choice(["wave", "wave", "rib", "trapezoid", "seam"]))
    from_middle = (0.5 - np.abs(t - np.floor(t) - 0.5)) * pitch  # from the border of a period inwards
    if design == "wave":
        height = -np.cos(2 * np.pi * t) * (pitch * np.tan(np.radians(steep)) / (2 * np.pi))
    elif design == "rib":
        half = pitch * rng.uniform(0.08, 0.3)
        height = swell(from_middle - pitch / 2 + half, half, steep)
    elif design == "trapezoid":
        run = pitch * rng.uniform(0.06, 0.16)
        height = shoulder(from_middle - pitch * rng.uniform(0.08, 0.25), run, steep, 1.0)
    else:  # narrow standing seams and small stiffening beads between them
        height = swell(from_middle - 0.46 * pitch, 0.05 * pitch, steep)
        height = height + 0.3 * swell(0.04 * pitch - np.abs(from_middle - 0.25 * pitch), 0.04 * pitch, steep)
    dents = -0.3 * np.logaddexp(0, (spectral(rng, size, 3, 14, slope=2.5) - rng.uniform(1.2, 3)) / 0.3)
    height = np.asarray(height + 0.02 * dents, dtype=np.float32)
    stain = np.zeros_like(x)
    if rng.random() < 0.35:  # the lap of one sheet over the next
        lap = y - rng.uniform(-0.8, 0.8) - 0.004 * spectral(rng, size, 3)
        height = height + 0.012 * smoothstep(0, 0.02, lap)
        stain = stain + np.exp(-np.abs(lap) / 0.05)
    if rng.random() < 0.4:  # screws on every crest
        screws = lattice(x, y, pitch, log_uniform(rng, 0.4, 1.0))
        inside = disc(screws.u, screws.v, min(0.16 * pitch, 0.04))
        height = height + swell(inside, 0.02, 45)
        stain = stain + runs(smoothstep(0, 0.01, inside), rng.uniform(0.05, 0.4))
    return dressed(rng, softened(height, 0.004), 0.5 * pitch, stain=np.clip(stain, 0, 1))


def _rivets(rng: np.random.Generator, blocks: Blocks, length: float, width: float) -> tuple[Field, float]:
    """Distance into rivet heads set along the borders of panels, and their radius."""
    radius = rng.uniform(0.014, 0.04) * min(1.0, 2 * width)
    inset = radius * rng.uniform(1.6, 3.0)
    spacing = radius * log_uniform(rng, 3.0, 9.0)

    def along_border(position: Real, off: Real, extent: float) -> Field:
        run = extent - 2 * inset
        step = run / max(round(run / spacing), 1)
        place = np.clip(np.round((position + run / 2) / step) * step, 0, run) - run / 2
        return np.asarray(radius - np.hypot(position - place, off), dtype=np.float32)

    lying = along_border(blocks.along, np.abs(blocks.across) - (width / 2 - inset), length)
    if rng.random() < 0.25:  # only one pair of borders is riveted
        return lying, radius
    standing = along_border(blocks.across, np.abs(blocks.along) - (length / 2 - inset), width)
    return np.maximum(lying, standing), radius


def riveted_panel(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Plates with bevelled seams, laps and buckled middles, held by rows of rivets or screws that run."""
    x, y = rotated(*grid(size), rng.choice([0.0, 0.0, np.pi / 2, rng.uniform(0, np.pi)]))
    x, y = bent(rng, x + rng.uniform(0, 1), y + rng.uniform(0, 1), rng.uniform(0, 0.004), low=2)
    width = log_uniform(rng, 0.35, 1.1)
    length = width * rng.uniform(1.0, 2.2)
    blocks = courses(x, y, length, width, np.array([0, rng.choice([0, 0.5, 0.35])]))
    gap = rng.uniform(0.003, 0.014)
    bevel = log_uniform(rng, 0.01, 0.06)
    face = shoulder(blocks.edge - gap, bevel, rng.uniform(25, 60), rng.uniform(1, 2.5))
    step = pick(rng, blocks.index, 0, 0.02) * smoothstep(0, gap, blocks.edge)
    buckle = smoothstep(0, 0.35 * width, blocks.edge) * pick(rng, blocks.index, -1, 1) * 0.03 * width
    askew = lean(rng, blocks.index, blocks.along, blocks.across, 0.04)
    height = np.asarray(face + step + buckle + askew, dtype=np.float32)
    stain = 1 - smoothstep(0, 0.05, blocks.edge - gap)
    if rng.random() < 0.85:
        head, radius = _rivets(rng, blocks, length, width)
        kind = str(rng.choice(["dome", "dome", "flat", "sunk"]))
        if kind == "dome":
            head_relief = shoulder(head, radius, rng.uniform(40, 60), 2.0)
        elif kind == "flat":
            head_relief = shoulder(head, 0.35 * radius, rng.uniform(35, 58), 1.3)
        else:  # countersunk
            head_relief = -swell(0.25 * radius - np.abs(head - 0.2 * radius), 0.25 * radius, 45)
        pulled = -0.15 * radius * np.exp(-((np.maximum(-head, 0) / radius) ** 2))  # sheet drawn in by it
        height = np.asarray(height + head_relief + pulled, dtype=np.float32)
        ring = np.exp(-np.abs(head) / (0.35 * radius))
        stain = np.maximum(stain, np.maximum(ring, runs(smoothstep(0, 0.01, head), rng.uniform(0.03, 0.35))))
    kinds = {"bare": 0.35, "painted": 0.4, "rusty": 0.22, "rubber": 0.03}
    return dressed(rng, softened(height, 0.004), 0.05, kinds=kinds, stain=stain)


def _ornament(rng: np.random.Generator, places: Lattice, pitch: float) -> Field:
    """A pressed design with the symmetries of the square: frames, rings, petals, beads, corner fans."""
    u, v = places.u / pitch, places.v / pitch  # -1/2 .. 1/2
    radius, angle = np.hypot(u, v), np.arctan2(v, u)
    from_border = 0.5 - np.maximum(np.abs(u), np.abs(v))
    steep = rng.uniform(18, 42)

    def ridge(distance: Real, half: float) -> Field:
        return swell(half - np.abs(distance), half, steep)

    relief = np.zeros_like(u)
    frame = rng.uniform(0.03, 0.1)
    relief = relief + ridge(from_border - frame, rng.uniform(0.015, 0.04))
    relief = relief + rng.choice([0, 1]) * swell(from_border - frame, rng.uniform(0.03, 0.12), steep)
    outer = rng.uniform(0.2, 0.4)
    for part in rng.permutation(["rings", "petals", "diamond", "corner", "beads", "fan", "coffer"])[
        : int(rng.integers(2, 6))
    ]:
        if part == "rings":
            for at in rng.uniform(0.06, outer, int(rng.integers(1, 4))):
                relief = relief + ridge(radius - at, rng.uniform(0.012, 0.035))
        elif part == "petals":
            count = int(rng.choice([4, 8, 8, 12, 16]))
            lobe = 0.55 + 0.45 * np.abs(np.cos(count / 2 * (angle + rng.choice([0.0, np.pi / count]))))
            relief = relief + swell(outer * lobe - radius, rng.uniform(0.04, 0.12), steep)
            crease = np.abs(np.sin(count / 2 * angle)) * radius
            relief = relief - 0.5 * ridge(crease, 0.02) * (radius < 0.9 * outer)
        elif part == "diamond":
            relief = relief + ridge(np.abs(u) + np.abs(v) - rng.uniform(0.3, 0.62), rng.uniform(0.015, 0.05))
        elif part == "corner":
            corner = np.hypot(0.5 - np.abs(u), 0.5 - np.abs(v))
            turn = np.arctan2(0.5 - np.abs(v), 0.5 - np.abs(u))
            lobe = 0.75 + 0.25 * np.abs(np.cos(6 * turn))
            relief = relief + swell(rng.uniform(0.12, 0.24) * lobe - corner, 0.05, steep)
        elif part == "beads":
            step = 1 / int(rng.integers(10, 24))
            along = np.where(np.abs(u) > np.abs(v), v, u)
            bead = np.hypot(along - (np.floor(along / step) + 0.5) * step, from_border - frame - 0.06)
            relief = relief + shoulder(0.42 * step - bead, 0.42 * step, 50, 2.0)
        elif part == "fan":
            flutes = np.cos(int(rng.choice([16, 24, 32])) * angle)
            between = smoothstep(0.4 * outer, 0.5 * outer, radius) * (
                1 - smoothstep(0.9 * outer, outer, radius)
            )
            relief = relief + 0.012 * flutes * between
        else:
            relief = relief - 2 * swell(from_border - rng.uniform(0.1, 0.2), rng.uniform(0.04, 0.15), steep)
    return np.asarray(relief * pitch, dtype=np.float32)


def pressed_tin(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Ceiling-like tiles with pressed ornament, blunted by coats of paint, tarnished or rusting."""
    x, y = rotated(*grid(size), rng.choice([0.0, 0.0, np.pi / 4, rng.uniform(0, np.pi)]))
    x, y = bent(rng, x + rng.uniform(0, 1), y + rng.uniform(0, 1), rng.uniform(0.001, 0.006), low=3)
    pitch = log_uniform(rng, 0.35, 1.3)
    places = lattice(x, y, pitch)
    if rng.random() < 0.12:  # a plain raised lattice
        u, v = zigzag(places.u / pitch * 3), zigzag(places.v / pitch * 3)
        relief = swell(np.minimum(u, v) - 0.2, 0.5, 30) * np.float32(pitch / 6)
    else:
        relief = _ornament(rng, places, pitch)
    relief = softened(relief, rng.uniform(0.004, 0.014)) * np.float32(rng.uniform(0.7, 1.1))
    border = pitch / 2 - np.maximum(np.abs(places.u), np.abs(places.v))
    seam = 1 - smoothstep(0, 0.012, border)
    height = relief - 0.008 * seam + pick(rng, places.index, 0, 0.008)
    height = height + lean(rng, places.index, places.u, places.v, 0.03)
    names = (*STEELS, "copper", "brass", "bronze", "gold", "silver")
    kinds = {"bare": 0.5, "painted": 0.4, "rusty": 0.1}
    return dressed(rng, height, 0.06 * pitch, names=names, kinds=kinds, stain=0.7 * seam)
