"""Image files in and any files out, as they are on disk: guarded decoding and all-or-nothing writing.

What the pixel values mean (colour, orientation, maps) is the business of `photo.py` and `maps.py`.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Float32

from refine.errors import UserError

MAXIMUM_SIDE = 32768
"""Longest side of an image, in pixels, that is decoded."""

MAXIMUM_PIXELS = 400_000_000
"""Most pixels of an image that are decoded (4.8 GB as three float32 channels)."""

_STANDARD_ERROR = threading.Lock()


@dataclass(frozen=True)
class DecodedImage:
    """The first image of a file, upright, its values as stored.

    Attributes:
        pixels: values as stored, row 0 at the top; integer formats are divided by their maximum.
        spec: the OpenImageIO header: original format, channel names, metadata.
        notes: in plain words, what is unusual about the file and whether it was turned.
    """

    pixels: Float32[np.ndarray, "h w channels"]
    spec: Any
    notes: tuple[str, ...]

    @property
    def integer(self) -> bool:
        """Whether the file stores integers, so that its maximum is a clipping point."""
        return str(self.spec.format) not in ("half", "float", "double")


def decode_image(path: Path | str) -> DecodedImage:
    """Decode an image file, whatever its extension says, without interpreting its colours.

    The EXIF orientation is applied. Colours are not multiplied by alpha where the file keeps them apart.

    Raises:
        UserError: the path is missing, not a regular file, empty, unreadable, not an image,
            damaged, cut short, a volume, or larger than `MAXIMUM_SIDE` or `MAXIMUM_PIXELS`.
    """
    path = Path(path)
    _require_regular_file(path)
    wanted = oiio.ImageSpec()
    wanted.attribute("oiio:UnassociatedAlpha", 1)
    try:
        opened = oiio.ImageInput.open(str(path), wanted)
    except UnicodeEncodeError as error:
        raise UserError(f"The name of {str(path)!r} is not valid text; rename the file.") from error
    if opened is None:
        message = oiio.geterror()
        if "limits:" in message:
            raise UserError(
                f"{path} is too large to decode; shrink it to at most {MAXIMUM_SIDE} pixels a side."
            )
        raise UserError(
            f"{path} is not an image that can be read ({_one_line(message)}); "
            "give a JPEG, PNG, TIFF, EXR or HDR file."
        )
    try:
        spec = opened.spec()
        _require_reasonable_size(path, spec)
        with _without_library_messages() if opened.format_name() == "png" else contextlib.nullcontext():
            pixels = opened.read_image(0, 0, 0, spec.nchannels, "float")
        if pixels is None or opened.has_error:
            reason = _one_line(opened.geterror()) or "the pixels could not be decoded"
            raise UserError(f"{path} is damaged or cut short ({reason}); copy or export it again.")
    finally:
        opened.close()
    notes = _peculiarities(spec)
    pixels = pixels.reshape(spec.height, spec.width, spec.nchannels)
    orientation = spec.get_int_attribute("Orientation", 1)
    if 2 <= orientation <= 8:
        buffer = oiio.ImageBuf(pixels)
        buffer.orientation = orientation
        buffer = oiio.ImageBufAlgo.reorient(buffer)
        turned = np.asarray(buffer.get_pixels(oiio.FLOAT), dtype=np.float32)
        pixels = turned.reshape(buffer.spec().height, buffer.spec().width, spec.nchannels)
        notes.append(f"turned upright (EXIF orientation {orientation})")
    return DecodedImage(pixels, spec, tuple(notes))


@contextmanager
def write_together(paths: Sequence[Path | str]) -> Iterator[list[Path]]:
    """Write several files so that either all of them appear, complete, or none does.

    Yields temporary siblings of `paths` with the same extensions, already created and empty. When the
    block ends well they are flushed to disk and renamed to `paths`, replacing what was there; when
    anything is raised they are removed, and so are the folders that were created for them.

    Raises:
        UserError: a folder cannot be made or written, a target is a folder, or the disk is full; also
            for any `OSError` the block itself raises.
    """
    targets = [Path(path) for path in paths]
    temporaries: list[Path] = []
    appeared: list[Path] = []
    created: list[Path] = []
    current = targets[0] if targets else Path()
    try:
        for current in targets:
            created += _make_folders(current.parent)
            if current.exists() and not stat.S_ISREG(current.stat().st_mode):
                raise UserError(f"Cannot write {current}: it is not a regular file; choose another name.")
            temporary = current.resolve().with_name(f".refine-{secrets.token_hex(8)}{current.suffix}")
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            temporaries.append(temporary)
        yield list(temporaries)
        for temporary in temporaries:
            with temporary.open("rb+") as file:
                os.fsync(file.fileno())
        for current, temporary in zip(targets, temporaries, strict=True):
            new = not current.exists()
            os.replace(temporary, current.resolve())
            if new:
                appeared.append(current)
    except BaseException as error:
        for leftover in temporaries + appeared:
            with contextlib.suppress(OSError):
                leftover.unlink(missing_ok=True)
        for folder in reversed(created):
            with contextlib.suppress(OSError):
                folder.rmdir()
        if isinstance(error, OSError):
            reason = error.strerror or str(error)
            raise UserError(
                f"Cannot write {current}: {reason}; choose another folder or make room there."
            ) from error
        raise


@contextmanager
def write_atomically(path: Path | str) -> Iterator[Path]:
    """Write one file so that it appears complete or not at all: `write_together` for a single path."""
    with write_together([path]) as (temporary,):
        yield temporary


def write_text_atomically(path: Path | str, text: str) -> None:
    """Write UTF-8 text with Unix line ends, complete or not at all.

    Raises:
        UserError: as `write_together`.
    """
    with write_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def _make_folders(folder: Path) -> list[Path]:
    """Create `folder` and its missing parents; return the new ones, outermost first."""
    missing = [candidate for candidate in (folder, *folder.parents) if not candidate.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return missing[::-1]


def _require_regular_file(path: Path) -> None:
    """Refuse what cannot be a photo before any library touches it (a pipe would block for ever)."""
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise UserError(f"{path} is a folder; name one image in it.")
        if not stat.S_ISREG(status.st_mode):
            raise UserError(f"{path} is a pipe or a device; save the image as a file first.")
        if status.st_size == 0:
            raise UserError(f"{path} is empty (0 bytes); copy or export it again.")
        path.open("rb").close()
    except FileNotFoundError as error:
        raise UserError(f"{path} does not exist; check the name and the folder.") from error
    except OSError as error:
        raise UserError(
            f"{path} cannot be read ({error.strerror}); check its name and permissions."
        ) from error


def _require_reasonable_size(path: Path, spec: Any) -> None:
    """Refuse, from the header alone, what would not fit in memory or is not a flat picture."""
    width, height = spec.width, spec.height
    if width > MAXIMUM_SIDE or height > MAXIMUM_SIDE or width * height > MAXIMUM_PIXELS:
        raise UserError(
            f"{path} claims {width} x {height} pixels; shrink it to at most {MAXIMUM_SIDE} a side "
            f"and {MAXIMUM_PIXELS // 10**6} megapixels."
        )
    if spec.deep or spec.depth > 1:
        raise UserError(f"{path} is a deep or volume image; export it as a flat picture.")


def _peculiarities(spec: Any) -> list[str]:
    """Say in plain words what distinguishes a file from an ordinary 8-bit RGB picture."""
    notes = []
    images = spec.get_int_attribute("oiio:subimages", 1)
    if images > 1:
        notes.append(f"first of {images} images in the file used")
    if str(spec.format) != "uint8":
        notes.append(f"{spec.format} pixels kept at full precision")
    stored = spec.getattribute("jpeg:ColorSpace") or spec.getattribute("tiff:ColorSpace")
    if stored:
        notes.append(f"stored as {stored}, converted to RGB without its profile")
    if (spec.full_width, spec.full_height) != (spec.width, spec.height):
        notes.append(
            f"all stored pixels used, not the display window of {spec.full_width} x {spec.full_height}"
        )
    return notes


@contextmanager
def _without_library_messages() -> Iterator[None]:
    """Keep libpng from printing on standard error what OpenImageIO reports to us anyway."""
    with _STANDARD_ERROR, contextlib.ExitStack() as stack:
        try:
            saved = os.dup(2)
        except OSError:  # the process has no standard error
            yield
            return
        stack.callback(os.close, saved)
        with open(os.devnull, "wb") as silence:
            os.dup2(silence.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(saved, 2)


def _one_line(message: str) -> str:
    """First line of a library's message, without its trailing full stop."""
    lines = message.strip().splitlines()
    return lines[0].rstrip(" .") if lines else ""
