"""A result folder with a material that exercises the shader: steep normals, mirrors, metals, not square."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate, normalize

from nets.color import linear_to_srgb
from nets.svbrdf import SVBRDF
from refine.maps import MapFormat, write_image, write_maps
from refine.result import FORMAT

HEIGHT, WIDTH = 80, 120


class WriteResult(Protocol):
    def __call__(self, folder: Path, stem: str, **record: Any) -> SVBRDF: ...


@pytest.fixture(scope="session")
def svbrdf() -> SVBRDF:
    generator = torch.Generator().manual_seed(7)

    def field(channels: int) -> torch.Tensor:
        coarse = torch.rand(1, channels, 10, 15, generator=generator)
        return interpolate(coarse, size=(HEIGHT, WIDTH), mode="bicubic").clamp(0.0, 1.0)

    slopes = field(2) * 2.0 - 1.0
    return SVBRDF(
        normal=normalize(torch.cat([slopes, torch.ones_like(slopes[:, :1])], dim=1), dim=1),
        diffuse=field(3),
        roughness=field(1).clamp(min=0.02),
        specular=field(3) ** 2,
    )


@pytest.fixture(scope="session")
def write_result(svbrdf: SVBRDF) -> WriteResult:
    """Return what writes a folder as `refine` does, with the record's entries that a viewer needs."""

    def write(folder: Path, stem: str, **record: Any) -> SVBRDF:
        paths = write_maps(folder, stem, svbrdf)
        known: dict[str, Any] = {
            "format": FORMAT,
            "photo": {"source": f"{stem}.png", "sha256": None},
            "settings": {"format": "png", "normals": "opengl", "color_space": "auto"},
            "recipe": {"name": "default"},
            "light": {"position": [0.3, -0.2, 1.4], "intensity": [1.0, 1.0, 1.0], "falloff": "none"},
            "camera": {"kind": "perspective", "position": [0.0, 0.0, 2.14]},
            "maps": {"files": {name: path.name for name, path in paths.items()}},
            "rmse": {"initialization": 0.02, "refined": 0.01},
        }
        (folder / f"{stem}.json").write_text(json.dumps(known | record), encoding="utf-8")
        return svbrdf

    return write


@pytest.fixture
def photo_beside(svbrdf: SVBRDF, tmp_path: Path) -> tuple[Path, str]:
    """Return a photo of the material's size and its digest."""
    path = tmp_path / "wall.png"
    pixels = linear_to_srgb(svbrdf.diffuse)[0].permute(1, 2, 0).numpy()
    write_image(path, path, np.ascontiguousarray(pixels), "srgb_rec709_scene", MapFormat("png", 8))
    return path, hashlib.sha256(path.read_bytes()).hexdigest()
