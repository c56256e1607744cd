"""Test sets as named scenes: a true material, the photo a method is given, and the novel lights.

The protocol is the paper's (Sec. 6.1, Table 1): one photo under a centred light in, renderings under
twenty novel lights compared. Scoring is `metrics.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from nets.data.images import DataError, resize, unit_normal
from nets.data.pbr import read_pbr_folder
from nets.data.strips import read_strip
from nets.render import AUTHORS_CAMERA, Camera, PointLight, render
from nets.sampling import YARDSTICK_LIGHTS
from nets.svbrdf import SVBRDF

INPUT_LIGHT = AUTHORS_CAMERA
"""Where the light of the photo is: centred, at the camera, as a phone's flash. White, no falloff."""

CAMERA = Camera()
"""The camera of photo and novel renderings: perspective at (0, 0, 2.14)."""

NOVEL_LIGHTS = 20
"""Test renderings per scene (paper Sec. 6.1)."""

SIZE = 256
"""Pixels of a scene's side."""

Skip = Callable[[str, DataError], None]
"""Called with the name of a scene that cannot be read, and why."""


@dataclass(frozen=True)
class Scene:
    """One test case.

    Attributes:
        name: of the file or folder, without suffix.
        truth: the true material, a batch of one, square.
        photo: what a method is given, linear, in [0, 1] (clamped as a camera would).
        photo_light: the light of the photo if it is known; None for a photo stored with the data.
        lights: the novel lights, the same for every method.
    """

    name: str
    truth: SVBRDF
    photo: Float[Tensor, "1 3 size size"]
    photo_light: PointLight | None
    lights: PointLight


@dataclass(frozen=True)
class Protocol:
    """How scenes are made from materials; a value that is printed with every table.

    Attributes:
        size: pixels of the square maps and renderings.
        lights: novel lights per scene; fewer are the first of the twenty.
        seed: of the novel lights.
        stored_input: use the photo stored in a strip, where there is one, instead of rendering it.
            Des18's are linear, as their maps are: about 1.2 times our rendering of them, light unknown.
    """

    size: int = SIZE
    lights: int = NOVEL_LIGHTS
    seed: int = 0
    stored_input: bool = False


YARDSTICK = Protocol()
"""The protocol of all figures of this project."""


def novel_lights(index: int, count: int = NOVEL_LIGHTS, seed: int = 0) -> PointLight:
    """Return the novel lights of the scene at `index` of its test set.

    Args:
        index: in the sorted list of the whole set, so that a subset of scenes keeps its lights.
        count: at most that of the protocol gives a prefix of the same lights.
        seed: of the evaluation.
    """
    generator = torch.Generator().manual_seed(1_000_003 * seed + index)
    return YARDSTICK_LIGHTS.sample(max(count, NOVEL_LIGHTS), generator)[:count]


def spread(total: int, count: int | None) -> list[int]:
    """Return `count` indices spread evenly over `range(total)`, all of them if None or if there are fewer."""
    if count is None or count >= total:
        return list(range(total))
    return [(2 * i + 1) * total // (2 * count) for i in range(count)]


def strip_scenes(
    folder: Path, protocol: Protocol = YARDSTICK, count: int | None = None, skip: Skip | None = None
) -> Iterator[Scene]:
    """Read the strips of a folder as scenes, in the order of their names.

    Args:
        folder: holds `.png` strips, maps linear.
        protocol: size, lights and input.
        count: so many scenes, spread evenly.
        skip: called for a file that is not a strip; without it such a file raises.

    Yields:
        Scenes, read one at a time.

    Raises:
        DataError: if the folder is missing or holds no strips, or for an unreadable strip without `skip`.
    """
    yield from _scenes(folder, "strips", protocol, count, skip)


def pbr_scenes(
    folder: Path, protocol: Protocol = YARDSTICK, count: int | None = None, skip: Skip | None = None
) -> Iterator[Scene]:
    """Read the PBR folders of a folder as scenes; arguments and errors as `strip_scenes`."""
    yield from _scenes(folder, "pbr", protocol, count, skip)


def list_scenes(folder: Path, kind: Literal["strips", "pbr"]) -> list[Path]:
    """Return the files or folders of a test set, sorted by name.

    Raises:
        DataError: if the folder is missing or holds none.
    """
    if not folder.is_dir():
        raise DataError(f"{folder} is not a folder")
    entries = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    found = [p for p in entries if (p.is_dir() if kind == "pbr" else p.suffix.lower() == ".png")]
    if not found:
        raise DataError(f"{folder} holds no {'folders of maps' if kind == 'pbr' else 'strips (.png)'}")
    return found


def read_scene(path: Path, kind: Literal["strips", "pbr"], index: int, protocol: Protocol) -> Scene:
    """Read one entry of a test set, as `list_scenes` lists them, as the scene of that index.

    Raises:
        DataError: it cannot be read.
    """
    if kind == "pbr":
        return make_scene(path.name, read_pbr_folder(path), index, protocol)
    strip = read_strip(path)
    return make_scene(path.stem, strip.svbrdf, index, protocol, strip.input)


def make_scene(
    name: str, svbrdf: SVBRDF, index: int, protocol: Protocol, stored: Tensor | None = None
) -> Scene:
    """Make a scene of a material: cut square, resized, photographed, with the lights of its index.

    Args:
        name: of the scene.
        svbrdf: a batch of one, of any size.
        index: in its test set.
        protocol: size, lights and input.
        stored: a photo `[1, 3, h, w]`, linear, which the protocol may prefer to a rendering.
    """
    resized = svbrdf.map(lambda tensor: to_square(tensor, protocol.size))
    truth = SVBRDF(unit_normal(resized.normal), resized.diffuse, resized.roughness, resized.specular)
    light: PointLight | None
    if protocol.stored_input and stored is not None:
        photo, light = to_square(stored, protocol.size), None
    else:
        photo, light = input_photo(truth)
    return Scene(name, truth, photo, light, novel_lights(index, protocol.lights, protocol.seed))


def input_photo(
    truth: SVBRDF, position: tuple[float, float, float] = INPUT_LIGHT
) -> tuple[Float[Tensor, "1 3 h w"], PointLight]:
    """Render the photo a method is given, linear, clamped to 1, and return it with its light."""
    light = PointLight.at(position)
    return render(truth, light, CAMERA).clamp(0.0, 1.0), light


def to_square(image: Float[Tensor, "1 channels h w"], size: int) -> Float[Tensor, "1 channels size size"]:
    """Crop the central square and resize it by area averages."""
    height, width = image.shape[-2:]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    return resize(image[..., top : top + side, left : left + side], size, size)


def _scenes(
    folder: Path, kind: Literal["strips", "pbr"], protocol: Protocol, count: int | None, skip: Skip | None
) -> Iterator[Scene]:
    paths = list_scenes(folder, kind)
    for index in spread(len(paths), count):
        try:
            scene = read_scene(paths[index], kind, index, protocol)
        except DataError as error:
            if skip is None:
                raise
            skip(paths[index].stem, error)
            continue
        yield scene
