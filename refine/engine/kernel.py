"""The compiled loops of the fused engine: loss, analytic gradient and Adam step of blocks of pixels.

What is packed how, and everything that is not a loop over pixels, is in `fused.py` and `layout.py`. Constants
that other modules define come in as arguments: compiled code is kept on disk and would not notice a change.

A block is `BLOCK` pixels; an array of blocks holds, per block, rows of `BLOCK` numbers (`layout.py` names the
rows). All loops over pixels are flat loops of constant length over rows of at most three arrays, without
branches or calls, so that LLVM turns them into vector instructions: `tests/refine/test_fused.py` looks.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from refine.engine.simd import compiled, exp, kept, log, reordered, root

BLOCK = 64
"""Pixels per block: all that belongs to a block stays in the first level of cache for a whole run."""

# Rows of a block of the surface: parameters at the start, whether the pixel moves (1 or 0), offsets.
START, MOVES, OFFSET, SURFACE_ROWS = 0, 9, 10, 19
# Rows of a block of one photo.
LIGHT, VIEW, HALF, FRESNEL, IRRADIANCE, TARGET, CEILING, PHOTO_ROWS = 0, 3, 6, 9, 10, 13, 16, 17
# Rows of the scratch block: Adam's moments, the gradient by the material, the material, and its derivative
# by its parameters (over three, for the mean over colours).
FIRST, SECOND, GRADIENT, MATERIAL, CURVE, LOSS, SCRATCH_ROWS = 0, 9, 18, 27, 36, 45, 46

LARGEST_RATIO = 1e12
"""Of rendering and photo that is told from larger ones: the product of three must be a float32."""

PARAMETERS = 9
"""Numbers per pixel, in the order of `MAPS`: two slopes, diffuse, roughness, specular."""


@compiled
@no_type_check
def _material(surface, shared, scratch, constants):
    """From parameters to slopes and albedos, and the slopes of the logistic curves (`parametrization.py`)."""
    real = type(surface[0])
    one, limit, third = real(1.0), real(60.0), real(1.0 / 3.0)
    for k in range(2):
        scale, moved = constants[0], shared[k]
        curve = scale * third
        for i in range(BLOCK):
            value = surface[(START + k) * BLOCK + i] + surface[(OFFSET + k) * BLOCK + i] + moved
            scratch[(MATERIAL + k) * BLOCK + i] = scale * value
            scratch[(CURVE + k) * BLOCK + i] = curve
    for k in range(2, PARAMETERS):
        low, span, moved = constants[1], constants[2], shared[k]
        if k == 5:
            low, span = constants[3], constants[4]
        curve = span * third
        for i in range(BLOCK):
            value = surface[(START + k) * BLOCK + i] + surface[(OFFSET + k) * BLOCK + i] + moved
            value = value if value < limit else limit
            value = value if value > -limit else -limit
            tail = exp(-value)
            sigmoid = one / (one + tail)
            scratch[(MATERIAL + k) * BLOCK + i] = low + span * sigmoid
            scratch[(CURVE + k) * BLOCK + i] = curve * (tail * sigmoid) * sigmoid


@compiled
@no_type_check
def _channel(irradiance, target, ceiling, diffuse, specular, n_dot_l, fresnel_weight, lobe, offset):
    """One colour of one pixel: its distance and what the gradient needs of it.

    Returns:
        `max(x, 1/x)` of `x = (R + e) / (I + e)`, whose logarithm is the distance, and the distance's
        derivatives by diffuse, specular, `lobe = D G / 4` and n.l.
    """
    real = type(irradiance)
    zero, one, inverse_pi, large = real(0.0), real(1.0), real(1.0 / math.pi), real(LARGEST_RATIO)
    fresnel = specular + (one - specular) * fresnel_weight
    reflectance = diffuse * (one - specular) * inverse_pi + lobe * fresnel
    radiance = reflectance * n_dot_l * irradiance
    # Where the photo is clipped, so is the rendering; elsewhere the ceiling is out of reach.
    clipped = radiance > ceiling
    explained = (ceiling if clipped else radiance) + offset
    inverse = one / explained
    brighter = explained > target
    ratio = explained / target if brighter else target * inverse
    sign = one if brighter else -one
    sign = zero if clipped or explained == target else sign
    by_reflectance = sign * inverse * irradiance
    lit = by_reflectance * n_dot_l
    return (
        ratio if ratio < large else large,
        lit * (one - specular) * inverse_pi,
        lit * (lobe * (one - fresnel_weight) - diffuse * inverse_pi),
        lit * fresnel,
        by_reflectance * reflectance,
    )


@compiled
@no_type_check
def _add_photo(photo, scratch, constants):
    """Add one photo's distance and its gradient by slopes, albedos and roughness, both times three.

    With m = (p, q, 1) and n = m / |m|: `d(n.l)/dp = (l_x - n.l n_x) / |m|`. GGX is written with
    `sin^2 = |n x h|^2`, as `denominator = a^2 + sin^2 (1 - a^2)`: no cancellation at the peak of a sharp
    lobe, neither in the value nor in its derivative. Kinks have the derivatives that autograd gives them.
    """
    real = type(photo[0])
    zero, one, two = real(0.0), real(1.0), real(2.0)
    half, quarter_over_pi = real(0.5), real(0.25 / math.pi)
    offset, roughness_floor = constants[5], constants[6]
    visibility_floor, distribution_floor = constants[7], constants[8]
    for i in range(BLOCK):
        p, q = scratch[(MATERIAL + 0) * BLOCK + i], scratch[(MATERIAL + 1) * BLOCK + i]
        red, green = scratch[(MATERIAL + 2) * BLOCK + i], scratch[(MATERIAL + 3) * BLOCK + i]
        blue, roughness = scratch[(MATERIAL + 4) * BLOCK + i], scratch[(MATERIAL + 5) * BLOCK + i]
        specular_r = scratch[(MATERIAL + 6) * BLOCK + i]
        specular_g = scratch[(MATERIAL + 7) * BLOCK + i]
        specular_b = scratch[(MATERIAL + 8) * BLOCK + i]
        lx, ly = photo[(LIGHT + 0) * BLOCK + i], photo[(LIGHT + 1) * BLOCK + i]
        vx, vy = photo[(VIEW + 0) * BLOCK + i], photo[(VIEW + 1) * BLOCK + i]
        hx, hy, hz = photo[HALF * BLOCK + i], photo[(HALF + 1) * BLOCK + i], photo[(HALF + 2) * BLOCK + i]
        weight, ceiling = photo[FRESNEL * BLOCK + i], photo[CEILING * BLOCK + i]

        up = one / math.sqrt(p * p + q * q + one)
        nx, ny = p * up, q * up
        toward_light = (p * lx + q * ly + photo[(LIGHT + 2) * BLOCK + i]) * up
        toward_view = (p * vx + q * vy + photo[(VIEW + 2) * BLOCK + i]) * up
        n_dot_l = toward_light if toward_light >= zero else zero
        n_dot_v = toward_view if toward_view >= zero else zero
        cross_x, cross_y, cross_z = q * hz - hy, hx - p * hz, p * hy - q * hx
        sin2 = (cross_x * cross_x + cross_y * cross_y + cross_z * cross_z) * (up * up)
        facing = p * hx + q * hy + hz >= zero

        used = roughness if roughness >= roughness_floor else roughness_floor
        alpha = used * used
        a2, k = alpha * alpha, half * alpha
        raw = a2 + sin2 * (one - a2)
        raw = raw if facing else one
        resolved = raw >= distribution_floor
        denominator = raw if resolved else distribution_floor
        smith_l, smith_v = n_dot_l * (one - k) + k, n_dot_v * (one - k) + k
        free_l, free_v = smith_l >= visibility_floor, smith_v >= visibility_floor
        smith_l = smith_l if free_l else visibility_floor
        smith_v = smith_v if free_v else visibility_floor
        peak = alpha / denominator
        lobe = peak * peak * quarter_over_pi / (smith_l * smith_v)

        ratio_r, by_red, by_specular_r, lobe_r, light_r = _channel(
            photo[(IRRADIANCE + 0) * BLOCK + i], photo[(TARGET + 0) * BLOCK + i], ceiling,
            red, specular_r, n_dot_l, weight, lobe, offset,
        )  # fmt: skip
        ratio_g, by_green, by_specular_g, lobe_g, light_g = _channel(
            photo[(IRRADIANCE + 1) * BLOCK + i], photo[(TARGET + 1) * BLOCK + i], ceiling,
            green, specular_g, n_dot_l, weight, lobe, offset,
        )  # fmt: skip
        ratio_b, by_blue, by_specular_b, lobe_b, light_b = _channel(
            photo[(IRRADIANCE + 2) * BLOCK + i], photo[(TARGET + 2) * BLOCK + i], ceiling,
            blue, specular_b, n_dot_l, weight, lobe, offset,
        )  # fmt: skip

        # By the logarithm of the lobe, and from there by all that the lobe is made of.
        by_lobe = (lobe_r + lobe_g + lobe_b) * lobe
        free = resolved and facing
        by_smith_l = -by_lobe / smith_l if free_l else zero
        by_smith_v = -by_lobe / smith_v if free_v else zero
        by_light = light_r + light_g + light_b + by_smith_l * (one - k)
        by_light = by_light if toward_light >= zero else zero
        by_view = by_smith_v * (one - k) if toward_view >= zero else zero
        steepness = (sin2 * (one + a2) - a2) / denominator
        steepness = steepness if free else one
        by_alpha = two * by_lobe * steepness / alpha
        by_alpha += half * (by_smith_l * (one - n_dot_l) + by_smith_v * (one - n_dot_v))
        by_roughness = by_alpha * two * used if roughness >= roughness_floor else zero
        by_sin2 = -two * by_lobe * (one - a2) / denominator if free else zero
        by_sin2 = two * by_sin2 * up * up
        by_p = up * (by_light * (lx - toward_light * nx) + by_view * (vx - toward_view * nx))
        by_q = up * (by_light * (ly - toward_light * ny) + by_view * (vy - toward_view * ny))
        by_p += by_sin2 * (cross_z * hy - cross_y * hz - sin2 * p)
        by_q += by_sin2 * (cross_x * hz - cross_z * hx - sin2 * q)

        scratch[(GRADIENT + 0) * BLOCK + i] += by_p
        scratch[(GRADIENT + 1) * BLOCK + i] += by_q
        scratch[(GRADIENT + 2) * BLOCK + i] += by_red
        scratch[(GRADIENT + 3) * BLOCK + i] += by_green
        scratch[(GRADIENT + 4) * BLOCK + i] += by_blue
        scratch[(GRADIENT + 5) * BLOCK + i] += by_roughness
        scratch[(GRADIENT + 6) * BLOCK + i] += by_specular_r
        scratch[(GRADIENT + 7) * BLOCK + i] += by_specular_g
        scratch[(GRADIENT + 8) * BLOCK + i] += by_specular_b
        scratch[LOSS * BLOCK + i] += log(ratio_r * ratio_g * ratio_b)


@compiled
@no_type_check
def _evaluate(surface, photos, shared, scratch, constants):
    """Leave the distance and its gradient by the material of one block in `scratch`, both times three."""
    _material(surface, shared, scratch, constants)
    for i in range(PARAMETERS * BLOCK):
        scratch[GRADIENT * BLOCK + i] = 0.0
    for i in range(BLOCK):
        scratch[LOSS * BLOCK + i] = 0.0
    for start in range(0, len(photos), PHOTO_ROWS * BLOCK):
        _add_photo(photos[start : start + PHOTO_ROWS * BLOCK], scratch, constants)


@reordered
@no_type_check
def _row_sum(scratch, row, count):
    total = 0.0
    for i in range(count):
        total += np.float64(scratch[row * BLOCK + i])
    return total


@compiled
@no_type_check
def _adam(surface, scratch, steps, betas):
    """One step of Adam on one block; `steps` holds bias-corrected rates, 1 / sqrt(bias 2) and epsilon."""
    refresh1, beta2, refresh2 = betas[0], betas[1], betas[2]
    correction, epsilon = steps[PARAMETERS], steps[PARAMETERS + 1]
    for k in range(PARAMETERS):
        rate = steps[k]
        for i in range(BLOCK):
            gradient = scratch[(GRADIENT + k) * BLOCK + i] * scratch[(CURVE + k) * BLOCK + i]
            gradient = gradient * surface[MOVES * BLOCK + i]
            first = scratch[(FIRST + k) * BLOCK + i]
            first = first + (gradient - first) * refresh1
            second = scratch[(SECOND + k) * BLOCK + i] * beta2 + gradient * gradient * refresh2
            scratch[(FIRST + k) * BLOCK + i] = first
            scratch[(SECOND + k) * BLOCK + i] = second
            surface[(OFFSET + k) * BLOCK + i] -= rate * first / (root(second) * correction + epsilon)


@kept
@no_type_check
def descend_blocks(surface, photos, shared, constants, betas, steps, scratch, counts, losses):
    """Run every step of Adam on each block before the next: pixels that move alone need not wait for others.

    Args:
        surface: `[blocks, SURFACE_ROWS * BLOCK]`; its offsets are moved.
        photos: `[blocks, photos * PHOTO_ROWS * BLOCK]`.
        shared: `[PARAMETERS]` offsets of all pixels.
        constants: of the material and the renderer, see `layout.constants`.
        betas: `[3]` of Adam: 1 - beta1, beta2, 1 - beta2.
        steps: `[iterations, PARAMETERS + 2]`, see `_adam`.
        scratch: `[SCRATCH_ROWS * BLOCK]`, of one thread.
        counts: `[blocks]` pixels of each block; the rest is padding.
        losses: `[blocks, iterations + 1]` float64, out: sum of the pixels' distances, times three.
    """
    for b in range(len(surface)):
        for i in range(len(scratch)):
            scratch[i] = 0.0
        for step in range(len(steps)):
            _evaluate(surface[b], photos[b], shared, scratch, constants)
            losses[b, step] = _row_sum(scratch, LOSS, counts[b])
            _adam(surface[b], scratch, steps[step], betas)
        _evaluate(surface[b], photos[b], shared, scratch, constants)
        losses[b, len(steps)] = _row_sum(scratch, LOSS, counts[b])


@kept
@no_type_check
def sum_blocks(surface, photos, shared, constants, scratch, counts, sums):
    """Sum distances and gradients over pixels, for offsets that all pixels share.

    Args:
        surface, photos, shared, constants, scratch, counts: as in `descend_blocks`; nothing is moved.
        sums: `[blocks, PARAMETERS + 1]` float64, out: of the gradients of the pixels' own distances, and of
            the distances times three.
    """
    for b in range(len(surface)):
        _evaluate(surface[b], photos[b], shared, scratch, constants)
        for i in range(PARAMETERS * BLOCK):
            scratch[GRADIENT * BLOCK + i] *= scratch[CURVE * BLOCK + i]
        for k in range(PARAMETERS):
            sums[b, k] = _row_sum(scratch, GRADIENT + k, counts[b])
        sums[b, PARAMETERS] = _row_sum(scratch, LOSS, counts[b])
