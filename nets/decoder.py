"""Decodes image files one after the other, as a program of its own: `decoding.py` starts it and asks it.

Codecs are native code that reads whatever a stranger sends. What such a file breaks, fills up or holds up is
this process, which has a limit on its memory and can be replaced. It is run by its path, so it imports
nothing of this library.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, BinaryIO

import numpy as np
import OpenImageIO as oiio

READY = b"refine decoder 1\n"
"""Said once everything is imported."""

LENGTHS = struct.Struct("<QQ")
"""Bytes of the JSON that follows, and of the pixels after it."""

LIGHT_BYTES, RESIZING_BYTES = 13, 18
"""Bytes per pixel of what a photo becomes: linear light and a mask; and those and what resizing them adds."""

SPARSEST = 2000
"""Pixels per byte of a file, at most: deflate, at its best, makes a byte of a thousand grey pixels."""

ALWAYS_ENOUGH = 2**22
"""Pixels that any file may have: they do no harm."""

NATIVE = {"uint8": "uint8", "uint16": "uint16", "half": "float16"}
"""Pixel types that are handed on as they are; all others become float32."""

NAMES_OF_NOTHING = (".null", ".nul", ".term")
"""Ends of names that OpenImageIO takes for pictures without looking into the file."""

ATTRIBUTES = (
    "oiio:ColorSpace",
    "oiio:UnassociatedAlpha",
    "oiio:subimages",
    "jpeg:ColorSpace",
    "tiff:ColorSpace",
    "ICCProfile:profile_description",
    "Exif:ColorSpace",
    "Orientation",
    "chromaticities",
)
"""What is told of a file's metadata."""


@dataclass(frozen=True)
class Limits:
    """What one file may take.

    Attributes:
        side: longest side in pixels.
        memory: bytes that decoding may add to this process, and that the picture as stored and the photo
            made of it may take together.
        seconds: until the process is ended.
    """

    side: int = 32768
    memory: int = 2 * 2**30
    seconds: float = 120.0


class Refused(Exception):
    """A file that is not decoded: its kind (`format`, `size`, `flat`, `damage`, `name`) and the reason."""


def decode(path: str, limits: Limits) -> tuple[dict[str, Any], np.ndarray]:
    """Decode the first image of a file.

    Returns:
        What the file says of it, and the pixels as stored, [height, width, channels].

    Raises:
        Refused: it is no image, damaged, no flat picture, or too large by its header alone.
        MemoryError: it takes more than expected.
    """
    wanted = oiio.ImageSpec()
    wanted.attribute("oiio:UnassociatedAlpha", 1)
    oiio.attribute("limits:imagesize_MB", max(1, limits.memory // 2**20))
    try:
        path.encode()
    except UnicodeEncodeError:
        raise Refused("name", "") from None
    with open(path, "rb") as file:
        # The content decides the format; to some readers the name would say it all.
        nameless = path.lower().endswith(NAMES_OF_NOTHING)
        opened = oiio.ImageInput.open(f"/dev/fd/{file.fileno()}" if nameless else path, wanted)
    if opened is None:
        reason = _reason(oiio.geterror)
        raise Refused("size" if " limit" in reason else "format", reason)
    try:
        spec = opened.spec()
        _require_reasonable_size(spec, os.path.getsize(path), limits)
        stored = str(spec.format) if str(spec.format) in NATIVE else "float"
        pixels = opened.read_image(0, 0, 0, spec.nchannels, stored)
        if pixels is None or opened.has_error:
            raise Refused("damage", _reason(opened.geterror) or "the pixels could not be decoded")
    finally:
        opened.close()
    header = {
        "width": spec.width,
        "height": spec.height,
        "channels": [str(name) for name in spec.channelnames],
        "format": str(spec.format),
        "display": [spec.full_width, spec.full_height],
        "profile": spec.getattribute("ICCProfile") is not None,
        "attributes": {name: _plain(spec.getattribute(name)) for name in ATTRIBUTES},
    }
    pixels = np.ascontiguousarray(pixels).view(NATIVE.get(stored, "float32"))
    return header, pixels.reshape(spec.height, spec.width, spec.nchannels)


def _require_reasonable_size(spec: Any, size: int, limits: Limits) -> None:
    """Refuse, from the header alone, what would not fit in memory or is not a flat picture."""
    width, height = spec.width, spec.height
    pixels = width * height
    stored = pixels * spec.nchannels * np.dtype(NATIVE.get(str(spec.format), "float32")).itemsize
    needed = max(stored + LIGHT_BYTES * pixels, RESIZING_BYTES * pixels)
    if max(width, height) > limits.side or needed > limits.memory:
        raise Refused("size", f"{width} x {height}")
    if pixels > max(ALWAYS_ENOUGH, SPARSEST * size):
        raise Refused("damage", f"{size} bytes cannot hold {width} x {height} pixels")
    if spec.deep or spec.depth > 1:
        raise Refused("flat", "")
    if pixels < 1 or spec.nchannels < 1:
        raise Refused("damage", "it has no pixels")


def _plain(value: Any) -> Any:
    """Return a metadata value as JSON can hold it."""
    if isinstance(value, tuple):
        return [float(number) for number in value]
    return value if value is None or isinstance(value, str | int | float) else str(value)


def _reason(message: Callable[[], str]) -> str:
    """First line of a message, without its full stop; empty if it quotes from the file what is no text."""
    try:
        lines = message().strip().splitlines()
    except UnicodeDecodeError:
        return ""
    return lines[0].rstrip(" .") if lines else ""


def _limit_memory(allowed: int) -> None:
    """Let this process have so much more memory than it has now, where the system can enforce that."""
    try:
        import resource

        with open("/proc/self/statm", encoding="ascii") as file:
            held = int(file.read().split()[5]) * os.sysconf("SC_PAGE_SIZE")
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (held + allowed, hard))
    except (ImportError, OSError, ValueError):
        return


def _reply(out: BinaryIO, answer: dict[str, Any], pixels: np.ndarray | None = None) -> None:
    text = json.dumps(answer).encode()
    out.write(LENGTHS.pack(len(text), 0 if pixels is None else pixels.nbytes) + text)
    if pixels is not None:
        out.write(pixels.data.cast("B"))
    out.flush()


def serve(requests: BinaryIO, out: BinaryIO) -> None:
    """Answer requests, a line of JSON each (`path` and the fields of `Limits`), until there are no more."""
    out.write(READY)
    out.flush()
    for line in requests:
        asked = json.loads(line)
        path, limits = asked.pop("path"), Limits(**asked)
        _limit_memory(limits.memory)
        try:
            header, pixels = decode(path, limits)
        except Refused as refused:
            _reply(out, dict(zip(("refused", "reason"), refused.args, strict=True)))
        except MemoryError:
            _reply(out, {"refused": "memory", "reason": ""})
        except OSError as error:  # the file went away meanwhile
            _reply(out, {"refused": "damage", "reason": str(error.strerror)})
        else:
            _reply(out, {**header, "dtype": str(pixels.dtype)}, pixels)
            del pixels


def request(path: str, limits: Limits) -> bytes:
    """Return the line that asks for a file."""
    return json.dumps({"path": path, **asdict(limits)}).encode() + b"\n"


def main() -> None:
    """Serve standard input; whatever libraries print goes nowhere."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop
    replies = os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    oiio.attribute("threads", 1)
    try:
        serve(sys.stdin.buffer, replies)
    except BrokenPipeError:
        os._exit(0)  # the parent is gone


if __name__ == "__main__":
    main()
