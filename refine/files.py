"""Image files in and any files out, as they are on disk: guarded decoding and all-or-nothing writing.

What the pixel values mean (colour, orientation, maps) is the business of `photo.py` and `maps.py`.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Shaped

from nets import decoding
from nets.decoding import Decoded, DecodingError, Limits
from nets.text import printable
from refine.errors import UserError
from refine.staging import flush, held, staging_folder


@dataclass(frozen=True)
class DecodedImage:
    """The first image of a file, upright, its values as stored.

    Attributes:
        stored: values as stored, row 0 at the top.
        file: what the file says of itself, its own pixels apart.
        notes: in plain words, what is unusual about the file and whether it was turned.
    """

    stored: Shaped[np.ndarray, "h w channels"]
    file: Decoded
    notes: tuple[str, ...]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.stored.shape[0], self.stored.shape[1]

    @property
    def integer(self) -> bool:
        """Whether the file stores integers, so that its maximum is a clipping point."""
        return self.file.integer

    @property
    def pixels(self) -> Float32[np.ndarray, "h w channels"]:
        """All of them, integers divided by their maximum."""
        return self.rows(slice(None))

    def rows(self, rows: slice) -> Float32[np.ndarray, "rows w channels"]:
        """Return some rows, integers divided by their maximum."""
        stored = self.stored[rows]
        values = stored.astype(np.float32)
        return values / np.float32(np.iinfo(stored.dtype).max) if stored.dtype.kind == "u" else values


def decode_image(path: Path | str, limits: Limits | None = None) -> DecodedImage:
    """Decode an image file, whatever its extension says, without interpreting its colours.

    The EXIF orientation is applied. Colours are not multiplied by alpha where the file keeps them apart.
    The file is read in another process (`nets.decoding`), so that no file can take this one down.

    Raises:
        UserError: the path is missing, not a regular file, empty, unreadable, not an image,
            damaged, cut short, a volume, or takes more than the limits allow.
    """
    path, limits = Path(path), limits or Limits()
    _require_regular_file(path)
    try:
        file = decoding.decode_file(path, limits)
    except DecodingError as error:
        raise UserError(_sentence(path, error, limits)) from error
    notes = _peculiarities(file)
    stored, orientation = file.pixels, file.attributes["Orientation"]
    if isinstance(orientation, int) and orientation in UPRIGHT:
        stored = np.ascontiguousarray(UPRIGHT[orientation](stored))
        notes.append(f"turned upright (EXIF orientation {orientation})")
    return DecodedImage(stored, replace(file, pixels=stored), tuple(notes))


UPRIGHT: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    2: lambda stored: stored[:, ::-1],
    3: lambda stored: stored[::-1, ::-1],
    4: lambda stored: stored[::-1],
    5: lambda stored: stored.swapaxes(0, 1),
    6: lambda stored: np.rot90(stored, -1),
    7: lambda stored: stored[::-1, ::-1].swapaxes(0, 1),
    8: lambda stored: np.rot90(stored, 1),
}
"""How an image of an EXIF orientation is turned upright; 1 is upright."""


def _sentence(path: Path, error: DecodingError, limits: Limits) -> str:
    """Say in one sentence why a file was not decoded, and what to do."""
    gibibytes = f"{limits.memory / 2**30:.3g} GiB"
    return {
        "format": f"{path} is not an image that can be read ({error.reason}); "
        "give a JPEG, PNG, TIFF, EXR or HDR file.",
        "damage": f"{path} is damaged or cut short ({error.reason}); copy or export it again.",
        "size": f"{path} is too large ({error.reason}); "
        f"shrink it to at most {limits.side} pixels a side and to what fits in {gibibytes} of memory.",
        "flat": f"{path} is a deep or volume image; export it as a flat picture.",
        "name": f"The name of {path} is not valid text; rename the file.",
        "memory": f"{path} takes more than {gibibytes} of memory to decode; shrink it or export it anew.",
        "time": f"{path} takes longer than {limits.seconds:.0f} s to decode; export it anew.",
    }.get(error.kind, f"{path} makes the decoder fail, so it is damaged or forged; export it anew.")


@contextmanager
def write_together(
    paths: Sequence[Path | str], outdated: Callable[[], Iterable[Path]] = tuple
) -> Iterator[list[Path]]:
    """Write several files so that either all of them appear, complete, or none does.

    Yields temporary files with the same extensions, already created and empty, in a hidden folder beside
    `paths`. When the block ends well they are flushed to disk and renamed to `paths`, replacing what was
    there; when anything is raised they are removed, and so are the folders that were created for them. Of
    several, the last is taken away before the others are replaced and comes back last: where it is, even
    after a kill, everything beside it is of the same run. Two processes that write into one folder rename
    one after the other. What a killed process left in a folder is removed by the next that writes there.

    Args:
        paths: of the files.
        outdated: asked for further files to remove, when it is this process's turn to rename.

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
        with contextlib.ExitStack() as stack:
            staging: dict[Path, Path] = {}
            for number, current in enumerate(targets):
                created += _make_folders(current.parent)
                if current.exists() and not stat.S_ISREG(current.stat().st_mode):
                    raise UserError(f"Cannot write {current}: it is not a regular file; choose another name.")
                folder = current.resolve().parent
                if folder not in staging:
                    staging[folder] = stack.enter_context(staging_folder(folder))
                temporary = staging[folder] / f"{number}{current.suffix}"
                os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
                temporaries.append(temporary)
            yield list(temporaries)
            for temporary in temporaries:
                with temporary.open("rb+") as file:
                    os.fsync(file.fileno())
            with held(staging):
                leftover = list(outdated())
                if len(targets) > 1:
                    targets[-1].resolve().unlink(missing_ok=True)
                for current, temporary in zip(targets, temporaries, strict=True):
                    new = not current.exists()
                    os.replace(temporary, current.resolve())
                    if new:
                        appeared.append(current)
                for current in leftover:
                    current.unlink(missing_ok=True)
                flush(staging)
    except BaseException as error:
        for path in appeared:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
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
    if "\0" in str(path):
        raise UserError(f"{path} is not the name of a file; check it.")
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


def _peculiarities(file: Decoded) -> list[str]:
    """Say in plain words what distinguishes a file from an ordinary 8-bit RGB picture."""
    notes = []
    images, (height, width) = file.attributes["oiio:subimages"], file.pixels.shape[:2]
    if isinstance(images, int) and images > 1:
        notes.append(f"first of {images} images in the file used")
    if file.format != "uint8":
        notes.append(f"{file.format} pixels kept at full precision")
    space = file.attributes["jpeg:ColorSpace"] or file.attributes["tiff:ColorSpace"]
    if space:
        notes.append(f"stored as {printable(str(space))}, converted to RGB without its profile")
    if file.display != (width, height):
        shown = " x ".join(str(side) for side in file.display)
        notes.append(f"all stored pixels used, not the display window of {shown}")
    return notes
