"""Image files to arrays, by a process of its own (`decoder.py`): that is what a hostile file may take down.

The process is started when the first file is read, serves all further ones, and ends with this process.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import math
import os
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from jaxtyping import Shaped

from nets import decoder
from nets.decoder import Limits

LARGEST_HEADER = 2**20
"""Bytes of an answer's JSON that are believed."""


class DecodingError(ValueError):
    """A file that was not decoded.

    Attributes:
        kind: `format` (no image), `damage`, `size`, `flat` (deep or a volume), `name` (not text), `memory`,
            `time`, or `crash` of the decoder.
        reason: details, for `format`, `damage` and `size`; may be empty.
    """

    def __init__(self, kind: str, reason: str = "") -> None:
        """Keep kind and reason."""
        super().__init__(f"{kind}: {reason}" if reason else kind)
        self.kind, self.reason = kind, reason


@dataclass(frozen=True)
class Decoded:
    """The first image of a file, as stored.

    Attributes:
        pixels: uint8, uint16, float16 or float32, row 0 at the top as stored, not turned.
        channels: their names.
        format: pixel type of the file, as OpenImageIO calls it.
        display: width and height of its display window.
        profile: whether it holds an ICC profile.
        attributes: its metadata, those of `decoder.ATTRIBUTES`; None for what it does not have.
    """

    pixels: Shaped[np.ndarray, "h w channels"]
    channels: tuple[str, ...]
    format: str
    display: tuple[int, int]
    profile: bool
    attributes: Mapping[str, Any]

    @property
    def integer(self) -> bool:
        """Whether the file stores integers, so that its maximum is a clipping point."""
        return self.format not in ("half", "float", "double")


def decode_file(path: Path | str, limits: Limits | None = None) -> Decoded:
    """Decode an image file in the decoder's process.

    Raises:
        DecodingError: it cannot be decoded within the limits.
        RuntimeError: the decoder cannot be started.
    """
    limits = limits or Limits()
    with _LOCK:
        answer, pixels = _process().ask(os.path.abspath(path), limits)
    if "refused" in answer:
        raise DecodingError(str(answer["refused"]), str(answer.get("reason", "")))
    return as_decoded(answer, pixels)


def as_decoded(header: Mapping[str, Any], pixels: np.ndarray) -> Decoded:
    """Put a header of `decoder.decode` and its pixels together."""
    return Decoded(
        pixels,
        tuple(header["channels"]),
        header["format"],
        tuple(header["display"]),
        header["profile"],
        header["attributes"],
    )


class _Decoder:
    """One decoding process."""

    def __init__(self) -> None:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)}
        self.owner = os.getpid()
        self.process = subprocess.Popen(
            [sys.executable, "-P", decoder.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
            start_new_session=True,  # or Ctrl-C in a terminal would be told to it, too
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        self.requests: IO[bytes] = self.process.stdin
        self.answers: IO[bytes] = self.process.stdout
        if self.answers.read(len(decoder.READY)) != decoder.READY:
            reason = self.process.stderr.read().decode(errors="replace").strip().splitlines()
            self.end()
            raise RuntimeError(f"the decoder of images cannot be started: {reason[-1:] or 'no reason given'}")

    @property
    def usable(self) -> bool:
        """Whether it is this process's own and still runs."""
        return self.owner == os.getpid() and self.process.poll() is None

    def ask(self, path: str, limits: Limits) -> tuple[dict[str, Any], np.ndarray]:
        """Have one file decoded; whatever goes wrong on the way, this process is not used again."""
        expired = threading.Event()

        def stop() -> None:
            expired.set()
            self.process.kill()

        watch = threading.Timer(limits.seconds, stop)
        watch.daemon = True
        watch.start()
        try:
            self.requests.write(decoder.request(path, limits))
            self.requests.flush()
            return self._answer(limits)
        except (EOFError, OSError, ValueError, TypeError, KeyError):
            self.end()
            raise DecodingError("time" if expired.is_set() else "crash") from None
        except BaseException:
            self.end()
            raise
        finally:
            watch.cancel()

    def _answer(self, limits: Limits) -> tuple[dict[str, Any], np.ndarray]:
        """Read an answer, trusting none of its numbers: who sends it may have been taken over by a file."""
        length, size = decoder.LENGTHS.unpack(self._read(decoder.LENGTHS.size))
        if length > LARGEST_HEADER or size > limits.memory:
            raise ValueError("an answer that is too long")
        answer = json.loads(self._read(length))
        if "refused" in answer:
            if answer["refused"] == "memory":
                self.end()
            return answer, np.empty((0, 0, 0))
        shape = int(answer["height"]), int(answer["width"]), len(answer["channels"])
        kind = np.dtype({"uint8": "u1", "uint16": "u2", "float16": "f2", "float32": "f4"}[answer["dtype"]])
        if min(shape) < 1 or math.prod(shape) * kind.itemsize != size:
            raise ValueError("an answer that contradicts itself")
        pixels = np.empty(shape, dtype=kind)
        if self.answers.readinto(pixels.data.cast("B")) != size:  # type: ignore[attr-defined]
            raise EOFError
        return answer, pixels

    def _read(self, count: int) -> bytes:
        data = self.answers.read(count)
        if len(data) != count:
            raise EOFError
        return data

    def end(self) -> None:
        """End the process, unless it is another one's."""
        if self.owner != os.getpid():
            self.process.returncode = 0  # after a fork: it is not ours to wait for
            return
        self.process.kill()
        for stream in (self.process.stdin, self.process.stdout, self.process.stderr):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()
        self.process.wait()


_LOCK = threading.Lock()
_current: list[_Decoder] = []


def _process() -> _Decoder:
    """Return the running decoder, or a new one after a crash or a fork."""
    if not (_current and _current[0].usable):
        _end()
        _current.append(_Decoder())
    return _current[0]


def _end() -> None:
    while _current:
        _current.pop().end()


atexit.register(_end)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=lambda: globals().__setitem__("_LOCK", threading.Lock()))
