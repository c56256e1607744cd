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

from refine.engine.simd import compiled, estimated, exp, kept, log, reordered

BLOCK = 64
"""Pixels per block: all that belongs to a block stays in the first level of cache for a whole run."""

# Rows of a block of the surface: parameters at the start, whether the pixel moves (1 or 0), offsets.
START, MOVES, OFFSET, SURFACE_ROWS = 0, 9, 10, 19
# Rows of a block of one photo.
LIGHT, VIEW, HALF, FRESNEL, IRRADIANCE, TARGET, CEILING, PHOTO_ROWS = 0, 3, 6, 9, 10, 13, 16, 17
# Rows of the scratch block: Adam's moments, the gradient by the material, the material, and its derivative
# by its parameters (over three, for the mean over colours); and what one loop of shading leaves to the next.
FIRST, SECOND, GRADIENT, MATERIAL, CURVE, LOSS = 0, 9, 18, 27, 36, 45
UP, TOWARD_LIGHT, TOWARD_VIEW, SIN2, PEAKEDNESS, VISIBILITY, LOBE = 46, 47, 48, 49, 50, 51, 52
BY_LOBE, BY_LIGHT, SCRATCH_ROWS = 53, 54, 55

LARGEST_RATIO = 1e12
"""Of rendering and photo that is told from larger ones: the product of three must be a float32."""

PARAMETERS = 9
"""Numbers per pixel, in the order of `MAPS`: two slopes, diffuse, roughness, specular."""


@compiled
@no_type_check
def _material(surface, shared, scratch, constants):
    """From parameters to slopes and albedos, and the slopes of the logistic curves (`parametrization.py`)."""
    real = type(surface[0])
    one, third = real(1.0), real(1.0 / 3.0)
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
            tail = exp(-value)
            sigmoid = one / (one + tail)
            scratch[(MATERIAL + k) * BLOCK + i] = low + span * sigmoid
            scratch[(CURVE + k) * BLOCK + i] = curve * (tail * sigmoid) * sigmoid


@compiled
@no_type_check
def _shade(photo, scratch, constants):
    """Everything of shading that the colours share.

    GGX is written with `sin^2 = |n x h|^2`, as `denominator = a^2 + sin^2 (1 - a^2)`: no cancellation at the
    peak of a sharp lobe, neither in the value nor in its derivative. Half vectors below the surface count as
    at right angles to the normal.
    """
    real = type(photo[0])
    zero, one, half, quarter = real(0.0), real(1.0), real(0.5), real(0.25)
    roughness_floor, visibility_floor, distribution_floor = constants[6], constants[7], constants[8]
    for i in range(BLOCK):
        p, q = scratch[MATERIAL * BLOCK + i], scratch[(MATERIAL + 1) * BLOCK + i]
        hx, hy, hz = photo[HALF * BLOCK + i], photo[(HALF + 1) * BLOCK + i], photo[(HALF + 2) * BLOCK + i]
        up = one / math.sqrt(p * p + (q * q + one))
        to_light = q * photo[(LIGHT + 1) * BLOCK + i] + photo[(LIGHT + 2) * BLOCK + i]
        to_light = (p * photo[LIGHT * BLOCK + i] + to_light) * up
        to_view = q * photo[(VIEW + 1) * BLOCK + i] + photo[(VIEW + 2) * BLOCK + i]
        to_view = (p * photo[VIEW * BLOCK + i] + to_view) * up
        cross_x, cross_y, cross_z = q * hz - hy, hx - p * hz, p * hy - q * hx
        sin2 = (cross_x * cross_x + cross_y * cross_y + cross_z * cross_z) * (up * up)
        sin2 = sin2 if p * hx + (q * hy + hz) >= zero else one

        roughness = scratch[(MATERIAL + 5) * BLOCK + i]
        used = roughness if roughness >= roughness_floor else roughness_floor
        alpha = used * used
        a2, k = alpha * alpha, half * alpha
        denominator = a2 + sin2 * (one - a2)
        denominator = denominator if denominator >= distribution_floor else distribution_floor
        smith_l = (to_light if to_light >= zero else zero) * (one - k) + k
        smith_v = (to_view if to_view >= zero else zero) * (one - k) + k
        smith_l = smith_l if smith_l >= visibility_floor else visibility_floor
        smith_v = smith_v if smith_v >= visibility_floor else visibility_floor
        inverse = one / denominator
        visibility = one / (smith_l * smith_v)
        scratch[UP * BLOCK + i] = up
        scratch[TOWARD_LIGHT * BLOCK + i] = to_light
        scratch[TOWARD_VIEW * BLOCK + i] = to_view
        scratch[SIN2 * BLOCK + i] = sin2
        scratch[PEAKEDNESS * BLOCK + i] = inverse
        scratch[VISIBILITY * BLOCK + i] = visibility
        scratch[LOBE * BLOCK + i] = (alpha * inverse) * (alpha * inverse) * (quarter * visibility)


@compiled
@no_type_check
def _channel(irradiance, target, ceiling, diffuse, specular, lit, fresnel_weight, lobe, dry, offset):
    """One colour of one pixel: its distance and what the gradient needs of it.

    Args:
        lit: n.l / pi.
        lobe: pi D G / 4, so that reflectance is pi times what it is elsewhere.
        dry: lobe (1 - fresnel_weight).

    Returns:
        `max(x, 1/x)` of `x = (R + e) / (I + e)`, whose logarithm is the distance, and the distance's
        derivatives by diffuse, specular, `lobe` and `lit`.
    """
    real = type(irradiance)
    zero, one, large = real(0.0), real(1.0), real(LARGEST_RATIO)
    through = one - specular
    fresnel = specular + through * fresnel_weight
    reflectance = diffuse * through + lobe * fresnel
    received = lit * irradiance
    radiance = reflectance * received
    # Where the photo is clipped, so is the rendering; elsewhere the ceiling is out of reach.
    clipped = radiance > ceiling
    explained = (ceiling if clipped else radiance) + offset
    inverse = one / explained
    too_bright, too_dark = explained / target, target * inverse
    ratio = too_bright if too_bright > too_dark else too_dark
    by_radiance = inverse if explained > target else -inverse
    by_radiance = zero if clipped or explained == target else by_radiance
    by_reflectance = by_radiance * received
    return (
        ratio if ratio < large else large,
        by_reflectance * through,
        by_reflectance * (dry - diffuse),
        by_reflectance * fresnel,
        by_radiance * irradiance * reflectance,
    )


@compiled
@no_type_check
def _compare(photo, scratch, constants):
    """Add the distance and its gradient by albedos, and leave that by the lobe's logarithm and by n.l."""
    real = type(photo[0])
    zero, inverse_pi, offset = real(0.0), real(1.0 / math.pi), constants[5]
    for i in range(BLOCK):
        weight, ceiling = photo[FRESNEL * BLOCK + i], photo[CEILING * BLOCK + i]
        to_light = scratch[TOWARD_LIGHT * BLOCK + i]
        lit = (to_light if to_light >= zero else zero) * inverse_pi
        lobe = scratch[LOBE * BLOCK + i]
        dry = lobe - lobe * weight
        ratio_r, by_red, by_specular_r, by_lobe_r, by_lit_r = _channel(
            photo[IRRADIANCE * BLOCK + i], photo[TARGET * BLOCK + i], ceiling,
            scratch[(MATERIAL + 2) * BLOCK + i], scratch[(MATERIAL + 6) * BLOCK + i],
            lit, weight, lobe, dry, offset,
        )  # fmt: skip
        ratio_g, by_green, by_specular_g, by_lobe_g, by_lit_g = _channel(
            photo[(IRRADIANCE + 1) * BLOCK + i], photo[(TARGET + 1) * BLOCK + i], ceiling,
            scratch[(MATERIAL + 3) * BLOCK + i], scratch[(MATERIAL + 7) * BLOCK + i],
            lit, weight, lobe, dry, offset,
        )  # fmt: skip
        ratio_b, by_blue, by_specular_b, by_lobe_b, by_lit_b = _channel(
            photo[(IRRADIANCE + 2) * BLOCK + i], photo[(TARGET + 2) * BLOCK + i], ceiling,
            scratch[(MATERIAL + 4) * BLOCK + i], scratch[(MATERIAL + 8) * BLOCK + i],
            lit, weight, lobe, dry, offset,
        )  # fmt: skip
        scratch[BY_LOBE * BLOCK + i] = (by_lobe_r + by_lobe_g + by_lobe_b) * lobe
        scratch[BY_LIGHT * BLOCK + i] = (by_lit_r + by_lit_g + by_lit_b) * inverse_pi
        scratch[(GRADIENT + 2) * BLOCK + i] += by_red
        scratch[(GRADIENT + 3) * BLOCK + i] += by_green
        scratch[(GRADIENT + 4) * BLOCK + i] += by_blue
        scratch[(GRADIENT + 6) * BLOCK + i] += by_specular_r
        scratch[(GRADIENT + 7) * BLOCK + i] += by_specular_g
        scratch[(GRADIENT + 8) * BLOCK + i] += by_specular_b
        scratch[LOSS * BLOCK + i] += log(ratio_r * ratio_g * ratio_b)


@compiled
@no_type_check
def _add_slopes_and_roughness(photo, scratch, constants):
    """Add the gradient by roughness and slopes, from that by the lobe's logarithm and by n.l.

    With m = (p, q, 1) and n = m / |m|: `d(n.l)/dp = (l_x - n.l n_x) / |m|`. Kinks have the derivatives that
    autograd gives them.
    """
    real = type(photo[0])
    zero, one, half, four = real(0.0), real(1.0), real(0.5), real(4.0)
    roughness_floor, visibility_floor, distribution_floor = constants[6], constants[7], constants[8]
    for i in range(BLOCK):
        to_light, to_view = scratch[TOWARD_LIGHT * BLOCK + i], scratch[TOWARD_VIEW * BLOCK + i]
        up, sin2 = scratch[UP * BLOCK + i], scratch[SIN2 * BLOCK + i]
        inverse, visibility = scratch[PEAKEDNESS * BLOCK + i], scratch[VISIBILITY * BLOCK + i]
        by_lobe, by_light = scratch[BY_LOBE * BLOCK + i], scratch[BY_LIGHT * BLOCK + i]
        roughness = scratch[(MATERIAL + 5) * BLOCK + i]
        used = roughness if roughness >= roughness_floor else roughness_floor
        alpha = used * used
        a2, k = alpha * alpha, half * alpha
        n_dot_l = to_light if to_light >= zero else zero
        n_dot_v = to_view if to_view >= zero else zero
        smith_l, smith_v = n_dot_l * (one - k) + k, n_dot_v * (one - k) + k
        free_l, free_v = smith_l >= visibility_floor, smith_v >= visibility_floor
        by_smith = by_lobe * visibility
        by_smith_l = by_smith * (smith_v if free_v else visibility_floor) if free_l else zero
        by_smith_v = by_smith * (smith_l if free_l else visibility_floor) if free_v else zero
        by_light = by_light - by_smith_l * (one - k) if to_light >= zero else zero
        by_view = by_smith_v * (one - k) if to_view >= zero else zero
        resolved = a2 + sin2 * (one - a2) >= distribution_floor
        steepness = (sin2 * (one + a2) - a2) * inverse if resolved else one
        # By alpha, times 2 roughness = dalpha / droughness.
        by_roughness = four * by_lobe * steepness / used
        by_roughness -= used * (by_smith_l * (one - n_dot_l) + by_smith_v * (one - n_dot_v))
        scratch[(GRADIENT + 5) * BLOCK + i] += by_roughness if roughness >= roughness_floor else zero
        by_sin2 = four * by_lobe * up * ((one - a2) * inverse)
        by_sin2 = by_sin2 if resolved and sin2 < one else zero

        p, q = scratch[MATERIAL * BLOCK + i], scratch[(MATERIAL + 1) * BLOCK + i]
        hx, hy, hz = photo[HALF * BLOCK + i], photo[(HALF + 1) * BLOCK + i], photo[(HALF + 2) * BLOCK + i]
        cross_x, cross_y, cross_z = q * hz - hy, hx - p * hz, p * hy - q * hx
        by_p = by_light * (photo[LIGHT * BLOCK + i] - to_light * (p * up))
        by_q = by_light * (photo[(LIGHT + 1) * BLOCK + i] - to_light * (q * up))
        by_p -= by_view * (photo[VIEW * BLOCK + i] - to_view * (p * up))
        by_q -= by_view * (photo[(VIEW + 1) * BLOCK + i] - to_view * (q * up))
        by_p -= by_sin2 * (cross_z * hy - cross_y * hz - sin2 * p)
        by_q -= by_sin2 * (cross_x * hz - cross_z * hx - sin2 * q)
        scratch[GRADIENT * BLOCK + i] += up * by_p
        scratch[(GRADIENT + 1) * BLOCK + i] += up * by_q


@compiled
@no_type_check
def _add_photo(photo, scratch, constants):
    """Add one photo's distance and its gradient by slopes, albedos and roughness, both times three.

    In three loops, since a processor looks ahead by so many instructions only: while it waits for one
    pixel's results it finds less to do in a long body.
    """
    _shade(photo, scratch, constants)
    _compare(photo, scratch, constants)
    _add_slopes_and_roughness(photo, scratch, constants)


@compiled
@no_type_check
def _evaluate(surface, photos, shared, scratch, constants):
    """Leave the distance of one block in `scratch` and add its gradient by the material, both times three."""
    _material(surface, shared, scratch, constants)
    for i in range(BLOCK):
        scratch[LOSS * BLOCK + i] = 0.0
    for start in range(0, len(photos), PHOTO_ROWS * BLOCK):
        _add_photo(photos[start : start + PHOTO_ROWS * BLOCK], scratch, constants)


@reordered
@no_type_check
def _row_sum(scratch, row, count):
    """Sum the first numbers of a row. Indices without a sign need no look whether they count from the end."""
    total = type(scratch[0])(0.0)
    first = np.uint64(row * BLOCK)
    for i in range(first, first + np.uint64(count)):
        total += scratch[i]
    return total


@estimated
@no_type_check
def _adam(surface, scratch, steps, betas):
    """One step of Adam on one block, which uses the gradient up; maps of rate zero stay as they are.

    Moments are kept without the factors 1 - beta, which are put into the two numbers that stand between a
    moment and its step: `rate first / (sqrt(second) correction + epsilon)`.
    """
    real = type(surface[0])
    beta1, beta2, unscaled = real(1.0) - betas[0], betas[1], math.sqrt(betas[2])
    for k in range(PARAMETERS):
        rate = steps[k] * betas[0]
        if rate != real(0.0):
            correction, epsilon = steps[PARAMETERS] * unscaled / rate, steps[PARAMETERS + 1] / rate
            for i in range(BLOCK):
                gradient = scratch[(GRADIENT + k) * BLOCK + i] * scratch[(CURVE + k) * BLOCK + i]
                gradient = gradient * surface[MOVES * BLOCK + i]
                first = scratch[(FIRST + k) * BLOCK + i] * beta1 + gradient
                second = scratch[(SECOND + k) * BLOCK + i] * beta2 + gradient * gradient
                scratch[(FIRST + k) * BLOCK + i] = first
                scratch[(SECOND + k) * BLOCK + i] = second
                scratch[(GRADIENT + k) * BLOCK + i] = 0.0
                surface[(OFFSET + k) * BLOCK + i] -= first / (math.sqrt(second) * correction + epsilon)


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
        for step in range(len(steps) + 1):
            _evaluate(surface[b], photos[b], shared, scratch, constants)
            losses[b, step] = _row_sum(scratch, LOSS, counts[b])
            if step < len(steps):
                _adam(surface[b], scratch, steps[step], betas)


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
        for i in range(PARAMETERS * BLOCK):
            scratch[GRADIENT * BLOCK + i] = 0.0
        _evaluate(surface[b], photos[b], shared, scratch, constants)
        for i in range(PARAMETERS * BLOCK):
            scratch[GRADIENT * BLOCK + i] *= scratch[CURVE * BLOCK + i]
        for k in range(PARAMETERS):
            sums[b, k] = _row_sum(scratch, GRADIENT + k, counts[b])
        sums[b, PARAMETERS] = _row_sum(scratch, LOSS, counts[b])
