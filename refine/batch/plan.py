"""What a batch consists of and what of it is done, judged by the records of results."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nets.text import parse_json
from refine.errors import UserError
from refine.request import Request

SUFFIXES = (
    *(".jpg", ".jpeg", ".jpe", ".jp2", ".png", ".tif", ".tiff", ".exr", ".hdr", ".bmp", ".webp"),
    *(".heic", ".heif", ".avif", ".dng", ".arw", ".cr2", ".cr3", ".nef", ".orf", ".raf", ".rw2"),
)
"""Ends of names, in lower case, of the files of a folder that are taken for photos, readable or not."""

INDEX, RECORD = "index.html", "batch.json"
"""Files of a batch beside the folders of its results."""


@dataclass(frozen=True)
class Job:
    """One photo of a batch.

    Attributes:
        name: of its folder, and of its entry in the index.
        source: the photo as it was given.
        photo: the same, absolute, for processes that run elsewhere.
        folder: of its result, absolute.
    """

    name: str
    source: str
    photo: Path
    folder: Path

    @property
    def stem(self) -> str:
        """Beginning of the names of its files."""
        return self.photo.stem


def find_photos(paths: Sequence[Path]) -> list[Path]:
    """Return photos as given, and in place of every folder those in it, sorted by name; none twice.

    Folders within a folder, hidden files and files that do not end like photos are passed over.

    Raises:
        UserError: a path does not exist, a folder cannot be read, or holds no photo.
    """
    found: dict[str, Path] = {}
    for path in paths:
        photos = _in_folder(path) if path.is_dir() else [path]
        for photo in photos:
            if not photo.exists():
                raise UserError(f"{photo} does not exist; check the name and the folder.")
            found.setdefault(os.path.abspath(photo), photo)
    return list(found.values())


def _in_folder(folder: Path) -> list[Path]:
    try:
        entries = sorted(folder.iterdir())
    except OSError as error:
        raise UserError(f"The folder {folder} cannot be read ({error.strerror}); check it.") from error
    photos = [
        entry
        for entry in entries
        if entry.suffix.lower() in SUFFIXES and not entry.name.startswith(".") and not entry.is_dir()
    ]
    if not photos:
        raise UserError(f"The folder {folder} holds no photos; give one with JPEG, PNG, TIFF or EXR files.")
    return photos


def plan(photos: Sequence[Path], out: Path) -> list[Job]:
    """Give every photo a folder of its own, `out/<name>`.

    The name is the photo's without its suffix where that is nobody else's; otherwise with it, with its
    folder's name before it, or with a digest of its path after it. Letters that differ in case only are
    taken for one, as some file systems do.
    """
    reserved = [INDEX, RECORD]
    candidates = [
        list(dict.fromkeys([photo.stem, photo.name, f"{photo.absolute().parent.name}_{photo.name}"]))
        for photo in photos
    ]
    claims = Counter(name.casefold() for names in [reserved, *candidates] for name in names)
    root = Path(os.path.abspath(out))
    jobs = []
    for photo, names in zip(photos, candidates, strict=True):
        absolute = Path(os.path.abspath(photo))
        digest = hashlib.sha256(os.fsencode(absolute)).hexdigest()[:8]
        name = next((name for name in names if claims[name.casefold()] == 1), f"{photo.name}-{digest}")
        jobs.append(Job(name, str(photo), absolute, root / name))
    return jobs


def read_record(job: Job) -> dict[str, Any] | None:
    """Return the record of a photo's result; None if there is none."""
    try:
        record = parse_json((job.folder / f"{job.stem}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) else None


def is_finished(job: Job, request: Request, checkpoint: str) -> bool:
    """Whether a photo's result is there: of this photo's bytes, this network's and these settings, complete.

    Args:
        job: the photo.
        request: the settings.
        checkpoint: SHA-256 of the network's file.
    """
    from refine.result import FORMAT, describe_auto_encoders, digest

    record = read_record(job)
    if record is None or record.get("format") != FORMAT or record.get("interrupted"):
        return False
    paths = request.output(job.folder, job.stem).paths()
    expected = {
        "settings": request.settings(),
        "recipe": json.loads(json.dumps(request.steps().as_dict())),
    }
    try:
        return (
            all(record[name] == value for name, value in expected.items())
            and record["checkpoint"]["sha256"] == checkpoint
            and [network["sha256"] for network in record.get("auto_encoders", [])]
            == [network["sha256"] for network in describe_auto_encoders(request.steps())]
            and record["maps"]["files"] == {name: path.name for name, path in paths.items()}
            and all(path.is_file() and path.stat().st_size > 0 for path in paths.values())
            and record["photo"]["sha256"] == digest(job.photo)
            and _is_exported(job, request)
        )
    except (OSError, KeyError, TypeError):
        return False


def _is_exported(job: Job, request: Request) -> bool:
    if not request.export:
        return True
    folder = job.folder / "export"
    try:
        targets = parse_json((folder / f"{job.stem}_export.json").read_text(encoding="utf-8"))["targets"]
        files = [name for target in request.export for name in targets[target]["files"]]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return all((folder / name).is_file() for name in files)
