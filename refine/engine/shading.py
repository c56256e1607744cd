"""One pixel's shading and its derivatives, for compiled loops that need them one by one."""

from __future__ import annotations

import math
from typing import no_type_check

from refine.engine.simd import compiled


@compiled
@no_type_check
def shading(p, q, roughness, lx, ly, lz, vx, vy, vz, hx, hy, hz, constants):
    """Everything of shading that the colours share; formulas as in `kernel._add_photo`, kinks too.

    Args:
        p, q: slopes.
        roughness: as the map has it.
        lx, ly, lz, vx, vy, vz, hx, hy, hz: directions to light and camera, and the half vector.
        constants: see `layout.constants`.

    Returns:
        n.l and its derivatives by p and q; `lobe = D G / 4` and its derivatives by p, q and roughness.
    """
    real = type(p)
    zero, one, two = real(0.0), real(1.0), real(2.0)
    half, quarter_over_pi = real(0.5), real(0.25 / math.pi)
    roughness_floor, visibility_floor, distribution_floor = constants[6], constants[7], constants[8]
    up = one / math.sqrt(p * p + q * q + one)
    nx, ny = p * up, q * up
    toward_light, toward_view = (p * lx + q * ly + lz) * up, (p * vx + q * vy + vz) * up
    lit, seen = toward_light >= zero, toward_view >= zero
    n_dot_l, n_dot_v = toward_light if lit else zero, toward_view if seen else zero
    light_p = up * (lx - toward_light * nx) if lit else zero
    light_q = up * (ly - toward_light * ny) if lit else zero
    view_p = up * (vx - toward_view * nx) if seen else zero
    view_q = up * (vy - toward_view * ny) if seen else zero
    cross_x, cross_y, cross_z = q * hz - hy, hx - p * hz, p * hy - q * hx
    sin2 = (cross_x * cross_x + cross_y * cross_y + cross_z * cross_z) * (up * up)
    facing = p * hx + q * hy + hz >= zero

    rough = roughness >= roughness_floor
    used = roughness if rough else roughness_floor
    alpha = used * used
    a2, k = alpha * alpha, half * alpha
    raw = a2 + sin2 * (one - a2)
    raw = raw if facing else one
    resolved = raw >= distribution_floor
    denominator = raw if resolved else distribution_floor
    free = resolved and facing
    smith_l, smith_v = n_dot_l * (one - k) + k, n_dot_v * (one - k) + k
    by_smith_l = one / smith_l if smith_l >= visibility_floor else zero
    by_smith_v = one / smith_v if smith_v >= visibility_floor else zero
    smith_l = smith_l if smith_l >= visibility_floor else visibility_floor
    smith_v = smith_v if smith_v >= visibility_floor else visibility_floor
    peak = alpha / denominator
    lobe = peak * peak * quarter_over_pi / (smith_l * smith_v)

    # Of the logarithm of the lobe.
    steepness = (sin2 * (one + a2) - a2) / denominator if free else one
    by_alpha = two * steepness / alpha - half * (by_smith_l * (one - n_dot_l) + by_smith_v * (one - n_dot_v))
    by_roughness = by_alpha * two * used if rough else zero
    by_sin2 = -two * (one - a2) / denominator if free else zero
    by_sin2 = two * by_sin2 * up * up
    by_p = by_sin2 * (cross_z * hy - cross_y * hz - sin2 * p)
    by_q = by_sin2 * (cross_x * hz - cross_z * hx - sin2 * q)
    by_p -= (one - k) * (by_smith_l * light_p + by_smith_v * view_p)
    by_q -= (one - k) * (by_smith_l * light_q + by_smith_v * view_q)
    return n_dot_l, light_p, light_q, lobe, lobe * by_p, lobe * by_q, lobe * by_roughness
