"""The compiled loops of fused Gauss-Newton: solving the normal equations, steps, and what remains unknown.

Eliminating each colour's 2 x 2 block first leaves 3 x 3 for the slopes and the roughness, for any number of
photos: see `normal_equations.py`, whose rows these are.
"""

from __future__ import annotations

import math
from typing import no_type_check

from refine.engine.kernel import BLOCK, GRADIENT, MOVES, OFFSET, PARAMETERS, _material, _row_sum
from refine.engine.normal_equations import (
    BEFORE,
    COLOR_ROWS,
    COLORS,
    COST,
    DAMPING,
    HEAD,
    NEW_COST,
    linearise,
    measure,
)
from refine.engine.simd import compiled, kept


@compiled
@no_type_check
def _eliminate(scratch, filled, damped):
    """Add the (damped) prior to the curvature and fold the colours' blocks into its head and gradient.

    A block (dd ds ss) is left as (1/dd, ds/dd, 1/(ss - ds^2/dd)).
    """
    one = type(scratch[0])(1.0)
    for i in range(BLOCK):
        factor = one + scratch[DAMPING * BLOCK + i] * damped
        scratch[HEAD * BLOCK + i] += filled[0] * factor
        scratch[(HEAD + 3) * BLOCK + i] += filled[1] * factor
        scratch[(HEAD + 5) * BLOCK + i] += filled[5] * factor
    for color in range(3):
        rows, prior_d, prior_s = COLORS + color * COLOR_ROWS, filled[2 + color], filled[6 + color]
        for i in range(BLOCK):
            factor = one + scratch[DAMPING * BLOCK + i] * damped
            inverse_d = one / (scratch[(rows + 6) * BLOCK + i] + prior_d * factor)
            ds = scratch[(rows + 7) * BLOCK + i]
            share = ds * inverse_d
            inverse_s = one / (scratch[(rows + 8) * BLOCK + i] + prior_s * factor - ds * share)
            scratch[(rows + 6) * BLOCK + i] = inverse_d
            scratch[(rows + 7) * BLOCK + i] = share
            scratch[(rows + 8) * BLOCK + i] = inverse_s
            b_pd, b_qd, b_rd = (
                scratch[rows * BLOCK + i],
                scratch[(rows + 1) * BLOCK + i],
                scratch[(rows + 2) * BLOCK + i],
            )
            # The specular's couplings without what goes through the diffuse.
            b_ps = scratch[(rows + 3) * BLOCK + i] - share * b_pd
            b_qs = scratch[(rows + 4) * BLOCK + i] - share * b_qd
            b_rs = scratch[(rows + 5) * BLOCK + i] - share * b_rd
            scratch[(rows + 3) * BLOCK + i] = b_ps
            scratch[(rows + 4) * BLOCK + i] = b_qs
            scratch[(rows + 5) * BLOCK + i] = b_rs
            g_d = scratch[(GRADIENT + 2 + color) * BLOCK + i]
            g_s = scratch[(GRADIENT + 6 + color) * BLOCK + i] - share * g_d
            scratch[(GRADIENT + 6 + color) * BLOCK + i] = g_s
            w_d, w_s = g_d * inverse_d, g_s * inverse_s
            scratch[GRADIENT * BLOCK + i] -= b_pd * w_d + b_ps * w_s
            scratch[(GRADIENT + 1) * BLOCK + i] -= b_qd * w_d + b_qs * w_s
            scratch[(GRADIENT + 5) * BLOCK + i] -= b_rd * w_d + b_rs * w_s
            scratch[HEAD * BLOCK + i] -= b_pd * b_pd * inverse_d + b_ps * b_ps * inverse_s
            scratch[(HEAD + 1) * BLOCK + i] -= b_pd * b_qd * inverse_d + b_ps * b_qs * inverse_s
            scratch[(HEAD + 2) * BLOCK + i] -= b_pd * b_rd * inverse_d + b_ps * b_rs * inverse_s
            scratch[(HEAD + 3) * BLOCK + i] -= b_qd * b_qd * inverse_d + b_qs * b_qs * inverse_s
            scratch[(HEAD + 4) * BLOCK + i] -= b_qd * b_rd * inverse_d + b_qs * b_rs * inverse_s
            scratch[(HEAD + 5) * BLOCK + i] -= b_rd * b_rd * inverse_d + b_rs * b_rs * inverse_s
    _invert_head(scratch)


@compiled
@no_type_check
def _invert_head(scratch):
    """Replace the head by its inverse, by elimination of p, then q."""
    one = type(scratch[0])(1.0)
    for i in range(BLOCK):
        pp, pq, pr = (
            scratch[HEAD * BLOCK + i],
            scratch[(HEAD + 1) * BLOCK + i],
            scratch[(HEAD + 2) * BLOCK + i],
        )
        inverse_p = one / pp
        a, b = pq * inverse_p, pr * inverse_p
        inverse_q = one / (scratch[(HEAD + 3) * BLOCK + i] - pq * a)
        qr = scratch[(HEAD + 4) * BLOCK + i] - pq * b
        c = qr * inverse_q
        inverse_r = one / (scratch[(HEAD + 5) * BLOCK + i] - pr * b - qr * c)
        # L^-1 = [[1, 0, 0], [-a, 1, 0], [a c - b, -c, 1]]; the inverse is L^-T D^-1 L^-1.
        d = a * c - b
        scratch[HEAD * BLOCK + i] = inverse_p + a * a * inverse_q + d * d * inverse_r
        scratch[(HEAD + 1) * BLOCK + i] = -a * inverse_q - c * d * inverse_r
        scratch[(HEAD + 2) * BLOCK + i] = d * inverse_r
        scratch[(HEAD + 3) * BLOCK + i] = inverse_q + c * c * inverse_r
        scratch[(HEAD + 4) * BLOCK + i] = -c * inverse_r
        scratch[(HEAD + 5) * BLOCK + i] = inverse_r


@compiled
@no_type_check
def _step(surface, scratch, active):
    """Move a block's offsets to the minimum of the quadratic model; `BEFORE` keeps where they were."""
    for i in range(PARAMETERS * BLOCK):
        scratch[BEFORE * BLOCK + i] = surface[OFFSET * BLOCK + i]
    for i in range(BLOCK):
        g_p, g_q = scratch[GRADIENT * BLOCK + i], scratch[(GRADIENT + 1) * BLOCK + i]
        g_r = scratch[(GRADIENT + 5) * BLOCK + i]
        pq, pr, qr = (
            scratch[(HEAD + 1) * BLOCK + i],
            scratch[(HEAD + 2) * BLOCK + i],
            scratch[(HEAD + 4) * BLOCK + i],
        )
        s_p = -(scratch[HEAD * BLOCK + i] * g_p + pq * g_q + pr * g_r)
        s_q = -(pq * g_p + scratch[(HEAD + 3) * BLOCK + i] * g_q + qr * g_r)
        s_r = -(pr * g_p + qr * g_q + scratch[(HEAD + 5) * BLOCK + i] * g_r)
        scratch[GRADIENT * BLOCK + i] = s_p
        scratch[(GRADIENT + 1) * BLOCK + i] = s_q
        scratch[(GRADIENT + 5) * BLOCK + i] = s_r
    for color in range(3):
        rows = COLORS + color * COLOR_ROWS
        for i in range(BLOCK):
            s_p, s_q = scratch[GRADIENT * BLOCK + i], scratch[(GRADIENT + 1) * BLOCK + i]
            s_r = scratch[(GRADIENT + 5) * BLOCK + i]
            through_s = scratch[(GRADIENT + 6 + color) * BLOCK + i] + scratch[(rows + 3) * BLOCK + i] * s_p
            through_s += scratch[(rows + 4) * BLOCK + i] * s_q + scratch[(rows + 5) * BLOCK + i] * s_r
            s_s = -through_s * scratch[(rows + 8) * BLOCK + i]
            through_d = scratch[(GRADIENT + 2 + color) * BLOCK + i] + scratch[rows * BLOCK + i] * s_p
            through_d += scratch[(rows + 1) * BLOCK + i] * s_q + scratch[(rows + 2) * BLOCK + i] * s_r
            s_d = -through_d * scratch[(rows + 6) * BLOCK + i] - scratch[(rows + 7) * BLOCK + i] * s_s
            scratch[(GRADIENT + 2 + color) * BLOCK + i] = s_d
            scratch[(GRADIENT + 6 + color) * BLOCK + i] = s_s
    for k in range(PARAMETERS):
        on = active[k]
        for i in range(BLOCK):
            moved = on * surface[MOVES * BLOCK + i] * scratch[(GRADIENT + k) * BLOCK + i]
            surface[(OFFSET + k) * BLOCK + i] += moved


@compiled
@no_type_check
def _keep_what_is_better(surface, scratch, pace):
    """Take back the steps of pixels whose objective they did not lower, and adapt the damping."""
    accepted, rejected, least, most = pace[0], pace[1], pace[2], pace[3]
    for k in range(PARAMETERS):
        for i in range(BLOCK):
            better = scratch[NEW_COST * BLOCK + i] < scratch[COST * BLOCK + i]
            now = surface[(OFFSET + k) * BLOCK + i]
            surface[(OFFSET + k) * BLOCK + i] = now if better else scratch[(BEFORE + k) * BLOCK + i]
    for i in range(BLOCK):
        new, old = scratch[NEW_COST * BLOCK + i], scratch[COST * BLOCK + i]
        better = new < old
        scratch[COST * BLOCK + i] = new if better else old
        distance = scratch[(COST + 1) * BLOCK + i]
        scratch[(COST + 1) * BLOCK + i] = scratch[(NEW_COST + 1) * BLOCK + i] if better else distance
        damping = scratch[DAMPING * BLOCK + i] * (accepted if better else rejected)
        damping = damping if damping > least else least
        scratch[DAMPING * BLOCK + i] = damping if damping < most else most


@compiled
@no_type_check
def _deviations(scratch, surface, active, deviations):
    """Write the square roots of the inverse curvature's diagonal, after `_eliminate`."""
    for i in range(BLOCK):
        moves = surface[MOVES * BLOCK + i]
        deviations[i] = math.sqrt(scratch[HEAD * BLOCK + i]) * active[0] * moves
        deviations[BLOCK + i] = math.sqrt(scratch[(HEAD + 3) * BLOCK + i]) * active[1] * moves
        deviations[5 * BLOCK + i] = math.sqrt(scratch[(HEAD + 5) * BLOCK + i]) * active[5] * moves
    for color in range(3):
        rows = COLORS + color * COLOR_ROWS
        on_d, on_s = active[2 + color], active[6 + color]
        for i in range(BLOCK):
            moves = surface[MOVES * BLOCK + i]
            inverse_d, share = scratch[(rows + 6) * BLOCK + i], scratch[(rows + 7) * BLOCK + i]
            inverse_s = scratch[(rows + 8) * BLOCK + i]
            # What the head's uncertainty adds, through (p, q, r) -> specular, and -> diffuse.
            s_p = inverse_s * scratch[(rows + 3) * BLOCK + i]
            s_q = inverse_s * scratch[(rows + 4) * BLOCK + i]
            s_r = inverse_s * scratch[(rows + 5) * BLOCK + i]
            d_p = inverse_d * scratch[rows * BLOCK + i] - share * s_p
            d_q = inverse_d * scratch[(rows + 1) * BLOCK + i] - share * s_q
            d_r = inverse_d * scratch[(rows + 2) * BLOCK + i] - share * s_r
            variance_s = inverse_s + _quadratic(scratch, i, s_p, s_q, s_r)
            variance_d = inverse_d + share * share * inverse_s + _quadratic(scratch, i, d_p, d_q, d_r)
            deviations[(2 + color) * BLOCK + i] = math.sqrt(variance_d) * on_d * moves
            deviations[(6 + color) * BLOCK + i] = math.sqrt(variance_s) * on_s * moves


@compiled
@no_type_check
def _quadratic(scratch, i, x, y, z):
    """The inverse head's quadratic form."""
    two = type(x)(2.0)
    pp, pq, pr = scratch[HEAD * BLOCK + i], scratch[(HEAD + 1) * BLOCK + i], scratch[(HEAD + 2) * BLOCK + i]
    qq, qr, rr = (
        scratch[(HEAD + 3) * BLOCK + i],
        scratch[(HEAD + 4) * BLOCK + i],
        scratch[(HEAD + 5) * BLOCK + i],
    )
    return x * (pp * x + two * (pq * y + pr * z)) + y * (qq * y + two * qr * z) + rr * z * z


@kept
@no_type_check
def solve_blocks(surface, photos, constants, prior, robust, pace, scratch, counts, costs, deviations):
    """Run all steps on each block before the next, then find how well its parameters are known.

    Args:
        surface: `[blocks, SURFACE_ROWS * BLOCK]`, whose START is the prior's centre; its offsets are moved.
        photos: `[blocks, photos * PHOTO_ROWS * BLOCK]`.
        constants: of the material and the renderer, see `layout.constants`.
        prior: `[4, PARAMETERS]`: precisions (0 for what does not move), the same with 1 for 0, 1 or 0, zeros.
        robust: `[2]`: noise, and where Huber's cost turns linear.
        pace: `[5]` of the damping: factors when accepted and rejected, least, most, and the first.
        scratch: `[NEWTON_ROWS * BLOCK]`, of one thread.
        counts: `[blocks]` pixels of each block; the rest is padding.
        costs: `[blocks, 2 (iterations + 1)]` float64, out: sums of the pixels' objectives, and of their
            distances in units of noise.
        deviations: `[blocks, PARAMETERS * BLOCK]`, out.
    """
    precision, filled, active = prior[0], prior[1], prior[2]
    one, zero = type(pace[0])(1.0), type(pace[0])(0.0)
    for b in range(len(surface)):
        for i in range(len(scratch)):
            scratch[i] = 0.0
        for i in range(BLOCK):
            scratch[DAMPING * BLOCK + i] = pace[4]

        measure(surface[b], photos[b], prior[3], scratch, constants, robust, precision, COST)
        length = costs.shape[1] // 2
        costs[b, 0] = _row_sum(scratch, COST, counts[b])
        costs[b, length] = _row_sum(scratch, COST + 1, counts[b])
        for step in range(1, length):
            linearise(surface[b], photos[b], scratch, constants, robust, precision, active)
            _eliminate(scratch, filled, one)
            _step(surface[b], scratch, active)
            measure(surface[b], photos[b], prior[3], scratch, constants, robust, precision, NEW_COST)
            _keep_what_is_better(surface[b], scratch, pace)
            _material(surface[b], prior[3], scratch, constants)
            costs[b, step] = _row_sum(scratch, COST, counts[b])
            costs[b, length + step] = _row_sum(scratch, COST + 1, counts[b])
        linearise(surface[b], photos[b], scratch, constants, robust, precision, active)
        _eliminate(scratch, filled, zero)
        _deviations(scratch, surface[b], active, deviations[b])
