"""Files that play: what is decoded from them is what went in, at the right time, in the right colours."""

from __future__ import annotations

import builtins
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from refine.errors import UserError
from refine.video.encoding import WRITERS, durations, to_yuv420, write_video

COLORS = [(200, 50, 30), (30, 160, 60), (128, 128, 128), (250, 250, 250), (10, 20, 90)]


def flat_frames(height: int = 32, width: int = 48) -> list[np.ndarray]:
    return [np.full((height, width, 3), color, dtype=np.uint8) for color in COLORS]


def decode(path: Path) -> list[np.ndarray]:
    if path.suffix == ".mp4":
        with av.open(str(path)) as container:
            return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    with Image.open(path) as picture:
        frames = []
        for number in range(picture.n_frames):  # type: ignore[attr-defined]
            picture.seek(number)
            frames.append(np.array(picture.convert("RGB")))
        return frames


@pytest.mark.parametrize("suffix", WRITERS)
def test_frames_come_back_in_order_and_color(suffix: str, tmp_path: Path) -> None:
    frames = flat_frames()
    path = tmp_path / f"flat{suffix}"
    write_video(path, iter(frames), len(frames), 10)
    found = decode(path)
    assert len(found) == len(frames)
    for frame, expected in zip(found, frames, strict=True):
        assert frame.shape == expected.shape
        assert np.abs(frame.astype(int) - expected.astype(int)).max() <= 6
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", WRITERS)
def test_same_frames_same_bytes(suffix: str, tmp_path: Path) -> None:
    noise = np.random.default_rng(3).integers(0, 255, (4, 32, 32, 3), dtype=np.uint8)
    for name in ("one", "two"):
        write_video(tmp_path / f"{name}{suffix}", list(noise), 4, 25)
    assert (tmp_path / f"one{suffix}").read_bytes() == (tmp_path / f"two{suffix}").read_bytes()


def test_an_mp4_says_what_its_colors_are(tmp_path: Path) -> None:
    path = tmp_path / "flat.mp4"
    write_video(path, flat_frames(), len(COLORS), 24)
    with av.open(str(path)) as container:
        (stream,) = container.streams.video
        context = stream.codec_context
        assert (context.name, context.pix_fmt, stream.average_rate) == ("h264", "yuv420p", 24)
        # ITU-T H.273: primaries and matrix of BT.709, curve of sRGB, limited range
        found = (context.color_primaries, context.color_trc, context.colorspace, context.color_range)
        assert tuple(int(value) for value in found) == (1, 13, 1, 1)


def test_luma_and_chroma_are_those_of_bt709() -> None:
    red, green, blue = (value / 255.0 for value in COLORS[0])
    luma = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    expected = [16 + 219 * luma, 128 + 224 * (blue - luma) / 1.8556, 128 + 224 * (red - luma) / 1.5748]
    planes = to_yuv420(np.full((6, 4, 3), COLORS[0], dtype=np.uint8))  # 6 is no multiple of 4
    assert planes.shape == (9, 4)
    values = planes.ravel()
    for plane, value in zip((values[:24], values[24:30], values[30:]), expected, strict=True):
        assert set(plane) == {round(value)}


def test_an_mp4_has_even_sides(tmp_path: Path) -> None:
    path = tmp_path / "odd.mp4"
    write_video(path, flat_frames(31, 33), len(COLORS), 10)
    assert decode(path)[0].shape == (30, 32, 3)


@pytest.mark.parametrize(("fps", "unit"), [(25, 10), (30, 10), (24, 1), (30, 1)])
def test_frames_are_shown_for_as_long_as_they_should(fps: int, unit: int) -> None:
    shown = durations(3 * fps, fps, unit)
    assert sum(shown) == 3000
    assert all(duration % unit == 0 for duration in shown)
    assert max(shown) - min(shown) <= unit


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_pictures_loop_forever(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"flat{suffix}"
    write_video(path, flat_frames(), len(COLORS), 25)
    with Image.open(path) as picture:
        assert picture.info["loop"] == 0
        picture.seek(1)
        picture.load()
        assert picture.info["duration"] == 40


def test_what_cannot_be_written_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match=r"end it in \.mp4, \.gif, \.webp"):
        write_video(tmp_path / "flat.avi", flat_frames(), len(COLORS), 10)
    with pytest.raises(UserError, match=r"at most 50 frames"):
        write_video(tmp_path / "flat.gif", flat_frames(), len(COLORS), 60)
    real = builtins.__import__

    def without_av(name: str, *rest: Any, **more: Any) -> Any:
        if name == "av":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without_av)
    with pytest.raises(UserError, match=r"svbrdf-refine\[video\]"):
        write_video(tmp_path / "flat.mp4", flat_frames(), len(COLORS), 10)
    assert list(tmp_path.iterdir()) == []
