"""Maps on disk: names, encodings, quantisation, and all files of a material or none."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from nets.svbrdf import SVBRDF
from refine import maps
from refine.errors import UserError
from refine.maps import MAP_NAMES, MapFormat, read_maps, write_maps

FORMATS = [
    MapFormat("png", 8),
    MapFormat("png", 16),
    MapFormat("tif", 8),
    MapFormat("tif", 16),
    MapFormat("tif", 32),
    MapFormat("exr", 16),
    MapFormat("exr", 32),
]
BIT_STEP = {8: 1 / 255, 16: 1 / 65535}  # integer formats
HALF_STEP = 2**-11  # spacing of half floats in [0.5, 1)


def some_material(height: int = 24, width: int = 40) -> SVBRDF:
    generator = torch.Generator().manual_seed(3)

    def uniform(channels: int) -> Tensor:
        return torch.rand(1, channels, height, width, generator=generator)

    normal = uniform(3) * 2.0 - 1.0
    normal[:, 2] = normal[:, 2].abs()
    diffuse = uniform(3)
    diffuse[..., 0, :3] = torch.tensor([0.0, 0.5, 1.0])
    return SVBRDF(normalize(normal, dim=1), diffuse, uniform(1) * 0.98 + 0.02, uniform(3))


def pixels(path: Path) -> np.ndarray:
    opened = oiio.ImageInput.open(str(path))
    assert opened is not None, path
    spec = opened.spec()
    stored = opened.read_image(0, 0, 0, spec.nchannels, "float")
    assert stored is not None, path
    return stored.reshape(spec.height, spec.width, spec.nchannels)


def attribute(path: Path, name: str) -> object:
    opened = oiio.ImageInput.open(str(path))
    assert opened is not None, path
    return opened.spec().getattribute(name)


def srgb(linear: Tensor) -> Tensor:
    """The piecewise curve, written out again (IEC 61966-2-1)."""
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("format", FORMATS, ids=str)
def test_round_trip_is_within_quantisation(tmp_path: Path, format: MapFormat) -> None:
    material = some_material()
    write_maps(tmp_path, "stone", material, format=format)
    again = read_maps(tmp_path, "stone").validate()
    if format.linear:
        value = HALF_STEP / 2 if format.bits == 16 else 1e-6
        color, normal = value, 3 * value + 1e-6
    else:
        value = BIT_STEP[format.bits] / 2
        color, normal = value * 2.4, 4 * value  # the steepest slope of the decoding curve is 2.4 / 1.055
    tolerance = {"roughness": value, "diffuse": color, "specular": color, "normal": normal}
    for name in MAP_NAMES:
        error = float((getattr(again, name) - getattr(material, name)).abs().max())
        assert error <= tolerance[name] * 1.01 + 1e-6, name


@pytest.mark.parametrize("format", FORMATS, ids=str)
def test_stored_values_and_names_are_the_contract(tmp_path: Path, format: MapFormat) -> None:
    material = some_material()
    rendering = material.diffuse * 3.0
    paths = write_maps(tmp_path / "out", "stone", material, rendering=rendering, format=format)
    names = {name: f"stone_{name}.{format.extension}" for name in (*MAP_NAMES, "rendering")}
    assert {name: path.name for name, path in paths.items()} == names
    assert sorted(os.listdir(tmp_path / "out")) == sorted(names.values())
    expected = {
        "normal": material.normal * 0.5 + 0.5,
        "roughness": material.roughness,
        "diffuse": material.diffuse if format.linear else srgb(material.diffuse),
        "specular": material.specular if format.linear else srgb(material.specular),
        "rendering": rendering if format.linear else srgb(rendering.clamp(max=1.0)),
    }
    relative = 1e-6 if format.bits == 32 else HALF_STEP if format.linear else 0.0
    absolute = 1e-6 if format.linear else BIT_STEP[format.bits] * 0.51
    for name, path in paths.items():
        stored = pixels(path)
        assert stored.shape[-1] == (1 if name == "roughness" else 3)
        wanted = expected[name][0].permute(1, 2, 0).numpy()
        np.testing.assert_allclose(stored, wanted, rtol=relative, atol=absolute, err_msg=name)


def test_files_say_what_their_colours_are(tmp_path: Path) -> None:
    material = some_material()
    png = write_maps(tmp_path, "stone", material, rendering=material.diffuse)
    for name, path in png.items():
        assert (b"sRGB" in path.read_bytes()) == (name in ("diffuse", "specular", "rendering")), name
    exr = write_maps(tmp_path, "stone", material, rendering=material.diffuse, format=MapFormat("exr"))
    for name, path in exr.items():
        kind = "lin_rec709_scene" if name in ("diffuse", "specular", "rendering") else "data"
        assert attribute(path, "oiio:ColorSpace") == kind, name
        assert attribute(path, "DateTime") is None


def test_an_unknown_normal_convention_is_refused() -> None:
    """Below the public functions, whose signatures the suite's type checker guards first."""
    with pytest.raises(UserError, match="'vulkan' is unknown; choose opengl or directx"):
        maps._with_convention(some_material().normal, "vulkan")


def test_directx_flips_green_and_nothing_else(tmp_path: Path) -> None:
    material = some_material()
    opengl = write_maps(tmp_path, "gl", material)
    directx = write_maps(tmp_path, "dx", material, normal_convention="directx")
    up, down = pixels(opengl["normal"]), pixels(directx["normal"])
    np.testing.assert_array_equal(up[..., [0, 2]], down[..., [0, 2]])
    np.testing.assert_allclose(up[..., 1], 1.0 - down[..., 1], atol=BIT_STEP[16])
    assert np.abs(up[..., 1] - down[..., 1]).max() > 0.5
    for name in ("diffuse", "specular", "roughness"):
        assert opengl[name].read_bytes() == directx[name].read_bytes()
    read = read_maps(tmp_path, "dx", normal_convention="directx")
    torch.testing.assert_close(read.normal, material.normal, rtol=0.0, atol=1e-4)
    wrong = read_maps(tmp_path, "dx")
    torch.testing.assert_close(wrong.normal[:, 1], -material.normal[:, 1], rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("format", FORMATS, ids=str)
def test_same_material_same_bytes(tmp_path: Path, format: MapFormat) -> None:
    material = some_material()
    first = write_maps(tmp_path / "first", "stone", material, rendering=material.diffuse, format=format)
    second = write_maps(tmp_path / "second", "stone", material, rendering=material.diffuse, format=format)
    for name in first:
        assert first[name].read_bytes() == second[name].read_bytes(), name
        assert attribute(first[name], "DateTime") is None  # equal bytes within one second prove little
        assert attribute(first[name], "Software") is None


def test_a_failure_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = maps.write_image

    def fail_on_roughness(temporary: Path, path: Path, *rest: object) -> None:
        if "roughness" in path.name:
            raise UserError(f"Cannot write {path}: simulated.")
        write(temporary, path, *rest)  # type: ignore[arg-type]

    material = some_material()
    before = write_maps(tmp_path, "old", material)
    contents = {path.name: path.read_bytes() for path in before.values()}
    monkeypatch.setattr(maps, "write_image", fail_on_roughness)
    with pytest.raises(UserError, match="roughness"):
        write_maps(tmp_path / "new", "stone", material)
    darker = SVBRDF(material.normal, material.diffuse * 0.5, material.roughness, material.specular)
    with pytest.raises(UserError, match="roughness"):
        write_maps(tmp_path, "old", darker)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == contents


def test_a_file_cut_short_by_a_full_disk_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decode = maps.decode_image

    def truncate_then_decode(path: Path) -> object:
        path.write_bytes(path.read_bytes()[:-200])
        return decode(path)

    monkeypatch.setattr(maps, "decode_image", truncate_then_decode)
    with pytest.raises(UserError, match=r"Cannot write .*stone_normal\.png completely"):
        write_maps(tmp_path, "stone", some_material())
    assert os.listdir(tmp_path) == []


def test_an_unwritable_folder_is_a_user_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="Cannot write"):
        write_maps(tmp_path / "file", "stone", some_material())


def test_illegal_materials_and_renderings_are_refused_before_any_file(tmp_path: Path) -> None:
    material = some_material()
    broken = SVBRDF(material.normal, material.diffuse * 2.0, material.roughness, material.specular)
    with pytest.raises(ValueError, match="diffuse"):
        write_maps(tmp_path, "stone", broken)
    with pytest.raises(ValueError, match="batch of 2"):
        write_maps(tmp_path, "stone", SVBRDF.cat([material, material]))
    with pytest.raises(ValueError, match="rendering"):
        write_maps(tmp_path, "stone", material, rendering=material.diffuse[..., :-1])
    with pytest.raises(ValueError, match="rendering"):
        write_maps(tmp_path, "stone", material, rendering=material.diffuse * torch.nan)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(("extension", "bits"), [("png", 32), ("exr", 8)])
def test_formats_that_do_not_exist_are_refused(extension: str, bits: int) -> None:
    with pytest.raises(UserError, match=f"no {bits}-bit {extension}"):
        MapFormat(extension, bits)  # type: ignore[arg-type]


def test_reading_says_what_is_wrong(tmp_path: Path) -> None:
    write_maps(tmp_path, "stone", some_material())
    with pytest.raises(UserError, match=r"no brick_normal\."):
        read_maps(tmp_path, "brick")
    write_maps(tmp_path, "stone", some_material(), format=MapFormat("exr"))
    with pytest.raises(UserError, match=r"stone_normal\.png and stone_normal\.exr"):
        read_maps(tmp_path, "stone")
    assert read_maps(tmp_path, "stone", extension="exr").size == (24, 40)
    write_maps(tmp_path / "small", "stone", some_material(20, 40))
    (tmp_path / "small" / "stone_diffuse.png").replace(tmp_path / "stone_diffuse.png")
    with pytest.raises(UserError, match="another size"):
        read_maps(tmp_path, "stone", extension="png")
    (tmp_path / "stone_roughness.png").replace(tmp_path / "stone_diffuse.png")
    with pytest.raises(UserError, match="a diffuse map has 3"):
        read_maps(tmp_path, "stone", extension="png")


def test_normals_without_a_direction_are_not_a_material(tmp_path: Path) -> None:
    paths = write_maps(tmp_path, "stone", some_material())
    oiio.ImageBuf(np.full((24, 40, 3), 0.5, np.float32)).write(str(tmp_path / "flat.exr"))
    paths["normal"].unlink()
    (tmp_path / "flat.exr").rename(tmp_path / "stone_normal.exr")
    with pytest.raises(UserError, match="unit"):
        read_maps(tmp_path, "stone")


def test_zero_roughness_in_a_file_becomes_the_smallest_legal_one(tmp_path: Path) -> None:
    paths = write_maps(tmp_path, "stone", some_material(), format=MapFormat("png", 8))
    oiio.ImageBuf(np.zeros((24, 40, 1), np.uint8)).write(str(paths["roughness"]))
    roughness = read_maps(tmp_path, "stone").roughness
    assert float(roughness.min()) == float(roughness.max()) == pytest.approx(maps.SMALLEST_ROUGHNESS)


def test_normals_of_other_programs_are_made_unit_length_and_turned_to_the_viewer(tmp_path: Path) -> None:
    paths = write_maps(tmp_path, "stone", some_material(), format=MapFormat("exr", 32))
    stored = np.full((24, 40, 3), (0.9, 0.5, 0.49), np.float32)  # 0.8 long, just below the horizon
    assert oiio.ImageBuf(stored).write(str(paths["normal"]))
    normal = read_maps(tmp_path, "stone").normal
    torch.testing.assert_close(normal[0, :, 3, 4], torch.tensor([1.0, 0.0, 0.0]))
