"""What refinement works on: one linear photo of one surface, what is known of its light and camera."""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxtyping import Bool, Float
from torch import Tensor

from nets.render import Camera, PointLight


@dataclass(frozen=True)
class Capture:
    """One flash photo, ready to be explained.

    Attributes:
        photo: linear radiance, clipped at 1.
        unsaturated: where the photo is not clipped; elsewhere it only says "at least 1".
        camera: sees the surface.
        light: if it is known; None to have it estimated.
        notes: what was done to the photo on the way here, in plain words.
        source: file name of the photo, or `array`.
    """

    photo: Float[Tensor, "1 3 h w"]
    unsaturated: Bool[Tensor, "1 1 h w"]
    camera: Camera = field(default_factory=Camera)
    light: PointLight | None = None
    notes: tuple[str, ...] = ()
    source: str = "array"
