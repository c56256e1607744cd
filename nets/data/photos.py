"""Scenes of several flash photos of one flat surface, with the flash's positions if known.

Reads the two published layouts of MaterialGAN's scenes (text files, `calib.json`) and `calib_fitted.json`.
Paths only: photos are read by whoever needs their pixels.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Float

from nets.data.images import DataError

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True)
class Scene:
    """Photos of one surface, rectified to it.

    Attributes:
        name: of the folder.
        photos: image files in the order of their names; the photos are sRGB-encoded.
        positions: of camera and flash together, per photo, in surface units (origin at the centre, x right,
            y up, z to the camera; the photo's longer side spans [-1, 1]), or None if unknown.
        measured: whether the positions were measured; False for estimates, which may be badly wrong.
        reliability: what an estimate says of itself, or empty.
    """

    name: str
    photos: tuple[Path, ...]
    positions: Float[np.ndarray, "photos 3"] | None
    measured: bool
    reliability: str = ""


def read_scene(folder: Path) -> Scene:
    """Read a scene's photo list and calibration.

    Args:
        folder: photos named by number (`00.jpg`, ...), and beside them, looked for in this order:
            `camera_pos.txt` and `image_size.txt` (cm; measured), `calib.json` (cm; measured),
            `calib_fitted.json` (the same, estimated), or nothing.

    Returns:
        The scene, with as many positions as photos.

    Raises:
        DataError: no photos; a calibration that cannot be parsed, is of another number of photos, has a
            camera behind the surface, or has its flash apart from its camera.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"{folder} is not a folder")
    photos = tuple(
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in PHOTO_SUFFIXES and path.stem.isdigit()
    )
    if not photos:
        raise DataError(f"{folder} holds no numbered photos")

    reliability = ""
    if (folder / "camera_pos.txt").is_file():
        file = folder / "camera_pos.txt"
        camera, size = _numbers(file), float(_numbers(folder / "image_size.txt").flat[0])
        light = _numbers(folder / "light_pos.txt") if (folder / "light_pos.txt").is_file() else camera
    elif (file := folder / "calib.json").is_file() or (file := folder / "calib_fitted.json").is_file():
        camera, light, size, reliability = _calibration(file)
    else:
        return Scene(folder.name, photos, None, measured=False)

    if camera.shape != (len(photos), 3) or light.shape != camera.shape:
        raise DataError(f"{file} has positions {camera.shape} for {len(photos)} photos")
    if not (np.isfinite(camera).all() and (camera[:, 2] > 0.0).all() and size > 0.0):
        raise DataError(f"{file} has a camera behind the surface or a surface without size")
    if not np.allclose(camera, light, atol=1e-3 * size):
        raise DataError(f"{file} has its flash apart from its camera")
    half = size * _longer_over_width(photos[0]) / 2.0  # the published size is the photo's width
    positions = (camera / half).astype(np.float32)
    return Scene(folder.name, photos, positions, file.name != "calib_fitted.json", reliability)


def _calibration(
    file: Path,
) -> tuple[Float[np.ndarray, "photos 3"], Float[np.ndarray, "photos 3"], float, str]:
    try:
        fields = json.loads(file.read_text(encoding="utf-8"))
        camera = np.asarray(fields["camera_pos"], dtype=np.float64)
        light = np.asarray(fields.get("light_pos", fields["camera_pos"]), dtype=np.float64)
        size = float(np.ravel(fields["im_size"])[0])
        return camera, light, size, str(fields.get("reliability", ""))
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise DataError(f"{file} is not a calibration: {error!r}") from error


def _numbers(file: Path) -> Float[np.ndarray, "rows columns"]:
    try:
        lines = [line for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]
        return np.array([[float(number) for number in line.replace(",", " ").split()] for line in lines])
    except (OSError, ValueError) as error:
        raise DataError(f"{file} is not a table of numbers: {error}") from error


def _longer_over_width(photo: Path) -> float:
    source = oiio.ImageInput.open(str(photo))
    if source is None:
        raise DataError(f"{photo} is not a readable image")
    spec = source.spec()
    source.close()
    return max(spec.width, spec.height) / float(spec.width)
