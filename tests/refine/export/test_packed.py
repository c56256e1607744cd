"""Channels of packed pictures, the height map and the tile, as files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from PIL import Image

from nets.svbrdf import SVBRDF
from refine.export import packed
from refine.export.bundle import Picture, Source, write_files
from refine.export.height import height_from_normals
from refine.export.shading import metallic_roughness
from refine.maps import MapFormat, read_maps
from tests.helpers import assert_close


def stored(path: Path) -> np.ndarray:
    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT))


def test_orm(source: Source, material: SVBRDF, tmp_path: Path) -> None:
    bundle = packed.orm(source)
    write_files(tmp_path, bundle.files, source.format)
    picture = stored(tmp_path / source.file("orm"))
    assert (picture[..., 0] == 1.0).all()
    np.testing.assert_allclose(picture[..., 1], material.roughness[0, 0].numpy(), atol=1e-5)
    np.testing.assert_allclose(picture[..., 2], metallic_roughness(material).metallic[0, 0], atol=1e-5)
    opengl, directx = (stored(tmp_path / source.file(name)) for name in ("normal", "normal_directx"))
    np.testing.assert_allclose(directx[..., 1], 1.0 - opengl[..., 1], atol=2e-5)
    np.testing.assert_array_equal(directx[..., [0, 2]], opengl[..., [0, 2]])
    np.testing.assert_allclose(opengl * 2.0 - 1.0, material.normal[0].permute(1, 2, 0).numpy(), atol=4e-5)
    assert set(bundle.notes["loss"]) == {"diffuse", "specular", "rendering"}


def test_unity(source: Source, material: SVBRDF, tmp_path: Path) -> None:
    """Alpha is smoothness here, so nothing may be multiplied by it: what is stored is what was meant."""
    write_files(tmp_path, packed.unity(source).files, MapFormat("png", 8))
    picture = np.asarray(Image.open(tmp_path / source.file("mask")), dtype=float) / 255.0
    metallic = metallic_roughness(material).metallic[0, 0].numpy()
    smoothness = 1.0 - material.roughness[0, 0].numpy()
    expected = np.stack([metallic, np.ones_like(metallic), np.zeros_like(metallic), smoothness], axis=-1)
    np.testing.assert_allclose(picture, expected, atol=0.51 / 255)


@pytest.mark.parametrize("format", [MapFormat(), MapFormat("exr", 32)], ids=str)
def test_height_is_what_the_notes_say(source: Source, tmp_path: Path, format: MapFormat) -> None:
    bundle = packed.height(replace(source, format=format))
    write_files(tmp_path, bundle.files, format)
    (name,) = bundle.files
    image = oiio.ImageBuf(str(tmp_path / name))
    assert image.spec().nchannels == 1
    heights = bundle.notes["low"] + image.get_pixels(oiio.FLOAT)[..., 0] * (
        bundle.notes["high"] - bundle.notes["low"]
    )
    expected = height_from_normals(source.svbrdf.normal)
    np.testing.assert_allclose(heights, expected, atol=1e-4 * np.ptp(expected))


def test_a_tile_is_a_material_again(source: Source, tmp_path: Path) -> None:
    bundle = packed.tile(source)
    write_files(tmp_path, bundle.files, source.format)
    tile = read_maps(tmp_path, f"{source.stem}_tile")
    assert (bundle.notes["height"], bundle.notes["width"]) == tile.size
    left, right = tile.diffuse[..., 0], tile.diffuse[..., -1]
    assert float((left - right).abs().mean()) < 0.1


def test_colors_are_encoded_and_data_is_not(tmp_path: Path) -> None:
    half = torch.full((1, 3, 4, 4), 0.5)
    files = {"color.png": Picture(half, color=True), "data.png": Picture(half)}
    write_files(tmp_path, dict(files), MapFormat())
    assert stored(tmp_path / "color.png").mean() == pytest.approx(1.055 * 0.5 ** (1 / 2.4) - 0.055, abs=1e-4)
    assert stored(tmp_path / "data.png").mean() == pytest.approx(0.5, abs=1e-4)
    linear = {name.replace("png", "exr"): picture for name, picture in files.items()}
    write_files(tmp_path, dict(linear), MapFormat("exr", 16))
    assert_close(
        torch.from_numpy(stored(tmp_path / "color.exr")), torch.from_numpy(stored(tmp_path / "data.exr"))
    )
