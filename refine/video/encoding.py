"""Frames to a file that plays: MP4 by PyAV, GIF and WebP by Pillow. The same frames give the same bytes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import UInt8

from refine.errors import UserError
from refine.files import write_atomically

Frame = UInt8[np.ndarray, "h w 3"]

ENCODERS: dict[str, dict[str, str]] = {
    "libx264": {"crf": "16", "preset": "medium"},
    "libopenh264": {},
    "mpeg4": {},
}
"""For MP4, the best first, with its options; the others are given a bit rate."""

BITS_PER_PIXEL = 0.4
"""Of encoders that need a bit rate, for every frame."""

BT709, SRGB, LIMITED = 1, 13, 1
"""Primaries and matrix, transfer curve, range of a video, as ITU-T H.273 numbers them."""

FASTEST_GIF = 50
"""Frames a second: browsers slow down GIFs that want more."""

PALETTE_FRAMES = 8
"""How many frames a GIF's colours are chosen from."""


def write_video(path: Path, frames: Iterable[Frame], count: int, fps: int) -> None:
    """Write frames as the file's suffix says, to be played in a loop.

    Args:
        path: ends in one of `WRITERS`.
        frames: all of one size.
        count: how many.
        fps: frames per second.

    Raises:
        UserError: the suffix is unknown, a package is missing, or the file cannot be written.
    """
    writer = find_writer(path)
    with write_atomically(path) as temporary:
        writer(temporary, frames, count, fps)


def _write_mp4(path: Path, frames: Iterable[Frame], count: int, fps: int) -> None:
    av = _import_av()
    encoder = next((name for name in ENCODERS if name in av.codecs_available), None)
    if encoder is None:
        raise UserError("This build of PyAV has no encoder for MP4; write a .webp or a .gif.")
    iterator = iter(frames)
    first = _even(next(iterator))
    height, width = first.shape[:2]
    options = {"movflags": "+faststart", "fflags": "+bitexact"}
    with av.open(str(path), "w", format="mp4", options=options) as container:
        stream = container.add_stream(encoder, rate=fps, options=ENCODERS[encoder])
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.thread_count = 1  # the encoder notes the number in the file
        context.flags |= int(av.codec.context.Flags.bitexact)
        context.color_primaries, context.color_trc = BT709, SRGB
        context.colorspace, context.color_range = BT709, LIMITED
        if not ENCODERS[encoder]:
            stream.bit_rate = int(BITS_PER_PIXEL * width * height * fps)
        for pixels in itertools.chain([first], map(_even, iterator)):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(to_yuv420(pixels), format="yuv420p")))
        container.mux(stream.encode(None))


def _write_gif(path: Path, frames: Iterable[Frame], count: int, fps: int) -> None:
    if fps > FASTEST_GIF:
        raise UserError(
            f"A GIF has at most {FASTEST_GIF} frames a second; give a lower --fps, or write .webp."
        )
    from PIL import Image

    pictures = list(frames)
    shown = pictures[:: max(1, len(pictures) // PALETTE_FRAMES)]
    palette = Image.fromarray(np.concatenate(shown)).quantize(256)
    indexed = [Image.fromarray(picture).quantize(palette=palette) for picture in pictures]
    indexed[0].save(
        path, save_all=True, append_images=indexed[1:], duration=durations(count, fps, 10), loop=0, disposal=1
    )


def _write_webp(path: Path, frames: Iterable[Frame], count: int, fps: int) -> None:
    from PIL import Image

    pictures: Iterator[Image.Image] = map(Image.fromarray, frames)
    next(pictures).save(
        path,
        save_all=True,
        append_images=pictures,
        duration=durations(count, fps, 1),
        loop=0,
        quality=90,
        method=4,
    )


WRITERS: dict[str, Callable[[Path, Iterable[Frame], int, int], None]] = {
    ".mp4": _write_mp4,
    ".gif": _write_gif,
    ".webp": _write_webp,
}
"""By the suffix of the file."""


def find_writer(path: Path) -> Callable[[Path, Iterable[Frame], int, int], None]:
    """Return what writes a file of that suffix, its package at hand.

    Raises:
        UserError: the suffix is unknown, or a package is missing.
    """
    suffix = path.suffix.lower()
    if suffix not in WRITERS:
        raise UserError(f"--to {path} is not the name of a video; end it in {', '.join(WRITERS)}.")
    if suffix == ".mp4":
        _import_av()
    return WRITERS[suffix]


def durations(count: int, fps: int, unit: int) -> list[int]:
    """Return how long each frame is shown, in milliseconds: multiples of `unit` that add up."""
    ends = [round(1000.0 * frame / fps / unit) * unit for frame in range(count + 1)]
    return [end - start for start, end in itertools.pairwise(ends)]


def to_yuv420(pixels: Frame) -> UInt8[np.ndarray, "rows w"]:
    """Return luma, then both chromas at half the size, of encoded RGB: ITU-T H.273, matrix 1, limited range.

    Written out, since swscale rounds down unless its flags say otherwise, and darkens by a level or more.
    """
    rgb = pixels.astype(np.float32) / 255.0
    luma = rgb @ np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
    height, width = luma.shape
    planes = [16.0 + 219.0 * luma.ravel()]
    for channel, scale in ((2, 1.8556), (0, 1.5748)):
        chroma = (rgb[..., channel] - luma) / scale
        halved = chroma.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
        planes.append(128.0 + 224.0 * halved.ravel())
    return np.rint(np.concatenate(planes)).astype(np.uint8).reshape(height * 3 // 2, width)


def _import_av() -> ModuleType:
    try:
        import av
    except ImportError as error:
        raise UserError(
            "Writing .mp4 needs PyAV, which is not installed; run pip install 'svbrdf-refine[video]', "
            "or write a .webp or a .gif."
        ) from error
    return av


def _even(pixels: Frame) -> UInt8[np.ndarray, "even_h even_w 3"]:
    """Leave out the last row or column where there is an odd number: colour is halved in both directions."""
    height, width = (side - side % 2 for side in pixels.shape[:2])
    return np.ascontiguousarray(pixels[:height, :width])
