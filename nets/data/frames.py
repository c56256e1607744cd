"""Video files to frames (paper Sec. 5.2): decoding with PyAV, upright, spread over the video.

PyAV is imported when a video is read and not before: only this needs it. What is made of the frames:
`nets.data.videos`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import UInt8

from nets.data.images import DataError

KEPT_FRAMES = 32
"""Between this and twice as many frames of a video are looked at; of neighbours the sharper stays."""

LONGEST_SIDE = 1280
"""Frames with a longer side are shrunk to it when decoded: memory, and crops end at 256 pixels anyway."""

HDR_TRANSFERS = (16, 18)
"""Transfer characteristics PQ and HLG (ITU-T H.273)."""

MINIMUM_FRAMES = 5
"""Sec. 5.2: fewer frames with different light are not a scene."""


def read_frames(path: Path) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Decode a video, upright, and keep `KEPT_FRAMES` to twice as many frames spread over it.

    A video damaged somewhere is used up to there.

    Returns:
        Frames in order, 8-bit sRGB (the video's own curve is taken for it, as players do), all of one size,
        longer side at most `LONGEST_SIDE`.

    Raises:
        DataError: not a video that PyAV decodes, HDR, or fewer than `MINIMUM_FRAMES` frames can be decoded.
    """
    kept: list[tuple[float, UInt8[np.ndarray, "h w 3"]]] = []
    best: tuple[float, UInt8[np.ndarray, "h w 3"]] | None = None
    stride, seen, reason = 1, 0, "it is too short"
    try:
        for frame in _decode(path):
            if kept and frame.shape != kept[0][1].shape:
                continue
            sharpness = _raw_sharpness(frame)
            if best is None or sharpness > best[0]:
                best = (sharpness, frame)
            seen += 1
            if seen % stride == 0:
                kept.append(best)
                best = None
            if len(kept) == 2 * KEPT_FRAMES:
                kept = [
                    max(pair, key=lambda entry: entry[0]) for pair in zip(kept[::2], kept[1::2], strict=True)
                ]
                stride *= 2
    except (import_av().FFmpegError, OSError, ValueError, IndexError) as error:
        if isinstance(error, DataError):
            raise
        reason = (
            f"it is damaged or not a video: {str(error).splitlines()[0] if str(error) else 'no reason given'}"
        )
    if len(kept) < MINIMUM_FRAMES:
        raise DataError(f"{path} gives {len(kept)} frames, fewer than {MINIMUM_FRAMES}: {reason}")
    return [frame for _, frame in kept]


def fit(height: int, width: int, longest: int) -> tuple[int, int]:
    """Return the height and width of a picture shrunk so that no side is longer than `longest`."""
    factor = min(1.0, longest / max(height, width))
    return max(1, round(height * factor)), max(1, round(width * factor))


def import_av() -> ModuleType:
    """Import PyAV, which only this command needs.

    Raises:
        DataError: it is not installed; the message says what to install.
    """
    try:
        import av
    except ImportError as error:
        raise DataError(
            "reading videos needs PyAV, which is not installed; run: pip install 'svbrdf-refine[train]'"
        ) from error
    return av


def _decode(path: Path) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield a video's frames, upright, at most `LONGEST_SIDE` long."""
    if not path.is_file():
        raise DataError(f"{path} is not a file")
    with import_av().open(str(path)) as container:
        if not container.streams.video:
            raise DataError(f"{path} holds no video")
        container.streams.video[0].thread_type = "AUTO"
        for frame in container.decode(video=0):
            if int(frame.color_trc) in HDR_TRANSFERS:
                raise DataError(f"{path} is HDR, which 8-bit photos cannot hold; export it as SDR")
            height, width = fit(frame.height, frame.width, LONGEST_SIDE)
            pixels = frame.reformat(width, height, "rgb24", interpolation="AREA").to_ndarray()
            # The display matrix says how many degrees to turn the picture counter-clockwise.
            yield np.ascontiguousarray(np.rot90(pixels, round(frame.rotation / 90.0)))


def _raw_sharpness(frame: UInt8[np.ndarray, "h w 3"]) -> float:
    green = frame[..., 1].astype(np.int16)
    detail = np.abs(2 * green[1:-1, 1:-1] - green[1:-1, 2:] - green[2:, 1:-1])
    return float(detail.mean() / (green.mean() + 1.0))
