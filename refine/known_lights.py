"""Where the flash was, from a file: positions for several photos of one surface.

Two forms are read. A JSON file `{"positions": [[x, y, z], ...]}` has one position per photo, in the photos'
order and in surface units: origin at the surface's centre, x right, y up, z to the viewer; the photos' longer
side spans -1 to 1. A folder is one of MaterialGAN's scenes (`nets.data.photos`): it knows photos by name.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from nets.data.images import DataError
from nets.data.photos import read_scene
from nets.render import PointLight
from nets.text import parse_json
from refine.errors import UserError


def read_lights(
    source: Path, photos: Sequence[Path], falloff: Literal["none", "inverse_square"]
) -> PointLight:
    """Read one light per photo.

    Args:
        source: file or folder, as above.
        photos: files; of a scene's folder some, in any order.
        falloff: of the lights.

    Returns:
        White lights of intensity 1, as a batch.

    Raises:
        UserError: no such file, of another form, another number of positions, or one behind the surface.
    """
    positions = _of_scene(source, photos) if source.is_dir() else _of_file(source)
    if positions.shape != (len(photos), 3):
        raise UserError(
            f"{source} has positions of shape {positions.shape} for {len(photos)} photos; "
            "give one x, y, z per photo."
        )
    if not (np.isfinite(positions).all() and (positions[:, 2] > 0.0).all()):
        raise UserError(f"{source} has a light that is not in front of the surface; give z above 0.")
    return PointLight(torch.from_numpy(positions).float(), torch.ones(len(photos), 3), falloff)


def _of_file(source: Path) -> np.ndarray:  # [photos, 3]
    try:
        positions = parse_json(source.read_text(encoding="utf-8"))["positions"]
        return np.array(positions, dtype=np.float64)
    except OSError as error:
        raise UserError(f"{source} cannot be read: {error.strerror}; give a JSON file or a folder.") from None
    except (ValueError, KeyError, TypeError, OverflowError):
        raise UserError(
            f'{source} does not hold lights; write {{"positions": [[x, y, z], ...]}}, one per photo.'
        ) from None


def _of_scene(source: Path, photos: Sequence[Path]) -> np.ndarray:  # [photos, 3]
    try:
        scene = read_scene(source)
    except DataError as error:
        raise UserError(f"{error}; give a JSON file, or the folder of a scene.") from None
    if scene.positions is None:
        raise UserError(
            f"{source} does not say where its lights were; leave out --lights to have them found."
        )
    known = {path.resolve(): position for path, position in zip(scene.photos, scene.positions, strict=True)}
    for photo in photos:
        if photo.resolve() not in known:
            raise UserError(f"{source} knows no light of {photo}; give its own photos only.")
    return np.array([known[photo.resolve()] for photo in photos], dtype=np.float64)
