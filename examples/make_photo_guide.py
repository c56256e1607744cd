"""Take photos of known materials well and badly, refine them, and show and score what becomes of it.

The pictures and the table of docs/photos.md: for every way to take the photo a strip of photo, normal,
diffuse and roughness, result and truth under a new light; and the scores of all. Materials are generated ones
of families that networks are trained on. And the maps of docs/maps.md, of an example photo.
`python examples/make_photo_guide.py [--out docs]`
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn import functional

from eval.datasets import NOVEL_LIGHTS, novel_lights
from eval.metrics import SceneScores, evaluate_material
from eval.report import markdown_table, origin, provenance
from losses.perceptual import LPIPS
from nets.color import linear_to_srgb, srgb_to_linear
from nets.data.pool_format import from_planes
from nets.data.procedural import generate
from nets.render import Camera, PointLight, render
from nets.svbrdf import MAPS, SVBRDF
from refine.refiner import Refiner

MATERIALS = (("setts", 3), ("leather", 31), ("slate", 34), ("wood_planks", 5))
"""Families and seeds; the first is the one in the pictures."""

NEW_LIGHT = PointLight.at((-1.1, 0.9, 1.6))
"""Of the last two pictures of a strip."""

WINDOW = (-4.0, 2.5, 2.0)
"""Where daylight comes from, where there is some."""


@dataclass(frozen=True)
class Shot:
    """A way to take the photo.

    Attributes:
        distance: from camera and flash to the surface's centre, in surface units.
        aside: the flash's place, x and y, if it is not at the camera.
        tilt: angle between the camera's axis and the surface's normal, degrees.
        exposure: of the photo; 1 is right.
        noise: standard deviation, of the encoded photo.
        blur: standard deviation, pixels of 256.
        daylight: radiance of a white surface by light that is not the flash's.
    """

    distance: float = 2.3
    aside: tuple[float, float] = (0.08, 0.05)
    tilt: float = 0.0
    exposure: float = 1.0
    noise: float = 0.006
    blur: float = 0.0
    daylight: float = 0.0


SHOTS = {
    "good": Shot(),
    "flash far off centre": Shot(aside=(2.3, 1.4)),
    "too close": Shot(distance=0.9),
    "overexposed": Shot(exposure=3.5),
    "dark and noisy": Shot(exposure=0.15, noise=0.02),
    "daylight from a window": Shot(daylight=0.7),
    "blurred": Shot(blur=2.5),
    "tilted": Shot(tilt=30.0),
}


def photograph(truth: SVBRDF, shot: Shot, seed: int) -> Tensor:
    """Return the photo `[1, 3, h, w]` of a square material as a phone would save it, decoded again."""
    tilt = torch.deg2rad(torch.tensor(shot.tilt))
    eye = shot.distance * torch.stack([torch.zeros(()), -torch.sin(tilt), torch.cos(tilt)])
    place = (float(eye[0]) + shot.aside[0], float(eye[1]) + shot.aside[1], float(eye[2]))
    camera = Camera("perspective", (float(eye[0]), float(eye[1]), float(eye[2])))
    radiance = render(truth, PointLight.at(place, falloff="inverse_square"), camera)
    if shot.daylight:
        radiance = radiance + render(truth, PointLight.at(WINDOW, shot.daylight), camera)
    radiance = seen_from(radiance, eye) if shot.tilt else radiance
    if shot.blur:
        radiance = gaussian_blur2d(radiance, 13, (shot.blur, shot.blur))
    encoded = linear_to_srgb((shot.exposure * radiance).clamp(max=1.0))
    grain = torch.randn(encoded.shape, generator=torch.Generator().manual_seed(seed))
    stored = ((encoded + shot.noise * grain).clamp(0.0, 1.0) * 255.0).round() / 255.0
    return srgb_to_linear(stored)


def seen_from(radiance: Tensor, eye: Tensor) -> Tensor:
    """Return what a camera at `eye` that looks at the centre sees; from above, the picture itself."""
    size, distance = radiance.shape[-1], eye.norm()
    forward = -eye / distance
    right = torch.tensor([1.0, 0.0, 0.0])
    up = torch.linalg.cross(right, forward)
    steps = (2.0 * torch.arange(size) + 1.0) / size - 1.0
    y, x = torch.meshgrid(-steps, steps, indexing="ij")
    ray = x[..., None] * right + y[..., None] * up + distance * forward
    surface = eye + ray * (-eye[2] / ray[..., 2])[..., None]
    grid = torch.stack([surface[..., 0], -surface[..., 1]], dim=-1)[None]
    return functional.grid_sample(radiance, grid, padding_mode="reflection", align_corners=False)


def strip(photo: Tensor, maps: SVBRDF, names: Sequence[str], *shown: SVBRDF) -> Tensor:
    """Lay pictures side by side, encoded for the screen: a photo, some maps, materials under a new light."""
    encoded = {
        "normal": maps.normal * 0.5 + 0.5,
        "diffuse": linear_to_srgb(maps.diffuse),
        "roughness": maps.roughness.expand(-1, 3, -1, -1),
        "specular": linear_to_srgb(maps.specular),
    }
    lit = [linear_to_srgb(render(material, NEW_LIGHT).clamp(max=1.0)) for material in shown]
    pictures = [linear_to_srgb(photo), *(encoded[name] for name in names), *lit]
    gap = torch.ones(1, 3, photo.shape[-2], 4)
    return torch.cat([part for picture in pictures for part in (picture, gap)][:-1], dim=-1)[0]


def main() -> None:
    """Write a strip for every shot, and the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of images/ and results/")
    parser.add_argument(
        "--quick", action="store_true", help="one material and photo, small, two steps, two lights"
    )
    arguments = parser.parse_args()
    size, iters, lights = (64, 2, 2) if arguments.quick else (256, None, NOVEL_LIGHTS)
    used = MATERIALS[:1] if arguments.quick else MATERIALS
    shots = dict(list(SHOTS.items())[: 1 if arguments.quick else None])
    pictures = arguments.out / "images" / "photos"
    pictures.mkdir(parents=True, exist_ok=True)
    (arguments.out / "results").mkdir(exist_ok=True)
    refiner, lpips = Refiner(resolution=size), LPIPS()
    tiles = refiner.fit(Path(__file__).with_name("tiles.jpg"), iters=iters)
    save(pictures.parent / "maps.jpg", strip(tiles.capture.photo, tiles.svbrdf, MAPS, tiles.svbrdf))
    materials = [from_planes(generate(family, size, seed)) for family, seed in used]
    rows = []
    for name, shot in shots.items():
        scores = []
        for number, truth in enumerate(materials):
            photo = photograph(truth, shot, seed=number)
            found = refiner.fit(photo[0], color_space="linear", iters=iters).svbrdf
            scores.append(evaluate_material(found, truth, novel_lights(number, lights), lpips=lpips))
            if number == 0:
                picture = strip(photo, found, ("normal", "diffuse", "roughness"), found, truth)
                save(pictures / f"{name.replace(' ', '-')}.jpg", picture)
        mean = SceneScores.mean(scores)
        columns = (mean.normal, mean.diffuse, mean.roughness, mean.specular, mean.rendering, mean.lpips)
        rows.append((name, *(f"{value:.3f}" for value in columns)))
    table = markdown_table(("photo", "N", "D", "R", "S", "Ren", "LPIPS"), rows, texts=1)
    caption = (
        f"Photos of {len(used)} generated materials ({', '.join(family for family, _ in used)}), "
        f"taken well and badly, refined by the recipe default, light estimated; {size} px, against "
        f"the truth under {lights} novel lights. RMSE of maps linear, of renderings encoded with 1/2.2; "
        f"LPIPS v0.1 AlexNet. By `python examples/make_photo_guide.py`; {origin(provenance())}."
    )
    text = "\n".join([caption, "", *table, ""])
    (arguments.out / "results" / "photo_guide.md").write_text(text, encoding="utf-8")
    print(text)


def save(path: Path, picture: Tensor) -> None:
    """Write an 8-bit JPEG."""
    pixels = (picture.clamp(0.0, 1.0).permute(1, 2, 0).numpy() * 255.0).round().astype(np.uint8)
    buffer = oiio.ImageBuf(np.ascontiguousarray(pixels))
    buffer.specmod().attribute("CompressionQuality", 88)
    buffer.write(str(path))


if __name__ == "__main__":
    main()
