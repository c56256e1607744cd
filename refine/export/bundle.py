"""What targets are made of: the material to export, pictures with a meaning, and the files of a target.

Targets are pure: they return what their files hold. Encoding and writing, all or nothing, is done here.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from nets.color import linear_to_srgb
from nets.svbrdf import SVBRDF
from refine.export.shading import layered_base_color, split_specular
from refine.files import write_together
from refine.maps import MapFormat, write_image


@dataclass(frozen=True)
class Picture:
    """An image and what its numbers mean.

    Attributes:
        pixels: linear colours, or data as they are stored.
        color: whether integer files encode it with the sRGB curve.
    """

    pixels: Float[Tensor, "1 channels height width"]
    color: bool = False


Content = Picture | str | bytes


@dataclass(frozen=True)
class Bundle:
    """The files of one target.

    Attributes:
        files: by name; pictures may be shared between targets.
        notes: what is worth knowing about them, for the record.
    """

    files: dict[str, Content]
    notes: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Texture:
    """One input of a shading model as a picture of the material."""

    pixels: Callable[[SVBRDF], Tensor]
    color: bool = False


TEXTURES: dict[str, Texture] = {
    "base_color": Texture(layered_base_color, color=True),
    "diffuse": Texture(lambda svbrdf: svbrdf.diffuse, color=True),
    "specular": Texture(lambda svbrdf: svbrdf.specular, color=True),
    "specular_tint": Texture(lambda svbrdf: split_specular(svbrdf.specular).tint, color=True),
    "specular_level": Texture(lambda svbrdf: split_specular(svbrdf.specular).level),
    "roughness": Texture(lambda svbrdf: svbrdf.roughness),
    "normal": Texture(lambda svbrdf: svbrdf.normal * 0.5 + 0.5),
    "normal_directx": Texture(
        lambda svbrdf: svbrdf.normal * svbrdf.normal.new_tensor([0.5, -0.5, 0.5])[:, None, None] + 0.5
    ),
}
"""Pictures that targets share, by name: `<stem>_<name>`."""


@dataclass(frozen=True)
class Source:
    """What is exported.

    Attributes:
        svbrdf: one material.
        stem: beginning of every file name.
        format: of pictures that are files of their own.
        repeats: whether opposite borders match.
    """

    svbrdf: SVBRDF
    stem: str
    format: MapFormat = field(default_factory=MapFormat)
    repeats: bool = False

    def file(self, name: str) -> str:
        """Return the file name of a picture."""
        return f"{self.stem}_{name}.{self.format.extension}"

    def textures(self, *names: str) -> dict[str, Content]:
        """Return pictures of `TEXTURES` by file name."""
        return {
            self.file(name): Picture(TEXTURES[name].pixels(self.svbrdf), TEXTURES[name].color)
            for name in names
        }

    @property
    def identifier(self) -> str:
        """The stem as a name that every format accepts."""
        return re.sub(r"\W", "_", f"_{self.stem}" if self.stem[:1].isdigit() else self.stem, flags=re.ASCII)

    @property
    def half_size(self) -> tuple[float, float]:
        """Half the width and half the height of the surface; the longer one is 1."""
        height, width = self.svbrdf.size
        return width / max(height, width), height / max(height, width)


def encode(picture: Picture, format: MapFormat) -> Float[np.ndarray, "height width channels"]:
    """Return pixels as they are stored, before quantisation."""
    pixels = picture.pixels.detach().cpu().float()
    if not format.linear:
        pixels = pixels.clamp(0.0, 1.0)
        if picture.color:
            pixels = linear_to_srgb(pixels)
    return np.ascontiguousarray(pixels[0].movedim(0, -1).numpy())


def color_space(picture: Picture, format: MapFormat) -> str:
    """Return the colour interop identifier of a picture's file."""
    if not picture.color:
        return "data"
    return "lin_rec709_scene" if format.linear else "srgb_rec709_scene"


def png_bytes(picture: Picture) -> bytes:
    """Return a picture as an 8-bit PNG."""
    format = MapFormat("png", 8)
    with tempfile.TemporaryDirectory(prefix="refine-") as folder:
        path = Path(folder) / "picture.png"
        write_image(path, path, encode(picture, format), color_space(picture, format), format)
        return path.read_bytes()


def write_files(folder: Path, files: dict[str, Content], format: MapFormat) -> list[Path]:
    """Write files into a folder, all or none; what is there under their names is replaced.

    Raises:
        UserError: as `refine.files.write_together`.
    """
    paths = [folder / name for name in files]
    with write_together(paths) as temporaries:
        for temporary, path, content in zip(temporaries, paths, files.values(), strict=True):
            if isinstance(content, Picture):
                write_image(temporary, path, encode(content, format), color_space(content, format), format)
            elif isinstance(content, str):
                temporary.write_text(content, encoding="utf-8", newline="\n")
            else:
                temporary.write_bytes(content)
    return paths


def merge(bundles: Iterable[Bundle]) -> dict[str, Content]:
    """Return the files of several targets; those of one name are the same picture."""
    files: dict[str, Content] = {}
    for bundle in bundles:
        files |= bundle.files
    return files
