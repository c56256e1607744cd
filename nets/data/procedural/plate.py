"""Plate and sheet with a regular relief: tread plate, stamped and holed sheet, knurls, woven wire."""

from __future__ import annotations

import numpy as np

from nets.data.procedural.coat import STEELS, dressed
from nets.data.procedural.compose import (
    MaterialMaps,
    blend,
    choose,
    finish,
    lerp,
    metal,
    rgb,
    shade,
    tilted,
)
from nets.data.procedural.layout import weave
from nets.data.procedural.noise import (
    Field,
    bent,
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
from nets.data.procedural.relief import (
    Lattice,
    bar,
    box,
    disc,
    lattice,
    lens,
    rhombus,
    rubbed,
    shoulder,
    softened,
    swell,
    zigzag,
)


def _turned_grid(rng: np.random.Generator, size: int, crooked: float = 0.004) -> tuple[Field, Field]:
    """The plane turned: along the picture's axes, diagonal, or any way, and at most so `crooked`."""
    angle = rng.choice([0.0, np.pi / 2, np.pi / 4, rng.uniform(0, np.pi)]) + rng.normal(0, 0.02)
    x, y = rotated(*grid(size), angle)
    return bent(rng, x + rng.uniform(0, 1), y + rng.uniform(0, 1), rng.uniform(0, crooked), low=3)


def tread_plate(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Raised lenses, groups of bars, almonds or diamonds in rows, of all proportions, worn by feet."""
    x, y = _turned_grid(rng, size)
    pitch = log_uniform(rng, 0.14, 0.5)
    design = str(rng.choice(["lens", "bars", "almond", "diamond"]))
    if design == "bars":  # two to five parallel bars in a square, and across them in the next
        places = lattice(x, y, pitch)
        along, across = places.turned(places.parity * np.float32(np.pi / 2))
        count = int(rng.integers(2, 6))
        spacing = pitch * rng.uniform(0.75, 0.95) / count
        number = np.clip(np.round(across / spacing - (count - 1) / 2), -(count - 1), 0) + (count - 1) / 2
        half = spacing * rng.uniform(0.26, 0.4)
        distance = lens(along, across - number * spacing, pitch * rng.uniform(0.4, 0.48), half)
    else:
        aspect, stagger = rng.choice([1.0, 1.0, rng.uniform(0.6, 1.2)]), rng.choice([0.0, 0.5])
        places = lattice(x, y, pitch, pitch * aspect, stagger)
        lean = rng.choice([np.pi / 4, rng.uniform(0.2, 0.9)])
        angle = (2 * places.parity - 1) * lean if rng.random() < 0.75 else 0 * places.parity
        along, across = places.turned(angle.astype(np.float32))
        length, half = pitch * rng.uniform(0.36, 0.5) * min(aspect, 1.0), pitch * rng.uniform(0.09, 0.18)
        outline = {"lens": lens, "almond": bar, "diamond": rhombus}[design]
        distance = outline(along, across, length, half)
    width, steep = half * rng.uniform(0.45, 1.0), rng.uniform(35, 60)
    rounded = rng.random() < 0.5
    height = swell(distance, width, steep) if rounded else shoulder(distance, width, steep, 1.4)
    top = float(height.max())
    level = top * (rng.uniform(0.7, 1.15) + 0.08 * spectral(rng, size, 2, slope=1.5))
    height = softened(rubbed(height, level, 0.06 * top), 0.004)
    return dressed(rng, height, 0.35 * pitch)


def stamped_sheet(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Sheet with rows of studs, dimples, coins, rings or craters pressed into it, or with holes punched."""
    x, y = _turned_grid(rng, size)
    pitch = log_uniform(rng, 0.1, 0.42)
    stagger = rng.choice([0.0, 0.5])
    places = lattice(x, y, pitch, pitch * (np.sqrt(0.75) if stagger else 1.0), stagger)
    radius = pitch * rng.uniform(0.2, 0.42)
    if rng.random() < 0.35:
        return _holed(rng, places, pitch, radius)
    steep = rng.uniform(20, 55)
    inside = disc(places.u, places.v, radius)
    design = str(rng.choice(["stud", "coin", "ring", "crater", "pad"]))
    if design == "stud":
        height = shoulder(inside, radius, steep, 2.0)
    elif design == "coin":
        height = swell(inside, radius * rng.uniform(0.25, 0.5), steep)
    elif design == "ring":
        height = swell(radius * 0.3 - np.abs(inside - radius * 0.35), radius * 0.3, steep)
    elif design == "crater":  # a dimple with the rim the punch threw up
        height = 1.2 * swell(inside, 0.8 * radius, steep) - swell(
            inside + 0.25 * radius, 0.35 * radius, 0.6 * steep
        )
    else:
        half = (radius, radius * rng.uniform(0.4, 1))
        height = swell(box(places.u, places.v, *half, 0.3 * half[1]), 0.4 * half[1], steep)
    uneven = pick(rng, places.index, rng.uniform(0.7, 1), 1.0)
    height = height * uneven * np.float32(rng.choice([1, 1, -1]))
    return dressed(rng, softened(height, 0.004), radius)


def _holed(rng: np.random.Generator, places: Lattice, pitch: float, radius: float) -> MaterialMaps:
    """Holes with burred or countersunk rims; nothing but shade inside."""
    size = places.u.shape[0]
    shape = str(rng.choice(["round", "round", "square", "slot", "rhombus"]))
    narrow = radius * rng.uniform(0.3, 0.6)
    edge = {
        "round": disc(places.u, places.v, radius),
        "square": box(places.u, places.v, radius, radius, 0.15 * radius),
        "slot": bar(places.u, places.v, 1.1 * radius, narrow),
        "rhombus": rhombus(places.u, places.v, 1.15 * radius, 0.9 * radius),
    }[shape]
    rim = pitch * rng.uniform(0.05, 0.14)
    burr = float(rng.choice([-0.7, -0.3, 0.0, 0.5]))
    lip = swell(edge + rim, rim, abs(burr) * 45 + 1) * np.sign(burr) * smoothstep(rim, 0, edge)
    inner = min(rim, 0.5 * narrow)
    height = softened(lip - shoulder(edge, inner, rng.uniform(45, 62), 1.2), 0.005)
    maps = dressed(rng, height, radius)
    dark = smoothstep(0.25 * inner, inner + 2 / size, edge)
    return MaterialMaps(
        maps.height,
        blend(maps.diffuse, np.float32(0.08) * maps.diffuse, dark),
        lerp(maps.roughness, np.clip(maps.roughness + 0.35, 0, 0.95), dark),
        blend(maps.specular, np.float32(0.5) * np.minimum(maps.specular, 0.06), dark),
    )


def knurled_metal(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Diamond, square or straight knurls with flattened crests, all over or in bands of a turned part."""
    x, y = _turned_grid(rng, size, 0.001)
    pitch = log_uniform(rng, 0.045, 0.18)
    half = rng.choice([np.pi / 6, np.pi / 4, rng.uniform(0.3, 1.0)])
    u, v = rotated(x, y, half)[1] / pitch, rotated(x, y, -half)[1] / pitch
    design = str(rng.choice(["pyramids", "pyramids", "straight", "grooves"]))
    crest = {
        "pyramids": np.minimum(zigzag(u), zigzag(v)),
        "straight": zigzag(x / pitch),
        "grooves": np.minimum(np.minimum(zigzag(u), zigzag(v)) * 3, 1),
    }[design]
    steep = np.tan(np.radians(rng.uniform(18, 45)))
    height = np.asarray(crest * (0.5 * pitch * steep / (3 if design == "grooves" else 1)), dtype=np.float32)
    top = float(height.max())
    height = rubbed(height, top * (rng.uniform(0.55, 0.95) + 0.06 * spectral(rng, size, 2)), 0.05 * top)
    if rng.random() < 0.35:  # bands: smooth and turned between the knurls, with a chamfer
        band = log_uniform(rng, 0.35, 1.2)
        inside = box(0 * x, np.mod(y, band) - band / 2, 9.0, band * rng.uniform(0.25, 0.42), 0.001)
        face = smoothstep(0, 0.06 * band, inside)
        turning = tilted(spectral(rng, size, 30, slope=0.6), rng.uniform(1, 4))
        height = face * height + (1 - face) * (rng.uniform(0.2, 1) * top + turning)
    names = (*STEELS, "brass", "bronze", "copper", "gold")
    kinds = {"bare": 0.8, "painted": 0.1, "rusty": 0.05, "rubber": 0.05}
    return dressed(rng, softened(height, 0.003), pitch, names=names, kinds=kinds)


_TWILL = np.array([[(i + j) % 4 > 1 for i in range(4)] for j in range(4)])
_PLAIN = np.array([[True, False], [False, True]])


def wire_mesh(rng: np.random.Generator, size: int) -> MaterialMaps:
    """Round wires woven plain or in twill, open to tight, over nothing or over a backing."""
    x, y = _turned_grid(rng, size)
    wires = log_uniform(rng, 12, 44)
    tightness = rng.uniform(0.5, 0.98)
    cloth = weave(x, y, wires, _PLAIN if rng.random() < 0.6 else _TWILL, tightness)
    gap = (cloth.height < -1.15).astype(np.float32)
    scale = tightness * rng.uniform(0.3, 0.6) / wires
    relief = softened(cloth.height * scale, rng.uniform(0.1, 0.2) / wires)
    scratch = strokes(rng, size, int(rng.integers(10, 300)), 0.2, curl=0.3)
    bumpy = tilted(spectral(rng, size, 40, slope=0.8), rng.uniform(1, 4))
    height = relief + bumpy + tilted(spectral(rng, size, 1.5, 5, 3), rng.uniform(0.5, 4)) - 0.001 * scratch
    film = rng.uniform(0.05, 0.7) * unit(spectral(rng, size, 2, slope=1.2))
    deep = np.clip(
        1 - smoothstep(-1.0, 0.6, cloth.height) + 0.5 * smoothstep(0.5, 1, np.abs(cloth.across)), 0, 1
    )
    dirt = np.clip(rng.uniform(0, 1) * deep * unit(spectral(rng, size, 3, slope=1.1)), 0, 1)
    dirt = np.clip(dirt + patches(spectral(rng, size, 4), rng.uniform(0, 0.15), 0.4) * 0.6, 0, 1)
    tone = pick(rng, cloth.thread, 0.85, 1.0)
    f0 = shade(metal(rng, (*STEELS, "brass", "bronze", "copper")), tone * (1 - 0.5 * film))
    soil = choose(rng, ("#3a332c", "#4a4038", "#2a2826", "#6b4a30"))
    diffuse = blend(rgb(0.015, 0.015, 0.015) + 0.02 * f0, soil, dirt)
    specular = blend(f0, rgb(0.04, 0.04, 0.04), 0.9 * dirt)
    roughness = lerp(rng.uniform(0.18, 0.55) + 0.3 * film + 0.15 * scratch, 0.85, dirt)
    behind = (
        rgb(0.012, 0.012, 0.012) if rng.random() < 0.7 else choose(rng, ("#5a5550", "#2a2826", "#8a8070"))
    )
    return finish(
        rng,
        height,
        blend(diffuse, behind, gap),
        lerp(roughness, 0.92, gap),
        blend(specular, rgb(0.025, 0.025, 0.025), gap),
        grain=0.6,
    )
