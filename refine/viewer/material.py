"""One result as plain data for the page: pictures of its maps and what is known of it.

Every map is a PNG of 8 bits whose upper half holds the high bytes of 16-bit values and whose lower half the
low ones. Browsers decode 16-bit PNG to 8 bits; two 8-bit pictures come through exactly, in core WebGL2.
"""

from __future__ import annotations

import base64
import hashlib
import math
import tempfile
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nets.color import linear_to_srgb
from refine.errors import UserError
from refine.export.source import Result, read_result
from refine.maps import MAP_NAMES, MapFormat, write_image
from refine.photo import ColorSpaceChoice, read_photo, resize_photo
from refine.shrinking import shrink, within

LONGEST_SIDE = 1024
"""Longer side of the maps in a page, in pixels: 28 MB of text at most for the maps of a material."""


def describe_material(folder: Path, stem: str) -> dict[str, Any]:
    """Return what the page needs of a result, as values that JSON can hold.

    Raises:
        UserError: the result cannot be read, or its record is damaged.
    """
    result = read_result(folder, stem)
    svbrdf = shrink(result.svbrdf, *within(result.svbrdf.size, LONGEST_SIDE))
    height, width = svbrdf.size
    try:
        light, camera, record = result.record["light"], result.record["camera"], result.record
        described = {
            "name": result.stem,
            "width": width,
            "height": height,
            "size": list(result.svbrdf.size[::-1]),
            "light": {
                "position": _numbers(light["position"]),
                "intensity": _numbers(light["intensity"]),
                "falloff": _one_of(light["falloff"], ("none", "inverse_square")),
            },
            "camera": {
                "kind": _one_of(camera["kind"], ("orthographic", "perspective", "collocated")),
                "position": _numbers(camera["position"]),
            },
            "recipe": str(record["recipe"]["name"]),
            "source": str(record["photo"]["source"]),
            "rmse": _numbers([record["rmse"][name] for name in ("initialization", "refined")], 2),
        }
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise UserError(
            f"{folder / stem}.json does not say how its photo was lit and seen; run refine on it again."
        ) from error
    described["maps"] = {name: _split_png(_encoded(name, getattr(svbrdf, name))) for name in MAP_NAMES}
    photo = _photo(folder, result)
    described["photo"] = None if photo is None else _png(photo)
    return described


def _numbers(values: Any, count: int = 3) -> list[float]:
    numbers = [float(value) for value in values]
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"{values} are not {count} numbers")
    return numbers


def _one_of(value: Any, known: tuple[str, ...]) -> str:
    if value not in known:
        raise ValueError(f"{value!r} is unknown")
    return str(value)


def _encoded(name: str, tensor: Tensor) -> Float[np.ndarray, "h w channels"]:
    """Values in [0, 1] as 16-bit map files hold them (C41, C43)."""
    if name == "normal":
        tensor = tensor * 0.5 + 0.5
    elif name != "roughness":
        tensor = linear_to_srgb(tensor.clamp(0.0, 1.0))
    return tensor[0].permute(1, 2, 0).double().numpy()


def _split_png(values: Float[np.ndarray, "h w channels"]) -> str:
    stored = np.rint(values * 65535.0).astype(np.uint16)
    return _png(np.concatenate([stored >> 8, stored & 255]).astype(np.uint8))


def _png(pixels: UInt8[np.ndarray, "h w channels"]) -> str:
    """Encode 8-bit pixels as a PNG in base64."""
    with tempfile.TemporaryDirectory(prefix="refine-") as folder:
        path = Path(folder) / "picture.png"
        scaled = np.ascontiguousarray(pixels.astype(np.float32) / np.float32(255.0))
        write_image(path, path, scaled, "data", MapFormat("png", 8))
        return base64.b64encode(path.read_bytes()).decode("ascii")


def _photo(folder: Path, result: Result) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return the photo as it was refined, sRGB-encoded; None unless the very same file is still there."""
    known, settings = result.record["photo"], result.record["settings"]
    color_space = settings.get("color_space")
    source, digest = known.get("source"), known.get("sha256")
    if not isinstance(source, str) or digest is None or color_space not in get_args(ColorSpaceChoice):
        return None
    path = _find(folder, Path(source), digest)
    if path is None:
        return None
    try:
        photo = resize_photo(read_photo(path, color_space=color_space), max(result.svbrdf.size))
        if photo.size != result.svbrdf.size:
            return None
        photo = resize_photo(photo, LONGEST_SIDE)
    except UserError:
        return None
    encoded = linear_to_srgb(torch.as_tensor(photo.linear).clamp(0.0, 1.0))
    return np.rint(encoded[0].permute(1, 2, 0).numpy() * 255.0).astype(np.uint8)


def _find(folder: Path, source: Path, digest: str) -> Path | None:
    """The file of that content: where it was, beside the result, or in it."""
    for path in (source, folder.parent / source.name, folder / source.name):
        try:
            if path.is_file():
                with path.open("rb") as file:
                    if hashlib.file_digest(file, "sha256").hexdigest() == digest:
                        return path
        except (OSError, ValueError):
            continue
    return None
