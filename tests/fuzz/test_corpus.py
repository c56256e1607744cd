"""Every image file of the corpus, sound, hostile or mutated: a result or one sentence, within bounds."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from eval.benchmarks.corpus import PNG, bomb, mutations, seeds, with_checksums
from eval.benchmarks.fuzz import read_everything
from nets import decoding

KEPT = sorted((Path(__file__).parent / "corpus").iterdir())
"""What once broke something."""

SOUND = {
    "rgb.png", "rgba.png", "rgb16.png", "rgb.jpg", "progressive.jpg", "rgb.tif", "rgb16.tif", "rgba.tif",
    "tiled.tif", "float.tif", "double.tif", "signed.tif", "wide.tif", "half.exr", "float.exr", "piz.exr",
    "dwa.exr", "tiled.exr", "primaries.exr", "alpha.exr", "rgb.hdr", "rgb.bmp", "rgb.tga", "parts.exr",
    "pages.tif", "cmyk.jpg", "cmyk.tif", "palette.png", "palette.tif", "palette.gif", "lossy.webp",
    "gamma.png", "profile.jpg", "profile.tif", *(f"turned{turn}.jpg" for turn in range(1, 9)),
}  # fmt: skip
"""What every reader reads: photo, strip, map."""

GREY = {"grey.jpg", "bits.png", "bits.tif", "grey16.png", "grey-alpha.png"}
"""Photos and strips, but no map of normals."""


@pytest.fixture(scope="module")
def corpus() -> dict[str, bytes]:
    return seeds()


def outcome(folder: Path, data: bytes, name: str = "file") -> str:
    (folder / name).write_bytes(data)
    return read_everything(folder / name)


def test_sound_files_are_read_and_the_others_refused_in_a_sentence(
    corpus: dict[str, bytes], tmp_path: Path
) -> None:
    for name, data in corpus.items():
        words = outcome(tmp_path, data).split(" | ")
        turned_strip = name in {f"turned{turn}.jpg" for turn in range(5, 9)}
        assert (words == ["read"] * 3) == (name in SOUND), (name, words)
        assert (words[:2] == ["read"] * 2 and words[2] != "read") == (name in GREY), (name, words)
        assert not turned_strip or words[1] == "read"
    assert len(corpus) > len(SOUND | GREY)


def test_damaged_files_end_in_a_result_or_a_sentence(corpus: dict[str, bytes], tmp_path: Path) -> None:
    refused = 0
    for data in corpus.values():
        for changed in mutations(data, seed=7, count=4):
            refused += outcome(tmp_path, changed) != "read | read | read"
    assert refused > 2 * len(corpus) / 3  # the damage is damage


@pytest.mark.parametrize("path", KEPT, ids=lambda path: path.name)
def test_what_once_broke_something_does_no_more(path: Path) -> None:
    said = {
        "gif-claims-78-megapixels": "cannot hold",
        "exr-quotes-what-is-no-text": "the pixels could not be decoded",
    }
    assert said[path.name] in read_everything(path)
    start = time.process_time()
    read_everything(path)
    assert time.process_time() - start < 1.0


@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="reads Linux's accounts of memory")
def test_a_bomb_is_refused_without_memory_or_time(tmp_path: Path) -> None:
    """A PNG of 1 MB that claims 60,000 x 60,000 pixels, and one within the limits that still is none."""
    outcome(tmp_path, bomb(16, 16, 100))  # the decoder runs
    before = decoder_peak()
    bombs = {
        side: bomb(side, side, 1_000_000 if side > 10_000 else 40_000) for side in (60_000, 20_000, 10_000)
    }
    start = time.process_time()
    for side, words in ((60_000, "too large"), (20_000, "too large"), (10_000, "cannot hold")):
        assert words in outcome(tmp_path, bombs[side], "a.png"), side
    assert time.process_time() - start < 2.0
    assert decoder_peak() - before < 64 * 2**10


def decoder_peak() -> int:
    """Most memory that the decoder's process ever held, KiB."""
    status = Path(f"/proc/{decoding._current[0].process.pid}/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0])


NAMES = (
    *(
        "with space.png",
        "new\nline.png",
        "\x1b[2J.png",
        "ünïcödé 漢字 🎉.png",
        "<img src=x onerror=alert(1)>.png",
    ),
    *("%04d.####.png?a=b&c", "-rf.png", "a" * 200 + ".png", "'\";$(true).png", "wall.null"),
)


@pytest.mark.parametrize("name", NAMES)
def test_any_name_will_do(name: str, corpus: dict[str, bytes], tmp_path: Path) -> None:
    assert outcome(tmp_path, corpus["rgb.png"], name) == "read | read | read"
    sentences = outcome(tmp_path, corpus["text.png"], name)  # asserts that it is printable
    assert "not a" in sentences


def test_a_name_that_is_not_text_is_a_sentence(corpus: dict[str, bytes], tmp_path: Path) -> None:
    path = os.fsencode(tmp_path) + b"/\xff.png"
    with open(path, "wb") as file:
        file.write(corpus["rgb.png"])
    assert "not valid text" in read_everything(Path(os.fsdecode(path)))


def test_what_is_no_file_is_a_sentence(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "nowhere").symlink_to(tmp_path / "gone")
    (tmp_path / "empty").touch()
    cases = {".": "is a folder", "pipe": "pipe or a device", "loop": "symbolic links", "nowhere": "not exist"}
    for name, words in {**cases, "empty": "0 bytes", "nul\0byte": "not the name of a file"}.items():
        assert words in read_everything(tmp_path / name)
    assert "device" in read_everything(Path("/dev/zero"))


def test_checksums_are_set_right() -> None:
    png = bomb(16, 16, 100)
    broken = png[: len(PNG) + 12] + b"\x11" + png[len(PNG) + 13 :]
    assert with_checksums(broken) != broken
    assert with_checksums(with_checksums(broken)) == with_checksums(broken)
    assert with_checksums(png) == png
