"""How the fused engine packs tensors for its compiled loops (`kernel.py`): blocks of pixels, rows of numbers.

Only a span of pixels is packed at a time, so that what is packed stays small however large the photo is; and
only for them it is computed how they are lit and seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from losses.reflectance import LOG_OFFSET
from nets.render import Conventions, Geometry
from nets.svbrdf import MAPS
from refine.bands import pixel_geometry
from refine.capture import Capture
from refine.engine import kernel
from refine.parametrization import ALBEDO_RANGE, ROUGHNESS_RANGE, SLOPE_SCALE, Parameters

ROWS: dict[str, slice] = dict(zip(MAPS, (slice(0, 2), slice(2, 5), slice(5, 6), slice(6, 9)), strict=True))
"""Where each map's parameters are among the numbers of a pixel."""

OUT_OF_REACH = 1e30
"""Ceiling of renderings where the photo is not clipped; above any radiance there is, below float32's end."""

Span = slice
"""A range of pixels in row order; it begins at a multiple of `kernel.BLOCK`."""

GeometryAt = Callable[[Int[Tensor, "1 pixels"]], Geometry]
"""From pixels, numbered in row order, to their shading geometry, `[1, C, 1, pixels]`."""


def constants(conventions: Conventions, dtype: torch.dtype) -> Float[np.ndarray, "9"]:
    """Return what the compiled loops must know of parametrization, data term and renderer, in their order."""
    (albedo, white), (smooth, rough) = ALBEDO_RANGE, ROUGHNESS_RANGE
    return np.array(
        [
            SLOPE_SCALE,
            albedo,
            white - albedo,
            smooth,
            rough - smooth,
            LOG_OFFSET,
            conventions.roughness_floor,
            conventions.visibility_floor,
            conventions.distribution_floor,
        ],
        dtype=numpy_type(dtype),
    )


def numpy_type(dtype: torch.dtype) -> np.dtype:
    """Return numpy's name of a type."""
    return np.dtype(str(dtype).removeprefix("torch."))


def count_blocks(span: Span) -> int:
    """Return how many blocks a range of pixels fills, the last perhaps in part."""
    return -(-(span.stop - span.start) // kernel.BLOCK)


def pixels_of(blocks: slice, span: Span) -> Span:
    """Return the pixels of some blocks of a span."""
    first, end = (span.start + place * kernel.BLOCK for place in (blocks.start, blocks.stop))
    return slice(first, min(end, span.stop))


def count_pixels(span: Span) -> Int[np.ndarray, "blocks"]:
    """Return how many pixels of each block are no padding."""
    starts = np.arange(span.start, span.stop, kernel.BLOCK, dtype=np.int64)
    return np.minimum(kernel.BLOCK, span.stop - starts)


def aligned_zeros(shape: tuple[int, ...], dtype: torch.dtype | np.dtype) -> Float[np.ndarray, "*shape"]:
    """Return zeros that begin with a line of the cache, as torch's do: a vector across two costs more."""
    name = str(dtype).removeprefix("torch.")
    zeros: Float[np.ndarray, "*shape"] = torch.zeros(shape, dtype=getattr(torch, name)).numpy()
    return zeros


def scratch(real: np.dtype) -> Float[np.ndarray, "numbers"]:
    """Return what one thread needs besides the blocks it works on."""
    return aligned_zeros((kernel.SCRATCH_ROWS * kernel.BLOCK,), real)


def given_geometry(geometry: Geometry) -> GeometryAt:
    """Return the geometry of any pixels of a photo from that of all of them."""

    def at(pixels: Int[Tensor, "1 pixels"]) -> Geometry:
        return Geometry(*(at_pixels(getattr(geometry, field.name), pixels) for field in fields(Geometry)))

    return at


def computed_geometry(
    capture: Capture, size: tuple[int, int], conventions: Conventions, dtype: torch.dtype
) -> GeometryAt:
    """Return the geometry of any pixels of a photo from its light and camera."""

    def at(pixels: Int[Tensor, "1 pixels"]) -> Geometry:
        return pixel_geometry(pixels, size, capture.light, capture.camera, conventions, dtype)

    return at


def at_pixels(tensor: Tensor, pixels: Int[Tensor, "1 n"]) -> Tensor:
    """Return `[1, C, 1, n]` of a map `[1, C, H, W]`, or one value per channel `[1, C, 1, 1]` as it is."""
    return tensor if tensor.shape[-2:] == (1, 1) else tensor.flatten(2)[..., pixels]


def pack_surface(
    start: Parameters, offsets: dict[str, Tensor], moves: Bool[Tensor, "1 1 h w"], span: Span
) -> Float[np.ndarray, "blocks numbers"]:
    """Pack starting parameters, whether pixels move, and offsets, `[1, C, H, W]` by map name.

    Args:
        start: parameters at the start.
        offsets: full-size offsets; maps that are not named have none.
        moves: where offsets count and are moved.
        span: the pixels.
    """
    blocks = _blocks(kernel.SURFACE_ROWS, span, start.normal.dtype)
    _fill_start(blocks, start, span)
    for name, offset in offsets.items():
        _fill(blocks, kernel.OFFSET + ROWS[name].start, offset, span)
    _fill(blocks, kernel.MOVES, moves, span)
    blocks[:, kernel.OFFSET :] *= blocks[:, kernel.MOVES, None]
    return blocks.reshape(len(blocks), -1)


def restart(surface: Float[np.ndarray, "blocks numbers"], start: Parameters, span: Span) -> None:
    """Put other starting parameters, without offsets, into a packed surface."""
    blocks = surface.reshape(len(surface), -1, kernel.BLOCK)
    _fill_start(blocks, start, span)
    blocks[:, kernel.OFFSET :] = 0.0


def pack_photos(
    captures: Sequence[Capture], geometries: Sequence[GeometryAt], span: Span, dtype: torch.dtype
) -> Float[np.ndarray, "blocks numbers"]:
    """Pack photos with the geometry of their lights and cameras, side by side within each block."""
    pixels = torch.arange(span.start, span.stop)[None]
    packed = _blocks(len(captures) * kernel.PHOTO_ROWS, span, dtype)
    for number, (capture, geometry) in enumerate(zip(captures, geometries, strict=True)):
        first = number * kernel.PHOTO_ROWS
        _pack_photo(packed[:, first : first + kernel.PHOTO_ROWS], capture, geometry(pixels), span)
    return packed.reshape(len(packed), -1)


def unpack_offsets(surface: Float[np.ndarray, "blocks numbers"], span: Span, into: dict[str, Tensor]) -> None:
    """Write the offsets of a span of pixels into full-size tensors `[1, C, H, W]`, by map name."""
    unpack(surface[:, kernel.OFFSET * kernel.BLOCK :], span, into)


def unpack(parameters: Float[np.ndarray, "blocks numbers"], span: Span, into: dict[str, Tensor]) -> None:
    """Write rows of all parameters of a span of pixels into full-size tensors `[1, C, H, W]`, by map name."""
    blocks = parameters.reshape(len(parameters), -1, kernel.BLOCK)
    size = span.stop - span.start
    for name, tensor in into.items():
        pixels = blocks[:, ROWS[name]].transpose(1, 0, 2).reshape(tensor.shape[1], -1)[:, :size]
        tensor.view(tensor.shape[1], -1)[:, span] = torch.from_numpy(pixels)


def _pack_photo(
    blocks: Float[np.ndarray, "blocks rows block"], capture: Capture, geometry: Geometry, span: Span
) -> None:
    packed = slice(0, span.stop - span.start)
    _fill(blocks, kernel.LIGHT, geometry.light_direction, packed)
    _fill(blocks, kernel.VIEW, geometry.view, packed)
    _fill(blocks, kernel.HALF, geometry.half_vector, packed)
    _fill(blocks, kernel.FRESNEL, geometry.fresnel_weight, packed)
    _fill(blocks, kernel.IRRADIANCE, geometry.irradiance, packed)
    _fill(blocks, kernel.TARGET, capture.photo, span)
    blocks[:, kernel.TARGET : kernel.CEILING] += blocks.dtype.type(LOG_OFFSET)
    _fill(blocks, kernel.CEILING, capture.unsaturated, span)
    ceiling = blocks[:, kernel.CEILING]
    ceiling[:] = np.where(ceiling > 0.0, OUT_OF_REACH, 1.0)


def _blocks(rows: int, span: Span, dtype: torch.dtype) -> Float[np.ndarray, "blocks rows block"]:
    return aligned_zeros((count_blocks(span), rows, kernel.BLOCK), dtype)


def _fill_start(blocks: Float[np.ndarray, "blocks rows block"], start: Parameters, span: Span) -> None:
    for name in MAPS:
        _fill(blocks, kernel.START + ROWS[name].start, getattr(start, name), span)


def _fill(blocks: Float[np.ndarray, "blocks rows block"], row: int, tensor: Tensor, span: Span) -> None:
    # A map `[1, C, H, W]`, or one value per channel `[1, C, 1, 1]`, to the rows from `row` on.
    channels, size = tensor.shape[1], span.stop - span.start
    rows = blocks[:, row : row + channels]
    if tensor.shape[-2:] == (1, 1):
        rows[:] = tensor.detach().reshape(channels, 1).numpy()
        return
    # Only the image's rows that hold the span: a map may be one value expanded over all pixels.
    width = tensor.shape[-1]
    top = span.start // width
    flat = tensor.detach()[0, :, top : -(-span.stop // width)].reshape(channels, -1)
    pixels = flat[:, span.start - top * width : span.stop - top * width].numpy()
    whole = size // kernel.BLOCK * kernel.BLOCK
    full = pixels[:, :whole].reshape(channels, -1, kernel.BLOCK)
    rows[: len(rows) if whole == size else -1] = full.transpose(1, 0, 2)
    if whole < size:
        rows[-1, :, : size - whole] = pixels[:, whole:]
