"""What tiny evaluations need on disk: test sets, scenes of several photos, a network that is none."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch

from eval.development import STRIPS
from nets.baselines.autoencoder import Autoencoder, AutoencoderConfig
from nets.checkpoint import Record, save_model
from nets.color import linear_to_srgb
from nets.data.images import write_image
from nets.data.strips import write_strip
from nets.generator import Generator, GeneratorConfig
from nets.render import Camera, PointLight, render, surface_points
from nets.svbrdf import SVBRDF


def grey(photo: torch.Tensor) -> SVBRDF:
    return SVBRDF.constant(*photo.shape[-2:])


class FakeModel:
    def to(self, device: torch.device) -> "FakeModel":
        return self

    def predict(self, photo: torch.Tensor) -> tuple[SVBRDF, PointLight]:
        return grey(photo), PointLight.at((0.0, 0.0, 2.0))


def write_checkpoint(path: Path, seed: int = 0) -> Path:
    """Write a tiny network that was never trained."""
    torch.manual_seed(seed)
    config = GeneratorConfig(width=2, levels=3, deep_multiplier=2)
    save_model(path, Generator(config), Record(config))
    return path


def write_autoencoder(path: Path, seed: int = 0) -> Path:
    """Write a tiny auto-encoder that was never trained."""
    torch.manual_seed(seed)
    config = AutoencoderConfig(width=2)
    save_model(path, Autoencoder(config), Record(config))
    return path


def material(seed: int, size: int = 80) -> SVBRDF:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 10, 8, 8, generator=generator)
    maps = torch.nn.functional.interpolate(coarse, size=(size, size), mode="bilinear")
    normal, diffuse, roughness, specular = torch.split(maps, [3, 3, 1, 3], dim=1)
    normal = torch.nn.functional.normalize(normal - torch.tensor([0.5, 0.5, -0.5])[:, None, None], dim=1)
    return SVBRDF(normal, diffuse, 0.2 + 0.7 * roughness, 0.2 * specular)


def write_strips(folder: Path, count: int) -> Path:
    """Write a folder of strips, `scene_0.png` and so on."""
    folder.mkdir()
    for seed in range(count):
        write_strip(folder / f"scene_{seed}.png", material(seed))
    return folder


def write_pbr(folder: Path, pixels: int = 72) -> None:
    folder.mkdir(parents=True)
    values = {"basecolor": (188, 188, 188), "normal": (128, 128, 255), "roughness": (128, 128, 128)}
    for name, value in values.items():
        write_image(folder / f"{name}.png", np.full((pixels, pixels, 3), value, dtype=np.uint8))


def write_development(folder: Path) -> Path:
    """Write the development sets' layout, two or three scenes each."""
    for test_set in STRIPS:
        strips = folder / test_set.folder
        strips.mkdir(parents=True)
        for seed in range(3):
            stored = torch.full((1, 3, 80, 80), 0.5) if test_set.name == "des18_dev" else None
            write_strip(strips / f"scene_{seed}.png", material(seed), stored)
    for name in ("brick", "wood"):
        write_pbr(folder / "materials" / "dev" / name)
    return folder


WIDTH = 12.0
"""Width of the surfaces below, cm."""

PLACES = ((4.0, 3.0, 14.0), (0.5, -0.6, 13.0), (-3.0, 2.0, 17.0), (0.0, -5.0, 15.0))
"""Where camera and flash were, cm; the second is the most central."""


def flash_photo(svbrdf: SVBRDF, place: tuple[float, float, float], power: float) -> torch.Tensor:
    """Photograph a surface from a place in cm: radiance is power by the squared distance, in cm, too."""
    eye = torch.tensor(place) / (WIDTH / 2.0)
    points = surface_points(*svbrdf.size)
    squared = ((eye[:, None, None] - points) ** 2).sum(dim=0) * (WIDTH / 2.0) ** 2
    light = PointLight(eye[None], torch.ones(1, 3))
    return (render(svbrdf, light, Camera("collocated")) * power / squared).clamp(0.0, 1.0)


def write_surface(folder: Path, svbrdf: SVBRDF, calibration: str, power: float = 60.0, **more: str) -> Path:
    """Write a scene of several photos in MaterialGAN's layout, its calibration under the given name."""
    folder.mkdir(parents=True)
    for number, place in enumerate(PLACES):
        encoded = linear_to_srgb(flash_photo(svbrdf, place, power))[0].permute(1, 2, 0)
        write_image(folder / f"{number:02}.png", np.rint(encoded.numpy() * 255.0).astype(np.uint8))
    facts = {"im_size": WIDTH, "camera_pos": PLACES, "light_pos": PLACES, **more}
    (folder / calibration).write_text(json.dumps(facts), encoding="utf-8")
    return folder
