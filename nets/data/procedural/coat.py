"""What a relief of sheet or plate is made of and what time did to it: bare, painted, rusty, or rubber.

`dressed` takes a height field and gives the maps. It rubs what stands out, soils what lies low, and adds
films, smears and spots that have nothing to do with the relief, as real surfaces have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
    metal,
    rgb,
    shade,
    shades,
    tilted,
)
from nets.data.procedural.noise import Field, Real, log_uniform, patches, smoothstep, spectral, strokes, unit

STEELS = ("iron", "iron", "aluminium", "zinc", "chromium", "titanium", "nickel")

KINDS: Mapping[str, float] = {"bare": 0.45, "painted": 0.25, "rusty": 0.15, "rubber": 0.15}

_DIRT = ("#3a332c", "#4a4038", "#2a2826", "#5a4c3c", "#6e6250")
_RUST = ("#6b3a20", "#8a4a24", "#4a2a1c", "#a5622f", "#7a5236")


@dataclass(frozen=True)
class _State:
    """What happened to the surface, `[H, W]` each, in [0, 1]."""

    high: Field  # stands out: rubbed
    low: Field  # lies deep: dirt stays
    film: Field  # uneven tarnish, smears, finger marks
    scratch: Field
    dirt: Field
    fine: Field  # rolling or casting texture, of unit deviation


def _state(rng: np.random.Generator, height: Real, reach: float, stain: Real | None) -> _State:
    size = height.shape[0]
    depth = cavity(height, reach)
    high, low = smoothstep(0.2, 1.8, -depth), smoothstep(0.1, 1.6, depth)
    angle = rng.uniform(0, np.pi)
    smear = unit(spectral(rng, size, 3, slope=1.3, stretch=rng.uniform(1, 5), angle=angle))
    film = unit(spectral(rng, size, 2, slope=1.2)) * (0.4 + 0.6 * smear)
    scratch = strokes(rng, size, int(log_uniform(rng, 20, 900)), rng.uniform(0.1, 0.6), curl=0.3)
    spots = patches(spectral(rng, size, rng.uniform(2, 8), slope=1.2), rng.uniform(0, 0.25), 0.6)
    settled = low * unit(spectral(rng, size, 3, slope=1.1) + rng.uniform(-1, 1.5))
    dirt = rng.uniform(0.1, 1.2) * settled + rng.uniform(0, 0.4) * spots
    if stain is not None:
        dirt = dirt + stain * unit(spectral(rng, size, 5, slope=1.0)) * rng.uniform(0, 1)
    stretch = rng.choice([1.0, 1.0, 8.0])
    fine = spectral(rng, size, rng.uniform(10, 40), slope=rng.uniform(0.9, 1.4), stretch=stretch, angle=angle)
    return _State(high, low, film, np.clip(scratch, 0, 1), np.clip(dirt, 0, 1), fine)


def dressed(
    rng: np.random.Generator,
    height: Real,
    reach: float,
    *,
    names: Sequence[str] = STEELS,
    kinds: Mapping[str, float] = KINDS,
    stain: Real | None = None,
) -> MaterialMaps:
    """The maps of a relief in a random metal, paint or rubber.

    Args:
        rng: source of randomness.
        height: the relief in surface units.
        reach: size of its shapes in surface units: what is deeper than its surroundings within it is dirty.
        names: metals to choose among.
        kinds: weights of what it may be: `bare`, `painted`, `rusty`, `rubber`.
        stain: where dirt or rust gathers besides, in [0, 1].
    """
    state = _state(rng, height, reach, stain)
    weights = np.array(list(kinds.values()))
    kind = str(rng.choice(list(kinds), p=weights / weights.sum()))
    rolled = tilted(state.fine, rng.uniform(0.7, 4))
    warp = tilted(spectral(rng, height.shape[0], 1.5, 5, 3), rng.uniform(0.2, 2))
    height = np.asarray(height + rolled + warp - 0.0012 * state.scratch, dtype=np.float32)
    if kind == "rubber":
        return _rubber(rng, height, state)
    f0 = metal(rng, names)
    if kind == "painted":
        return _painted(rng, height, f0, state)
    return _metal(rng, height, f0, state, stain, rusty=kind == "rusty")


def _dirty(rng: np.random.Generator, state: _State) -> Colour:
    return shades(rng, choose(rng, _DIRT), unit(state.fine), 0.3)


def _metal(
    rng: np.random.Generator, height: Real, f0: Colour, state: _State, stain: Real | None, *, rusty: bool
) -> MaterialMaps:
    size = height.shape[0]
    tarnish = rng.uniform(0.05, 0.8) * state.film * (1 - rng.uniform(0.2, 0.8) * state.high)
    polish = rng.uniform(0, 0.2) * state.high
    roughness = rng.uniform(0.15, 0.5) + 0.25 * tarnish - polish + 0.15 * state.scratch + 0.03 * state.fine
    specular = shade(f0, (1 - 0.55 * tarnish) * (1 - 0.25 * state.low))
    diffuse = blend(rgb(0.01, 0.01, 0.01) + 0.02 * f0, _dirty(rng, state), 0.12 * tarnish)
    if rusty:
        crust = spectral(rng, size, 15, slope=1.1)
        where = spectral(rng, size, log_uniform(rng, 2, 6), slope=1.3) + state.low - 0.5 * state.high
        if stain is not None:
            where = where + 1.5 * stain
        rust = patches(where, rng.uniform(0.1, 0.8), rng.uniform(0.15, 0.6))
        height = height + tilted(crust, rng.uniform(4, 11)) * rust
        brown = shades(rng, choose(rng, _RUST), unit(crust + spectral(rng, size, 4)), 0.5)
        diffuse = blend(diffuse, brown, rust)
        specular = blend(specular, rgb(0.04, 0.04, 0.04), 0.95 * rust)
        roughness = lerp(roughness, 0.85 + 0.05 * crust, rust)
    diffuse = blend(diffuse, _dirty(rng, state), state.dirt)
    specular = blend(specular, rgb(0.04, 0.04, 0.04), 0.9 * state.dirt)
    return finish(rng, height, diffuse, lerp(roughness, 0.85, state.dirt), specular, grain=0.6)


def _painted(rng: np.random.Generator, height: Real, f0: Colour, state: _State) -> MaterialMaps:
    """Paint that is rubbed and chipped off where the relief stands out; metal, primer or rust below."""
    size = height.shape[0]
    torn = spectral(rng, size, log_uniform(rng, 4, 16), slope=1.2)
    worn = rng.uniform(0.5, 4) * state.high + torn + 0.5 * np.clip(3 * state.scratch, 0, 1)
    coverage = log_uniform(rng, 0.008, 0.3) if rng.random() < 0.75 else 0.0
    bare = patches(worn, coverage, rng.uniform(0.05, 0.3)) * float(coverage > 0)
    coat = 1 - bare
    peel = tilted(spectral(rng, size, 14, 50, 1.2), rng.uniform(0.5, 3))
    height = height + coat * (rng.uniform(0.001, 0.005) + peel)
    colour = shades(rng, dye(rng), unit(spectral(rng, size, 2)), rng.uniform(0.02, 0.2))
    faded = rng.uniform(0, 0.5) * state.film
    colour = blend(colour, np.clip(0.5 * colour + 0.25 * colour.mean() + 0.08, 0, 0.9), faded)
    below = choose(rng, _RUST) if rng.random() < 0.5 else dye(rng, (0, 0.25))
    rust = patches(spectral(rng, size, 4, slope=1.1), rng.uniform(0, 1), 0.3)
    shine = blend(f0, rgb(0.04, 0.04, 0.04), rust)
    diffuse = blend(blend(rgb(0.02, 0.02, 0.02), below, rust), colour, coat)
    specular = blend(shine, rgb(0.045, 0.045, 0.045), coat)
    gloss = rng.uniform(0.12, 0.6) + 0.2 * faded + 0.2 * state.scratch + 0.1 * state.film
    roughness = lerp(lerp(0.4, 0.85, rust) + 0.04 * state.fine, gloss, coat)
    diffuse = blend(diffuse, _dirty(rng, state), 0.9 * state.dirt)
    specular = blend(specular, rgb(0.04, 0.04, 0.04), state.dirt)
    return finish(rng, height, diffuse, lerp(roughness, 0.85, state.dirt), specular, grain=0.6)


def _rubber(rng: np.random.Generator, height: Real, state: _State) -> MaterialMaps:
    """Moulded rubber or plastic: grey, black or dyed, shiny where it is rubbed, dusty where it is not."""
    base = choose(rng, ("#1e1e1f", "#2b2a2a", "#3a3a3c", "#55565a")) if rng.random() < 0.5 else dye(rng)
    colour = shade(shades(rng, base, state.film, 0.15), 1 + 0.05 * state.fine + 0.4 * state.scratch)
    colour = blend(colour, np.clip(colour * 1.3 + 0.01, 0, 0.9), rng.uniform(0, 0.6) * state.high)
    diffuse = blend(colour, choose(rng, ("#8a8070", "#9a958c", "#6a6258", "#4a4038")), 0.7 * state.dirt)
    roughness = rng.uniform(0.3, 0.75) + 0.1 * state.film - rng.uniform(0, 0.15) * state.high
    roughness = lerp(roughness + 0.1 * state.scratch + 0.03 * state.fine, 0.9, state.dirt)
    return finish(rng, height, diffuse, roughness, 0.042 - 0.012 * state.dirt, grain=0.8)
