"""Real surfaces in several flash photos: one photo is given, the others are kept to compare with.

Scenes are MaterialGAN's, as `nets.data.photos` reads them: camera and flash together, at known places.
Scoring is `real.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from eval.datasets import spread
from nets.data.images import DataError
from nets.data.photos import read_scene
from nets.render import Camera, PointLight
from refine.errors import UserError
from refine.photo import Photo, read_photo, resize_photo

CAMERA = Camera("collocated")
"""The camera of the photos and their renderings: at the flash."""

RELIABLE = "ok"
"""What an estimated calibration says of itself if its lights can be believed."""

Lights = Literal["measured", "estimated", "uncertain"]
"""How well the flash's positions are known."""


@dataclass(frozen=True)
class RealScene:
    """One surface: the photo that is given, and those that are not.

    Attributes:
        name: of the folder.
        lights_are: how well the positions are known.
        photo: what a method is given, linear.
        light: of that photo, white, intensity 1, with inverse-square falloff.
        held_out: the other photos, linear, in [0, 1].
        held_out_lights: theirs. The flash is as strong as for the given photo, so that the patch centre gets
            brighter with the inverse square of its distance.
    """

    name: str
    lights_are: Lights
    photo: Photo
    light: PointLight
    held_out: Float[Tensor, "photos 3 h w"]
    held_out_lights: PointLight


def read_real_scene(folder: Path, size: int) -> RealScene:
    """Read a scene of several photos and choose the one whose light is most central to be given.

    Args:
        folder: as `nets.data.photos.read_scene` takes it.
        size: longer side of the photos, pixels.

    Raises:
        DataError: as there; or the lights are unknown, there is one photo only, one cannot be read, or they
            are of several sizes.
    """
    scene = read_scene(folder)
    if scene.positions is None:
        raise DataError(f"{folder} does not say where its lights were")
    if len(scene.photos) < 2:
        raise DataError(f"{folder} holds one photo, which leaves none to compare with")
    try:
        photos = [resize_photo(read_photo(path), size) for path in scene.photos]
    except UserError as error:
        raise DataError(str(error)) from None
    if len({photo.size for photo in photos}) > 1:
        raise DataError(f"{folder} holds photos of several sizes")
    central = int(np.argmax(scene.positions[:, 2] / np.linalg.norm(scene.positions, axis=1)))
    positions = torch.from_numpy(scene.positions)
    distances = torch.linalg.vector_norm(positions, dim=1, keepdim=True)
    intensities = ((distances[central] / distances) ** 2).expand(-1, 3)
    others = torch.arange(len(photos)) != central
    estimated: Lights = "estimated" if scene.reliability == RELIABLE else "uncertain"
    return RealScene(
        scene.name,
        "measured" if scene.measured else estimated,
        photos[central],
        PointLight(positions[central : central + 1], torch.ones(1, 3), "inverse_square"),
        torch.cat([photo.linear for photo in photos])[others].clamp(0.0, 1.0),
        PointLight(positions[others], intensities[others], "inverse_square"),
    )


def list_real_scenes(folder: Path) -> list[Path]:
    """Return the folders of scenes in a folder, sorted.

    Raises:
        DataError: it is missing or holds none.
    """
    if not folder.is_dir():
        raise DataError(f"{folder} is not a folder")
    found = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    if not found:
        raise DataError(f"{folder} holds no folders of photos, one per surface")
    return found


def read_real_scenes(
    folder: Path, size: int, scenes: int | None, skipped: dict[str, str]
) -> Iterator[RealScene]:
    """Read the scenes of a folder one after the other.

    Args:
        folder: holds one folder per scene.
        size: longer side of the photos, pixels.
        scenes: so many, evenly spread; all if None.
        skipped: gains the name of a scene that cannot be used, and why.

    Raises:
        DataError: the folder is missing or holds no folders.
    """
    paths = list_real_scenes(folder)
    for index in spread(len(paths), scenes):
        try:
            scene = read_real_scene(paths[index], size)
        except DataError as error:
            skipped[paths[index].name] = str(error)
            continue
        yield scene
