"""Material maps on disk: names, encodings and formats of the files one material is written to and read from.

The names are a contract: `<stem>_normal`, `<stem>_diffuse`, `<stem>_specular`, `<stem>_roughness` and
`<stem>_rendering`. Diffuse, specular and rendering are sRGB-encoded in integer files and linear in float
files; roughness and normals, as (n + 1) / 2, are stored raw in every format.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import OpenImageIO as oiio
import torch
from jaxtyping import Float, Float32
from torch import Tensor
from torch.nn.functional import normalize

from nets.color import linear_to_srgb, srgb_to_linear
from nets.svbrdf import CHANNELS, SVBRDF
from refine.errors import UserError
from refine.files import DecodedImage, decode_image, write_together

MAP_NAMES = ("normal", "diffuse", "specular", "roughness")
"""The maps of a material, as its files are named."""

RENDERING = "rendering"
"""Name of the photo re-rendered from the maps, written beside them."""

SMALLEST_ROUGHNESS = 1.0 / 65535.0
"""What a roughness of 0 in a file is read as: the smallest positive 16-bit value."""

NormalConvention = Literal["opengl", "directx"]
"""Which way the green channel of a normal file points: up (OpenGL, as in memory) or down (DirectX)."""

_STORAGE = {  # extension, bits -> OpenImageIO pixel type
    ("png", 8): "uint8",
    ("png", 16): "uint16",
    ("tif", 8): "uint8",
    ("tif", 16): "uint16",
    ("tif", 32): "float",
    ("exr", 16): "half",
    ("exr", 32): "float",
}
_EXTENSIONS = ("png", "exr", "tif")
_COLORS = ("diffuse", "specular", RENDERING)


@dataclass(frozen=True)
class MapFormat:
    """File format of the maps.

    Attributes:
        extension: "png" (8 or 16 bits), "tif" (8, 16, or 32 for float) or "exr" (16 for half, 32 for float).
        bits: bits per channel.

    Raises:
        UserError: on construction, when the format does not have that many bits.
    """

    extension: Literal["png", "exr", "tif"] = "png"
    bits: Literal[8, 16, 32] = 16

    def __post_init__(self) -> None:
        """Refuse combinations that do not exist."""
        if (self.extension, self.bits) not in _STORAGE:
            known = ", ".join(f"{extension} {bits}" for extension, bits in _STORAGE)
            raise UserError(
                f"There is no {self.bits}-bit {self.extension} map format; choose one of {known}."
            )

    @property
    def linear(self) -> bool:
        """Whether colours are stored as linear floats instead of sRGB-encoded integers."""
        return _STORAGE[self.extension, self.bits] in ("half", "float")


def map_paths(
    folder: Path | str, stem: str, *, rendering: bool = True, format: MapFormat | None = None
) -> dict[str, Path]:
    """Paths of the files of one material, keyed by map name (and "rendering")."""
    extension = (format or MapFormat()).extension
    names = (*MAP_NAMES, RENDERING) if rendering else MAP_NAMES
    return {name: Path(folder) / f"{stem}_{name}.{extension}" for name in names}


def write_maps(
    folder: Path | str,
    stem: str,
    svbrdf: SVBRDF,
    *,
    rendering: Float[Tensor, "1 3 h w"] | None = None,
    format: MapFormat | None = None,
    normal_convention: NormalConvention = "opengl",
) -> dict[str, Path]:
    """Write one material, all of its files or none; the same material gives the same bytes.

    Args:
        folder: created if missing.
        stem: beginning of every file name.
        svbrdf: one material (a batch of one).
        rendering: linear light; clamped to 1 in integer formats.
        format: 16-bit PNG unless said otherwise.
        normal_convention: "directx" flips the green channel of the normal file.

    Returns:
        The path of every file, keyed by map name (and "rendering").

    Raises:
        UserError: a file cannot be written.
        ValueError: the material or the rendering is not legal (see `SVBRDF.validate`).
    """
    format = format or MapFormat()
    if svbrdf.validate().batch != 1:
        raise ValueError(f"expected one material, got a batch of {svbrdf.batch}")
    tensors = {name: getattr(svbrdf, name) for name in MAP_NAMES}
    tensors["normal"] = _with_convention(svbrdf.normal, normal_convention) * 0.5 + 0.5
    if rendering is not None:
        if tuple(rendering.shape) != tuple(svbrdf.diffuse.shape) or not bool(torch.isfinite(rendering).all()):
            shape = tuple(svbrdf.diffuse.shape)
            raise ValueError(f"rendering must be finite and shaped {shape}, got {tuple(rendering.shape)}")
        tensors[RENDERING] = rendering
    paths = map_paths(folder, stem, rendering=rendering is not None, format=format)
    with write_together(list(paths.values())) as temporaries:
        for (name, path), temporary in zip(paths.items(), temporaries, strict=True):
            write_image(
                temporary, path, _encode(name, tensors[name], format), _color_space(name, format), format
            )
    return paths


def read_maps(
    folder: Path | str,
    stem: str,
    *,
    normal_convention: NormalConvention = "opengl",
    extension: Literal["png", "exr", "tif"] | None = None,
) -> SVBRDF:
    """Read the four maps `write_maps` wrote, from integer (sRGB colours) or float (linear) files.

    Args:
        folder: where the files are.
        stem: beginning of every file name.
        normal_convention: what the normal file holds; memory is always OpenGL.
        extension: needed only when the folder holds the material in several formats.

    Raises:
        UserError: a file is missing, present in several formats, cannot be decoded (see
            `decode_image`), has another size than its siblings, or holds no legal map.
    """
    maps = {}
    for name in MAP_NAMES:
        path = _find(Path(folder), f"{stem}_{name}", extension)
        decoded = decode_image(path)
        maps[name] = _decode(name, path, decoded)
        if maps[name].shape[-2:] != maps["normal"].shape[-2:]:
            height, width = maps["normal"].shape[-2:]
            raise UserError(
                f"{path} has another size than the normal map ({width} x {height}); resize one of them."
            )
    maps["normal"] = _with_convention(maps["normal"], normal_convention)
    try:
        return SVBRDF(**maps).validate()
    except ValueError as error:
        raise UserError(f"The maps {stem!r} in {folder} are not a legal material: {error}.") from error


def _with_convention(normal: Float[Tensor, "batch 3 h w"], convention: str) -> Float[Tensor, "batch 3 h w"]:
    """Convert normals between OpenGL, as in memory, and `convention`; its own inverse."""
    if convention not in ("opengl", "directx"):
        raise UserError(f"Normal convention {convention!r} is unknown; choose opengl or directx.")
    if convention == "opengl":
        return normal
    return normal * torch.tensor([1.0, -1.0, 1.0], dtype=normal.dtype, device=normal.device)[:, None, None]


def _encode(
    name: str, tensor: Float[Tensor, "1 channels h w"], format: MapFormat
) -> Float32[np.ndarray, "h w channels"]:
    """Values as they are stored, before quantisation."""
    tensor = tensor.detach().cpu().float()
    if name in _COLORS:
        tensor = tensor.clamp(min=0.0)
        if not format.linear:
            tensor = linear_to_srgb(tensor.clamp(max=1.0))
    return np.ascontiguousarray(tensor[0].permute(1, 2, 0).numpy())


def _decode(name: str, path: Path, decoded: DecodedImage) -> Float[Tensor, "1 channels h w"]:
    """Invert `_encode` and the quantisation, as far as that goes."""
    channels = CHANNELS[name]
    found = decoded.stored.shape[-1]
    if found < channels:
        raise UserError(f"{path} has {found} channel(s), but a {name} map has {channels}; export it again.")
    stored = torch.from_numpy(np.ascontiguousarray(decoded.pixels[..., :channels].transpose(2, 0, 1)))[None]
    if name == "normal":
        vectors = stored * 2.0 - 1.0
        return normalize(torch.cat([vectors[:, :2], vectors[:, 2:].clamp(min=0.0)], dim=1), dim=1)
    if name == "roughness":
        return torch.where(stored == 0.0, SMALLEST_ROUGHNESS, stored)
    return srgb_to_linear(stored) if decoded.integer else stored


def _color_space(name: str, format: MapFormat) -> str:
    """Colour interop identifier of a map, as OpenImageIO names it; "data" is not a colour."""
    if name not in _COLORS:
        return "data"
    return "lin_rec709_scene" if format.linear else "srgb_rec709_scene"


def write_image(
    temporary: Path,
    path: Path,
    pixels: Float32[np.ndarray, "h w channels"],
    color_space: str,
    format: MapFormat,
) -> None:
    """Write one image to `temporary`, and decode it again, since not every encoder notices a full disk.

    Args:
        temporary: of `write_together`.
        path: what it will be called.
        pixels: 1, 3 or 4 channels, as they are to be stored, 1 being an integer format's maximum.
        color_space: a colour interop identifier, or "data".
        format: of the file.

    Raises:
        UserError: it could not be written; the message names `path`.
    """
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, _STORAGE[format.extension, format.bits])
    spec.channelnames = ("Y",) if channels == 1 else ("R", "G", "B", "A")[:channels]
    spec.attribute("oiio:ColorSpace", color_space)
    if channels == 4:
        spec.attribute("oiio:UnassociatedAlpha", 1)  # or the others would be divided by it
    spec.attribute("DateTime", "")  # the time of writing would make every file differ
    spec.attribute("compression", "zip")
    output = oiio.ImageOutput.create(str(temporary))
    if output is None:
        raise RuntimeError(f"OpenImageIO was built without {format.extension}: {oiio.geterror()}")
    written = output.open(str(temporary), spec) and output.write_image(pixels)
    if not (output.close() and written):
        reason = output.geterror().strip() or "unknown reason"
        raise UserError(f"Cannot write {path}: {reason}; choose another folder or make room there.")
    try:
        decode_image(temporary)
    except UserError as error:
        raise UserError(
            f"Cannot write {path} completely; choose another folder or make room there."
        ) from error


def _find(folder: Path, name: str, extension: str | None) -> Path:
    """The one file of that name, whatever its format."""
    extensions = _EXTENSIONS if extension is None else (extension,)
    found = [path for path in (folder / f"{name}.{candidate}" for candidate in extensions) if path.exists()]
    if not found:
        raise UserError(
            f"There is no {name}.({'|'.join(extensions)}) in {folder}; check the folder and the stem."
        )
    if len(found) > 1:
        listed = " and ".join(path.name for path in found)
        raise UserError(f"{folder} holds {listed}; say which extension to read, or remove one.")
    return found[0]
