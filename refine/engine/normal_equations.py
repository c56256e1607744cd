"""The compiled loops of fused Gauss-Newton: objective, gradient and curvature of blocks of pixels.

A colour's residual depends on its own diffuse and specular albedo and on what the colours share, two slopes
and the roughness. So the 9 x 9 curvature is an arrow: a 3 x 3 head, three 2 x 2 blocks, and their couplings.
It is solved in `newton_step.py`. Rows, blocks and the rules of the loops are those of `kernel.py`.
"""

from __future__ import annotations

import math
from typing import no_type_check

from refine.engine.kernel import (
    BLOCK,
    CEILING,
    CURVE,
    FRESNEL,
    GRADIENT,
    HALF,
    IRRADIANCE,
    LIGHT,
    MATERIAL,
    MOVES,
    OFFSET,
    PARAMETERS,
    PHOTO_ROWS,
    SCRATCH_ROWS,
    TARGET,
    VIEW,
    _material,
)
from refine.engine.shading import shading
from refine.engine.simd import compiled, log

# Rows of the scratch block that Adam's moments have in `kernel.py`: where the pixel was before a step.
BEFORE = 0
# And behind its rows: what `shading` returns; the head of the curvature (pp pq pr qq qr rr); per colour the
# couplings (p q r with diffuse, then with specular) and the block (dd ds ss).
SHADED = SCRATCH_ROWS
HEAD = SHADED + 7
COLORS = HEAD + 6
COLOR_ROWS = 9
# Objective and, behind it, distance from the photo (in units of noise), now and after a trial step.
COST = COLORS + 3 * COLOR_ROWS
NEW_COST, DAMPING, NEWTON_ROWS = COST + 2, COST + 4, COST + 5


@compiled
@no_type_check
def _shade(photo, scratch, constants):
    """Leave what the colours share in the rows from `SHADED` on."""
    for i in range(BLOCK):
        shared = shading(
            scratch[MATERIAL * BLOCK + i],
            scratch[(MATERIAL + 1) * BLOCK + i],
            scratch[(MATERIAL + 5) * BLOCK + i],
            photo[LIGHT * BLOCK + i],
            photo[(LIGHT + 1) * BLOCK + i],
            photo[(LIGHT + 2) * BLOCK + i],
            photo[VIEW * BLOCK + i],
            photo[(VIEW + 1) * BLOCK + i],
            photo[(VIEW + 2) * BLOCK + i],
            photo[HALF * BLOCK + i],
            photo[(HALF + 1) * BLOCK + i],
            photo[(HALF + 2) * BLOCK + i],
            constants,
        )
        scratch[SHADED * BLOCK + i] = shared[0]
        scratch[(SHADED + 1) * BLOCK + i] = shared[1]
        scratch[(SHADED + 2) * BLOCK + i] = shared[2]
        scratch[(SHADED + 3) * BLOCK + i] = shared[3]
        scratch[(SHADED + 4) * BLOCK + i] = shared[4]
        scratch[(SHADED + 5) * BLOCK + i] = shared[5]
        scratch[(SHADED + 6) * BLOCK + i] = shared[6]


@compiled
@no_type_check
def _add_cost(color, photo, scratch, constants, robust, row):
    """Add one colour's Huber cost to a row, and its distance to the next."""
    real = type(photo[0])
    one, half, inverse_pi = real(1.0), real(0.5), real(1.0 / math.pi)
    offset, noise, huber = constants[5], robust[0], robust[1]
    for i in range(BLOCK):
        n_dot_l, lobe = scratch[SHADED * BLOCK + i], scratch[(SHADED + 3) * BLOCK + i]
        diffuse = scratch[(MATERIAL + 2 + color) * BLOCK + i]
        specular = scratch[(MATERIAL + 6 + color) * BLOCK + i]
        ceiling, target = photo[CEILING * BLOCK + i], photo[(TARGET + color) * BLOCK + i]
        fresnel = specular + (one - specular) * photo[FRESNEL * BLOCK + i]
        reflectance = diffuse * (one - specular) * inverse_pi + lobe * fresnel
        radiance = reflectance * n_dot_l * photo[(IRRADIANCE + color) * BLOCK + i]
        explained = (ceiling if radiance > ceiling else radiance) + offset
        scaled = math.fabs(log(explained / target)) / noise
        within = scaled if scaled < huber else huber
        scratch[row * BLOCK + i] += within * (scaled - half * within)
        scratch[(row + 1) * BLOCK + i] += scaled


@compiled
@no_type_check
def _add_color(color, photo, scratch, constants, robust, active, moves):
    """Add one colour's residual to gradient and curvature, by parameters."""
    real = type(photo[0])
    zero, one, three, inverse_pi = real(0.0), real(1.0), real(3.0), real(1.0 / math.pi)
    offset, noise, huber = constants[5], robust[0], robust[1]
    on_p, on_r = active[0], active[5]
    on_d, on_s = active[2 + color], active[6 + color]
    rows = COLORS + color * COLOR_ROWS
    for i in range(BLOCK):
        n_dot_l, lobe = scratch[SHADED * BLOCK + i], scratch[(SHADED + 3) * BLOCK + i]
        diffuse = scratch[(MATERIAL + 2 + color) * BLOCK + i]
        specular = scratch[(MATERIAL + 6 + color) * BLOCK + i]
        weight, ceiling = photo[FRESNEL * BLOCK + i], photo[CEILING * BLOCK + i]
        irradiance, target = photo[(IRRADIANCE + color) * BLOCK + i], photo[(TARGET + color) * BLOCK + i]
        fresnel = specular + (one - specular) * weight
        reflectance = diffuse * (one - specular) * inverse_pi + lobe * fresnel
        radiance = reflectance * n_dot_l * irradiance
        clipped = radiance > ceiling
        explained = (ceiling if clipped else radiance) + offset
        residual = log(explained / target)
        beyond = math.fabs(residual) / (noise * huber)
        certainty = one / (noise * noise * (beyond if beyond > one else one))
        # Derivatives of the logarithm, each with the slope of its parameter's curve (kept over three).
        slope = zero if clipped else three * moves[i] * irradiance / explained
        lit = slope * n_dot_l
        scale = scratch[CURVE * BLOCK + i] * on_p
        j_p = scale * (slope * scratch[(SHADED + 1) * BLOCK + i] * reflectance)
        j_p += scale * (lit * fresnel * scratch[(SHADED + 4) * BLOCK + i])
        j_q = scale * (slope * scratch[(SHADED + 2) * BLOCK + i] * reflectance)
        j_q += scale * (lit * fresnel * scratch[(SHADED + 5) * BLOCK + i])
        j_r = on_r * scratch[(CURVE + 5) * BLOCK + i] * lit * fresnel * scratch[(SHADED + 6) * BLOCK + i]
        j_d = on_d * scratch[(CURVE + 2 + color) * BLOCK + i] * lit * (one - specular) * inverse_pi
        j_s = on_s * scratch[(CURVE + 6 + color) * BLOCK + i] * lit
        j_s *= lobe * (one - weight) - diffuse * inverse_pi

        told = certainty * residual
        scratch[GRADIENT * BLOCK + i] += told * j_p
        scratch[(GRADIENT + 1) * BLOCK + i] += told * j_q
        scratch[(GRADIENT + 2 + color) * BLOCK + i] += told * j_d
        scratch[(GRADIENT + 5) * BLOCK + i] += told * j_r
        scratch[(GRADIENT + 6 + color) * BLOCK + i] += told * j_s
        w_p, w_q, w_r, w_d, w_s = (
            certainty * j_p,
            certainty * j_q,
            certainty * j_r,
            certainty * j_d,
            certainty * j_s,
        )
        scratch[HEAD * BLOCK + i] += w_p * j_p
        scratch[(HEAD + 1) * BLOCK + i] += w_p * j_q
        scratch[(HEAD + 2) * BLOCK + i] += w_p * j_r
        scratch[(HEAD + 3) * BLOCK + i] += w_q * j_q
        scratch[(HEAD + 4) * BLOCK + i] += w_q * j_r
        scratch[(HEAD + 5) * BLOCK + i] += w_r * j_r
        scratch[rows * BLOCK + i] += w_p * j_d
        scratch[(rows + 1) * BLOCK + i] += w_q * j_d
        scratch[(rows + 2) * BLOCK + i] += w_r * j_d
        scratch[(rows + 3) * BLOCK + i] += w_p * j_s
        scratch[(rows + 4) * BLOCK + i] += w_q * j_s
        scratch[(rows + 5) * BLOCK + i] += w_r * j_s
        scratch[(rows + 6) * BLOCK + i] += w_d * j_d
        scratch[(rows + 7) * BLOCK + i] += w_d * j_s
        scratch[(rows + 8) * BLOCK + i] += w_s * j_s


@compiled
@no_type_check
def measure(surface, photos, shared, scratch, constants, robust, precision, row):
    """Leave objective and distance of every pixel of a block in two rows, and its material in scratch."""
    _material(surface, shared, scratch, constants)
    half = type(surface[0])(0.5)
    for i in range(2 * BLOCK):
        scratch[row * BLOCK + i] = 0.0
    for k in range(PARAMETERS):
        certainty = half * precision[k]
        for i in range(BLOCK):
            offset = surface[(OFFSET + k) * BLOCK + i]
            scratch[row * BLOCK + i] += certainty * offset * offset * surface[MOVES * BLOCK + i]
    for start in range(0, len(photos), PHOTO_ROWS * BLOCK):
        photo = photos[start : start + PHOTO_ROWS * BLOCK]
        _shade(photo, scratch, constants)
        for color in range(3):
            _add_cost(color, photo, scratch, constants, robust, row)


@compiled
@no_type_check
def linearise(surface, photos, scratch, constants, robust, precision, active):
    """Leave gradient and undamped curvature of the data in scratch, and the prior's share of the gradient."""
    moves = surface[MOVES * BLOCK : (MOVES + 1) * BLOCK]
    for k in range(PARAMETERS):
        certainty = precision[k]
        for i in range(BLOCK):
            scratch[(GRADIENT + k) * BLOCK + i] = certainty * surface[(OFFSET + k) * BLOCK + i] * moves[i]
    for i in range((COST - HEAD) * BLOCK):
        scratch[HEAD * BLOCK + i] = 0.0
    for start in range(0, len(photos), PHOTO_ROWS * BLOCK):
        photo = photos[start : start + PHOTO_ROWS * BLOCK]
        _shade(photo, scratch, constants)
        for color in range(3):
            _add_color(color, photo, scratch, constants, robust, active, moves)
