"""Image files are decoded by another process, which may crash, fill up and hang, and this one goes on."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from nets import decoder, decoding
from nets.decoding import DecodingError, Limits, decode_file

ROOT = Path(__file__).parents[2]


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "a.png"
    oiio.ImageBuf(np.arange(16 * 20 * 3, dtype=np.uint8).reshape(16, 20, 3)).write(str(path))
    return path


def running() -> int:
    """Return the decoder's process number."""
    return decoding._current[0].process.pid


def test_pixels_arrive_as_stored(picture: Path, tmp_path: Path) -> None:
    found = decode_file(picture)
    np.testing.assert_array_equal(found.pixels, np.arange(960, dtype=np.uint8).reshape(16, 20, 3))
    assert (found.format, found.channels, found.display) == ("uint8", ("R", "G", "B"), (20, 16))
    half = np.linspace(-2.0, 7.0, 16 * 16, dtype=np.float16).reshape(16, 16, 1)
    oiio.ImageBuf(half.astype(np.float32)).write(str(tmp_path / "a.exr"), "half")
    found = decode_file(tmp_path / "a.exr")
    assert found.pixels.dtype == np.float16
    np.testing.assert_array_equal(found.pixels, half)


def test_one_process_serves_all_files(picture: Path) -> None:
    decode_file(picture)
    first = running()
    threads = [threading.Thread(target=decode_file, args=(picture,)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert running() == first


def test_a_relative_name_is_of_this_folder(picture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decode_file(picture)  # the decoder is somewhere else by then
    monkeypatch.chdir(picture.parent)
    assert decode_file("a.png").pixels.shape == (16, 20, 3)


def test_a_decoder_that_dies_is_an_error_and_the_next_file_is_read(picture: Path) -> None:
    decode_file(picture)
    pid = running()
    os.kill(pid, signal.SIGSTOP)  # a file holds it up ...
    threading.Timer(0.05, os.kill, (pid, signal.SIGSEGV)).start()  # ... and breaks it
    threading.Timer(0.06, os.kill, (pid, signal.SIGCONT)).start()
    with pytest.raises(DecodingError) as caught:
        decode_file(picture)
    assert caught.value.kind == "crash"
    assert decode_file(picture).pixels.shape == (16, 20, 3)
    assert running() != pid


def test_a_file_that_takes_too_long_is_given_up(picture: Path) -> None:
    decode_file(picture)
    os.kill(running(), signal.SIGSTOP)
    start = time.perf_counter()
    with pytest.raises(DecodingError) as caught:
        decode_file(picture, Limits(seconds=0.1))
    assert caught.value.kind == "time"
    assert time.perf_counter() - start < 2.0
    assert decode_file(picture).pixels.shape == (16, 20, 3)


def test_a_tile_may_not_be_larger_than_the_image_is_allowed_to_be(tmp_path: Path) -> None:
    # One tile of 2048 x 2048 in an image of 64 x 64: the size of the image is harmless.
    spec = oiio.ImageSpec(64, 64, 3, "uint8")
    spec.tile_width = spec.tile_height = 2048
    spec.attribute("compression", "zip")
    path = tmp_path / "a.tif"
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(np.zeros((64, 64, 3), np.uint8))
    assert output.close()
    assert decode_file(path).pixels.shape == (64, 64, 3)
    with pytest.raises(DecodingError) as caught:
        decode_file(path, Limits(memory=4 * 2**20))
    assert caught.value.kind == "size"


@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="limits of memory are Linux's")
def test_the_decoder_cannot_take_more_memory_than_it_may() -> None:
    program = "import numpy; from nets import decoder; decoder._limit_memory(2**26); numpy.ones(%d, 'u1')"
    command = [sys.executable, "-c", program % 2**25]
    assert subprocess.run(command, cwd=ROOT, check=True).returncode == 0
    command[-1] = program % 2**27
    failed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert failed.stderr.strip().splitlines()[-1].startswith("numpy._core._exceptions._ArrayMemoryError")


@pytest.mark.parametrize(
    "answer",
    [
        b"",
        b"\xff" * 16,
        decoder.LENGTHS.pack(2, 0) + b"{}",
        decoder.LENGTHS.pack(4, 0) + b"nope",
        decoder.LENGTHS.pack(57, 4) + b'{"height":1,"width":1,"channels":["R"],"dtype":"uint8"}  abcd',
    ],
    ids=["nothing", "endless", "no header", "no json", "other size"],
)
def test_answers_are_not_trusted(picture: Path, answer: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    decode_file(picture)
    monkeypatch.setattr(decoding._current[0], "answers", io.BytesIO(answer))
    with pytest.raises(DecodingError) as caught:
        decode_file(picture)
    assert caught.value.kind == "crash"
