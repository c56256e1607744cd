"""What arguments of the command line mean, and which of them make sense. Imports nothing heavy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, cast, get_args

from refine.errors import UserError

CameraKind = Literal["orthographic", "perspective", "collocated"]

LARGEST_COORDINATE = 1e6
"""Positions farther away than this, in surface units, are taken for mistakes."""


def parse_point(option: str, text: str, otherwise: str) -> tuple[float, float, float]:
    """Read `X,Y,Z` in surface units, above the surface.

    Raises:
        UserError: text of another form, or a point that is not in front of the surface.
    """
    try:
        x, y, z = (float(number) for number in text.split(","))
    except ValueError:
        raise UserError(
            f"{option} {text!r} is not a position; give X,Y,Z such as 0.1,-0.2,2.1, {otherwise}."
        ) from None
    if not all(math.isfinite(value) and abs(value) <= LARGEST_COORDINATE for value in (x, y, z)) or z < 1e-3:
        raise UserError(
            f"{option} {text!r} is not in front of the surface; "
            "give X,Y,Z with Z above 0 (the photo's longer side spans -1 to 1)."
        )
    return x, y, z


def parse_camera(text: str) -> tuple[CameraKind, tuple[float, float, float] | None]:
    """Read a camera's kind, or the position of a perspective one.

    Raises:
        UserError: neither.
    """
    if text in get_args(CameraKind):
        return cast(CameraKind, text), None
    return "perspective", parse_point("--camera", text, "or orthographic, perspective or collocated")


def choose(option: str, value: str, known: Sequence[str]) -> None:
    """Check that an option's value is one of those there are.

    Raises:
        UserError: it is not, naming them.
    """
    if value not in known:
        raise UserError(f"{option} {value!r} is unknown; choose one of {', '.join(known)}.")


def require_device(name: str) -> None:
    """Check that a device is there by using it.

    Raises:
        UserError: it is not.
    """
    import torch

    try:
        if torch.device(name).type not in ("cpu", "cuda", "mps", "xpu"):
            raise RuntimeError
        torch.zeros(1, device=name).item()
    except (RuntimeError, AssertionError, NotImplementedError, ImportError):
        raise UserError(f"--device {name!r} is not there on this machine; use --device cpu.") from None


def require_sense(
    photos: Sequence[Path], *, one_surface: bool, light: str, align: bool, lights: Path | None
) -> None:
    """Check that what is said of several photos of one surface is said of such photos.

    Raises:
        UserError: options that do not go together.
    """
    if one_surface and len(photos) < 2:
        raise UserError("--one-surface needs two or more photos; give more, or leave it out.")
    if one_surface and light != "estimated":
        raise UserError("--light is of one photo; give the positions of several in a file with --lights.")
    if not one_surface and (align or lights is not None):
        raise UserError("--align and --lights are for several photos; say --one-surface, too.")
    if align and lights is not None:
        raise UserError("--lights are known of photos in register; leave out --align or --lights.")


def require_batch_sense(
    photos: Sequence[Path],
    *,
    batch: bool,
    out: Path | None,
    engine: str,
    scheduler: str | None,
    workers: int | None,
) -> None:
    """Check what is said of a batch, and that several photos are meant to be one.

    Args:
        photos: as given, folders included.
        batch: whether every photo gets a material of its own, in a folder of its own.
        out: folder of the results.
        engine: `dask` is where a batch runs, not how a photo is refined.
        scheduler: address of a cluster's.
        workers: how many processes.

    Raises:
        UserError: options that do not go together.
    """
    if not batch and (engine == "dask" or scheduler is not None or workers is not None):
        raise UserError("--workers, --scheduler and --engine dask are for batches; give a folder of photos.")
    if batch and out is None and len(photos) > 1:
        raise UserError(
            f"There is more than one photo, {photos[1]} is the second; say --out DIR for a material of each, "
            "or --one-surface if all show one surface."
        )
    if (engine == "dask") != (scheduler is not None):
        raise UserError("--engine dask and --scheduler ADDRESS go together; give both or neither.")
    if scheduler is not None and workers is not None:
        raise UserError("--workers are of this machine, a cluster has its own; leave out --workers.")
