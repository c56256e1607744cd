"""Real surfaces in several flash photos: one photo is given, the others are kept to compare with.

Scenes are MaterialGAN's, as `nets.data.photos` reads them: camera and flash together, at known places.
Scoring is `real.py`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
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

LARGEST_RESIDUAL = 0.05
"""RMSE, encoded with 1/2.2, by which one material may miss all photos if their lights are believed."""


@dataclass(frozen=True)
class SceneLights:
    """The lights of one scene's photos, in their order; found by `eval.scene_lights`.

    Attributes:
        positions: surface units.
        intensities: radiance of a white patch at the surface's centre, geometric mean 1; they hold both the
            flash's distance and the photo's exposure.
        measured: whether the positions were.
        residual: RMSE between the photos and re-renderings of one material refined from all of them.
    """

    positions: list[list[float]]
    intensities: list[float]
    measured: bool
    residual: float

    @property
    def believable(self) -> bool:
        """Whether one material explains all photos under these lights."""
        return self.residual <= LARGEST_RESIDUAL


def read_scene_lights(path: Path) -> dict[str, SceneLights]:
    """Read the file of `eval.scene_lights`, by name of the scene.

    Raises:
        DataError: the file is missing or holds something else.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return {name: SceneLights(**lights) for name, lights in content["scenes"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path} cannot be read as lights of scenes ({error})") from None


@dataclass(frozen=True)
class RealScene:
    """One surface: the photo that is given, and those that are not.

    Attributes:
        name: of the folder.
        lights_are: how well the positions are known.
        photo: what a method is given, linear.
        light: of that photo, white, intensity 1, with inverse-square falloff.
        held_out: the other photos, linear, in [0, 1].
        held_out_lights: theirs. Unless exposures are known, the flash is as strong as for the given photo, so
            that the patch centre gets brighter with the inverse square of its distance.
    """

    name: str
    lights_are: Lights
    photo: Photo
    light: PointLight
    held_out: Float[Tensor, "photos 3 h w"]
    held_out_lights: PointLight


def read_real_scene(folder: Path, size: int, lights: SceneLights | None = None) -> RealScene:
    """Read a scene of several photos and choose the one whose light is most central to be given.

    Args:
        folder: as `nets.data.photos.read_scene` takes it.
        size: longer side of the photos, pixels.
        lights: of its photos, in place of what the folder says.

    Raises:
        DataError: as there; or the lights are unknown, there is one photo only, one cannot be read, or they
            are of several sizes.
    """
    scene = read_scene(folder)
    if lights is not None:
        if len(lights.positions) != len(scene.photos):
            raise DataError(f"{folder} holds {len(scene.photos)} photos, not {len(lights.positions)}")
        scene = replace(
            scene,
            positions=np.array(lights.positions, dtype=np.float32),
            measured=lights.measured,
            reliability=RELIABLE if lights.believable else "residual",
        )
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
    places = scene.positions
    central = int(np.argmax(places[:, 2] / np.linalg.norm(places, axis=1)))
    positions = torch.from_numpy(places)
    distances = torch.linalg.vector_norm(positions, dim=1, keepdim=True)
    intensities = (distances[central] / distances) ** 2
    if lights is not None:
        intensities = torch.tensor(lights.intensities)[:, None] / lights.intensities[central]
    intensities = intensities.expand(-1, 3)
    others = torch.arange(len(photos)) != central
    estimated: Lights = "estimated" if scene.reliability == RELIABLE else "uncertain"
    return RealScene(
        scene.name,
        "measured" if scene.measured and (lights is None or lights.believable) else estimated,
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
    folder: Path,
    size: int,
    scenes: int | None,
    skipped: dict[str, str],
    lights: Mapping[str, SceneLights] | None = None,
) -> Iterator[RealScene]:
    """Read the scenes of a folder one after the other.

    Args:
        folder: holds one folder per scene.
        size: longer side of the photos, pixels.
        scenes: so many, evenly spread; all if None.
        skipped: gains the name of a scene that cannot be used, and why.
        lights: by scene; a scene that is not among them has those its folder says.

    Raises:
        DataError: the folder is missing or holds no folders.
    """
    paths = list_real_scenes(folder)
    for index in spread(len(paths), scenes):
        try:
            scene = read_real_scene(paths[index], size, (lights or {}).get(paths[index].name))
        except DataError as error:
            skipped[paths[index].name] = str(error)
            continue
        yield scene
