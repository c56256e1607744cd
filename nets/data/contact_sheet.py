"""A picture of training materials: rows of rendering, normal, diffuse, roughness, specular.

    python -m nets.data.contact_sheet --out sheet.png [--source procedural|FOLDER] [--count N] [--seed S]

FOLDER is a pool, one PBR folder, a folder of PBR folders, or a folder of strips.
For looking at, not for reading back.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from nets.color import linear_to_srgb
from nets.data.augment import augment
from nets.data.images import DataError, resize, unit_normal
from nets.data.pbr import find_maps, read_pbr_folder
from nets.data.pool import INDEX, MaterialPool, decode
from nets.data.pool_format import from_planes
from nets.data.procedural import random_material
from nets.data.strips import read_strip
from nets.render import PointLight, render
from nets.svbrdf import SVBRDF

LONGEST_SHEET = 30000
"""Pixels: image libraries stop at 2^16 a side, and most viewers before."""

COLUMNS = ("rendering", "normal", "diffuse", "roughness", "specular")

LIGHT = PointLight.at((-0.7, 0.7, 2.0), 1.0)
"""From the upper left: bumps are bright on that side when normals have their green up."""


def panels(svbrdf: SVBRDF, light: PointLight = LIGHT) -> list[Float[np.ndarray, "h w 3"]]:
    """Return one material's pictures in the order of `COLUMNS`, in [0, 1] for display.

    Rendering, diffuse and specular are sRGB-encoded; normals are (n + 1) / 2, roughness as it is.

    Args:
        svbrdf: a batch of one.
        light: of the rendering.
    """
    encoded = [render(svbrdf, light), svbrdf.diffuse, svbrdf.specular]
    rendering, diffuse, specular = (linear_to_srgb(image.clamp(0.0, 1.0)) for image in encoded)
    images = [
        rendering,
        (svbrdf.normal + 1.0) / 2.0,
        diffuse,
        svbrdf.roughness.expand(-1, 3, -1, -1),
        specular,
    ]
    return [image[0].permute(1, 2, 0).clamp(0.0, 1.0).numpy() for image in images]


def load(source: str, count: int, seed: int) -> list[tuple[str, SVBRDF]]:
    """Read or generate up to `count` named materials.

    Args:
        source: `procedural`, or a folder (see the module's first lines).
        count: how many at most.
        seed: of the choice among many.

    Raises:
        DataError: the folder holds no materials.
    """
    generator = torch.Generator().manual_seed(seed)
    if source == "procedural":
        made = (random_material(256, seed + number) for number in range(count))
        return [(name, from_planes(maps)) for name, maps in made]
    folder = Path(source)
    if (folder / INDEX).is_file():
        pool = MaterialPool(folder)
        chosen = torch.randperm(len(pool), generator=generator)[:count].tolist()
        return [(pool.index[position].name, decode(pool[position])) for position in chosen]
    if not folder.is_dir():
        raise DataError(f"{folder} is not a folder")
    children = sorted(folder.iterdir())
    strips = [path for path in children if path.suffix == ".png" and not path.name.startswith(".")]
    folders = [folder] if "basecolor" in find_maps(folder) else [path for path in children if path.is_dir()]
    candidates = folders or strips
    if not candidates:
        raise DataError(f"{folder} holds no materials")
    chosen = torch.randperm(len(candidates), generator=generator)[:count].tolist()
    paths = [candidates[position] for position in chosen]
    return [(p.stem, read_pbr_folder(p) if p.is_dir() else read_strip(p).svbrdf) for p in paths]


def draw(materials: Sequence[tuple[str, SVBRDF]], out: Path, *, tile: int = 192) -> None:
    """Write the sheet, labelled.

    Args:
        materials: names and batches of one.
        out: a file of any type matplotlib writes.
        tile: longer side of a picture in pixels.
    """
    import matplotlib.figure

    rows, dpi = len(materials), 100
    figure = matplotlib.figure.Figure(
        figsize=(len(COLUMNS) * tile / dpi, rows * (tile + 16) / dpi + 0.2), dpi=dpi
    )
    axes = np.atleast_2d(figure.subplots(rows, len(COLUMNS), squeeze=False))
    for row, (name, svbrdf) in enumerate(materials):
        for column, image in enumerate(panels(_shrink(svbrdf, tile))):
            axis = axes[row, column]
            axis.imshow(image, interpolation="nearest")
            axis.set_axis_off()
            if row == 0:
                axis.set_title(COLUMNS[column], fontsize=8)
            if column == 0:
                axis.text(0.0, -0.01, name, fontsize=6, transform=axis.transAxes, va="top")
    figure.subplots_adjust(0.005, 0.02, 0.995, 1.0 - 0.25 / (rows * (tile + 16) / dpi + 0.2), 0.02, 0.08)
    figure.savefig(out)


def draw_photos(
    scenes: Sequence[tuple[str, Sequence[Float[np.ndarray, "h w 3"]]]], out: Path, *, tile: int = 112
) -> None:
    """Write a sheet of photos of several scenes, one row per scene, labelled.

    Args:
        scenes: names and photos, encoded for display, in [0, 1].
        out: a file of any type matplotlib writes.
        tile: side of a picture in pixels; smaller if there are so many scenes that no file would hold them.
    """
    import matplotlib.figure

    rows, columns, dpi = len(scenes), max(len(photos) for _, photos in scenes), 100
    tile = min(tile, max(16, LONGEST_SHEET // rows - 16))
    figure = matplotlib.figure.Figure(figsize=(columns * tile / dpi, rows * (tile + 16) / dpi), dpi=dpi)
    axes = figure.subplots(rows, columns, squeeze=False)
    for row, (name, photos) in zip(axes, scenes, strict=True):
        for axis in row:
            axis.set_axis_off()
        for axis, photo in zip(row, photos, strict=False):
            axis.imshow(photo, interpolation="nearest")
        row[0].text(0.0, 1.02, f"{name}, {len(photos)} photos", fontsize=6, transform=row[0].transAxes)
    figure.subplots_adjust(0.0, 0.0, 1.0, 1.0 - 14.0 / (rows * (tile + 16)), 0.02, 16.0 / tile)
    figure.savefig(out)


def _shrink(svbrdf: SVBRDF, longer: int) -> SVBRDF:
    height, width = svbrdf.size
    factor = min(1.0, longer / max(height, width))
    small = svbrdf.map(lambda tensor: resize(tensor, round(height * factor), round(width * factor)))
    return SVBRDF(unit_normal(small.normal), small.diffuse, small.roughness, small.specular)


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw a sheet from the command line."""
    parser = argparse.ArgumentParser(prog="python -m nets.data.contact_sheet", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="picture to write")
    parser.add_argument(
        "--source", default="procedural", help="`procedural`, a pool, or a folder of materials"
    )
    parser.add_argument("--count", type=int, default=8, help="number of rows")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--augment", action="store_true", help="show a random variation of each material")
    options = parser.parse_args(arguments)
    materials = load(options.source, options.count, options.seed)
    if options.augment:
        generator = torch.Generator().manual_seed(options.seed)
        materials = [(n, augment(m, generator, size=128)) for n, m in materials if len(set(m.size)) == 1]
    draw(materials, options.out)


if __name__ == "__main__":
    main()
