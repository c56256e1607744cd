"""What `refine` wrote as frames under other lights: rendered by `nets.render`, encoded as sRGB."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import UInt8

from nets.color import linear_to_srgb
from nets.render import Camera, PointLight, render
from nets.svbrdf import SVBRDF
from refine.errors import UserError
from refine.export.source import Result, read_result
from refine.shrinking import shrink, within
from refine.video.paths import Point


@dataclass(frozen=True)
class Scene:
    """A material and how it is seen and lit.

    Attributes:
        svbrdf: maps of the frames' size.
        camera: it stands still, so one that was at the flash is where the authors' is.
        intensity: of the light, linear RGB.
        falloff: of the light.
    """

    svbrdf: SVBRDF
    camera: Camera
    intensity: Point
    falloff: Literal["none", "inverse_square"]


def read_scene(
    folder: Path, name: str | None, size: int, falloff: Literal["none", "inverse_square"] | None = None
) -> tuple[str, Scene]:
    """Read a result as a scene.

    Args:
        folder: that `refine` wrote.
        name: which result, where there are several.
        size: longer side of the frames, pixels; maps that are smaller stay as they are, 0 keeps theirs.
        falloff: of the light; None is that of the result's.

    Returns:
        The result's name, and the scene.

    Raises:
        UserError: there is no such result, or it is damaged.
    """
    result = read_result(folder, name)
    longest = size or max(result.svbrdf.size)
    camera, intensity, known = _seen_and_lit(folder, result)
    svbrdf = shrink(result.svbrdf, *within(result.svbrdf.size, longest))
    return result.stem, Scene(svbrdf, camera, intensity, falloff or known)


def relit_frames(
    scene: Scene, positions: Iterable[Point], exposure: float = 0.0
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield the scene under a light at each position, sRGB-encoded, clipped at 1.

    Args:
        scene: what is rendered.
        positions: of the light, surface units.
        exposure: in stops: 1 is twice as bright.
    """
    red, green, blue = (value * 2.0**exposure for value in scene.intensity)
    for position in positions:
        light = PointLight.at(position, (red, green, blue), scene.falloff)
        with torch.inference_mode():
            encoded = linear_to_srgb(render(scene.svbrdf, light, scene.camera).clamp(0.0, 1.0))
            pixels = (encoded[0].permute(1, 2, 0) * 255.0).round().to(torch.uint8)
        yield np.ascontiguousarray(pixels.numpy())


def _seen_and_lit(folder: Path, result: Result) -> tuple[Camera, Point, Literal["none", "inverse_square"]]:
    light, camera = result.record.get("light"), result.record.get("camera")
    try:
        red, green, blue = (float(value) for value in light["intensity"])  # type: ignore[index]
        x, y, z = (float(value) for value in camera["position"])  # type: ignore[index]
        kind, falloff = camera["kind"], light["falloff"]  # type: ignore[index]
        if kind not in ("perspective", "orthographic", "collocated"):
            raise ValueError(kind)
        if falloff not in ("none", "inverse_square") or not np.isfinite([red, green, blue, x, y, z]).all():
            raise ValueError(falloff)
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{folder / result.stem}.json does not say how its photo was lit and seen; run refine again."
        ) from error
    return Camera() if kind == "collocated" else Camera(kind, (x, y, z)), (red, green, blue), falloff
