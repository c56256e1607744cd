"""Readers give back what was written, in the stated conventions, and name what is broken."""

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from nets.color import srgb_to_linear
from nets.data import DataError, contact_sheet
from nets.data.images import decode_normal, read_image, resize, write_image
from nets.data.pbr import find_maps, read_pbr_folder
from nets.data.photos import read_scene
from nets.data.strips import read_strip, write_strip
from nets.render import Camera, PointLight, render
from nets.svbrdf import SVBRDF


def random_svbrdf(height: int, width: int, seed: int = 0) -> SVBRDF:
    generator = torch.Generator().manual_seed(seed)
    maps = torch.rand(1, 10, height, width, generator=generator)
    normal = decode_normal(torch.cat([maps[:, :2] * 0.6 + 0.2, torch.ones_like(maps[:, :1])], dim=1))
    return SVBRDF(normal, maps[:, 2:5], maps[:, 5:6].clamp(min=0.05), maps[:, 6:9])


def put(path: Path, values: float | tuple[float, ...] | np.ndarray, size: int = 8) -> Path:
    """Write an 8-bit image of one value, or of an array in [0, 1]."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim < 2:
        array = np.broadcast_to(np.atleast_1d(array), (size, size, array.size))
    write_image(path, np.rint(array * 255).astype(np.uint8))
    return path


def dome(size: int, green_down: bool = False) -> np.ndarray:
    """The normal map of a bump in the middle, (n + 1) / 2."""
    axis = (np.arange(size) + 0.5) / size * 2 - 1
    y, x = np.meshgrid(-axis, axis, indexing="ij")
    radius = np.sqrt(x**2 + y**2)
    inside = np.where(radius < 0.7, 0.8, 0.0)
    normal = np.stack([x * inside, y * inside, np.ones_like(x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    if green_down:
        normal[..., 1] *= -1
    return (normal + 1) / 2


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A minimal PBR folder; base colour 0.5 in sRGB, roughness 0.6, flat."""
    put(tmp_path / "thing_basecolor.png", (0.5, 0.5, 0.5))
    put(tmp_path / "thing_normal.png", (0.5, 0.5, 1.0))
    put(tmp_path / "thing_roughness.png", 0.6)
    return tmp_path


# ---- strips


@pytest.mark.parametrize("gamma", ["linear", "srgb"])
@pytest.mark.parametrize("with_input", [False, True])
def test_strip_round_trip(tmp_path: Path, with_input: bool, gamma: str) -> None:
    material = random_svbrdf(16, 16)
    photo = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(1)) if with_input else None
    path = tmp_path / "a.png"
    write_strip(path, material, photo, gamma=gamma)
    strip = read_strip(path, gamma=gamma)
    strip.svbrdf.validate()
    step = 1.0 / 255.0
    torch.testing.assert_close(strip.svbrdf.roughness, material.roughness, atol=step, rtol=0)
    torch.testing.assert_close(strip.svbrdf.diffuse, material.diffuse, atol=1.5 * step, rtol=0)
    torch.testing.assert_close(strip.svbrdf.specular, material.specular, atol=1.5 * step, rtol=0)
    torch.testing.assert_close(strip.svbrdf.normal, material.normal, atol=2.5 * step, rtol=0)
    assert (strip.input is None) == (photo is None)
    if photo is not None:
        torch.testing.assert_close(strip.input, photo, atol=step, rtol=0)
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]


def test_strip_tiles_are_in_the_papers_order_and_gamma_is_as_stated(tmp_path: Path) -> None:
    tiles = [(0.2, 0.2, 0.2), (0.5, 0.5, 1.0), (0.4, 0.0, 0.0), (0.1, 0.2, 0.3), (0.0, 0.0, 0.6)]
    strip = np.concatenate([np.broadcast_to(np.array(tile), (4, 4, 3)) for tile in tiles], axis=1)
    path = put(tmp_path / "order.png", strip)
    linear, srgb = read_strip(path), read_strip(path, gamma="srgb")
    assert linear.input is not None
    assert float(linear.input.mean()) == pytest.approx(0.2, abs=1e-6)
    assert float(linear.svbrdf.diffuse[0, 0, 0, 0]) == pytest.approx(0.4, abs=1e-6)
    assert float(srgb.svbrdf.diffuse[0, 0, 0, 0]) == pytest.approx(0.1329, abs=1e-3)
    assert float(linear.svbrdf.roughness.mean()) == float(srgb.svbrdf.roughness.mean())
    assert float(linear.svbrdf.roughness.mean()) == pytest.approx(0.2, abs=2e-3)
    assert linear.svbrdf.specular[0, :, 0, 0].tolist() == pytest.approx([0.0, 0.0, 0.6], abs=1e-6)


def test_strips_of_oblong_tiles_need_to_be_told(tmp_path: Path) -> None:
    path = tmp_path / "oblong.png"
    write_strip(path, random_svbrdf(8, 12))
    with pytest.raises(DataError, match=r"oblong\.png is 48 x 8 pixels"):
        read_strip(path)
    assert read_strip(path, has_input=False).svbrdf.size == (8, 12)
    with pytest.raises(DataError, match="does not divide into 5 tiles"):
        read_strip(path, has_input=True)


def test_broken_strips_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"absent\.png does not exist"):
        read_strip(tmp_path / "absent.png")
    (tmp_path / "text.png").write_text("not an image")
    with pytest.raises(DataError, match=r"text\.png"):
        read_strip(tmp_path / "text.png")
    whole = tmp_path / "whole.png"
    write_strip(whole, random_svbrdf(64, 64))
    for cut in (100, 5000):
        (tmp_path / "cut.png").write_bytes(whole.read_bytes()[:cut])
        with pytest.raises(DataError, match=r"cut\.png"):
            read_strip(tmp_path / "cut.png")
    with pytest.raises(DataError, match="can hold one material, not 2"):
        write_strip(whole, SVBRDF.constant(4, 4, batch=2))
    with pytest.raises(DataError, match="nowhere"):
        write_strip(tmp_path / "nowhere" / "a.png", SVBRDF.constant(4, 4))


def test_truncated_jpeg_is_named(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).random((128, 128, 3))
    whole = put(tmp_path / "whole.jpg", noise).read_bytes()
    (tmp_path / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"cut\.jpg"):
        read_image(tmp_path / "cut.jpg")


# ---- PBR folders


@pytest.mark.parametrize(
    ("names", "roles"),
    [
        (
            [
                *(
                    "Metal034_2K-JPG_Color.jpg",
                    "Metal034_2K-JPG_NormalGL.jpg",
                    "Metal034_2K-JPG_NormalDX.jpg",
                ),
                *("Metal034_2K-JPG_Roughness.jpg", "Metal034_2K-JPG_Metalness.jpg", "Metal034.png"),
                "Metal034_2K-JPG_Displacement.jpg",
            ],
            {
                "basecolor": "Metal034_2K-JPG_Color.jpg",
                "normal": "Metal034_2K-JPG_NormalGL.jpg",
                "roughness": "Metal034_2K-JPG_Roughness.jpg",
                "metallic": "Metal034_2K-JPG_Metalness.jpg",
                "height": "Metal034_2K-JPG_Displacement.jpg",
            },
        ),
        (
            [
                *(
                    "rusty_metal_05_diff_1k.jpg",
                    "rusty_metal_05_nor_dx_1k.png",
                    "rusty_metal_05_rough_1k.jpg",
                ),
                *("rusty_metal_05_metal_1k.jpg", "rusty_metal_05_ao_1k.jpg", "rusty_metal_05_disp_1k.png"),
            ],
            {
                "basecolor": "rusty_metal_05_diff_1k.jpg",
                "normal": "rusty_metal_05_nor_dx_1k.png",
                "roughness": "rusty_metal_05_rough_1k.jpg",
                "metallic": "rusty_metal_05_metal_1k.jpg",
                "height": "rusty_metal_05_disp_1k.png",
            },
        ),
        (
            [
                *("Bricks01_2K_BaseColor.png", "Bricks01_2K_Normal.png", "Bricks01_2K_Roughness.png"),
                *("Bricks01_2K_AO.png", "Bricks01_2K_Height.png"),
            ],
            {
                "basecolor": "Bricks01_2K_BaseColor.png",
                "normal": "Bricks01_2K_Normal.png",
                "roughness": "Bricks01_2K_Roughness.png",
                "height": "Bricks01_2K_Height.png",
            },
        ),
        (
            ["Wall_Base_Color.tga", "Wall_Normal_OpenGL.tga", "Wall_Glossiness.tga", "Wall_Specular.tga"],
            {
                "basecolor": "Wall_Base_Color.tga",
                "normal": "Wall_Normal_OpenGL.tga",
                "glossiness": "Wall_Glossiness.tga",
                "specular": "Wall_Specular.tga",
            },
        ),
        (
            ["albedo.jpg", "albedo.png", "brushed_metal.png", "normal.exr", "roughness.tif"],
            {"basecolor": "albedo.png", "normal": "normal.exr", "roughness": "roughness.tif"},
        ),
    ],
    ids=["ambientcg", "polyhaven", "cgbookcase", "substance", "plain"],
)
def test_maps_are_found_by_their_names(tmp_path: Path, names: list[str], roles: dict[str, str]) -> None:
    for name in [*names, "readme.txt"]:
        (tmp_path / name).touch()
    assert {role: path.name for role, path in find_maps(tmp_path).items()} == roles


def test_two_materials_in_one_folder_are_refused(folder: Path) -> None:
    put(folder / "other_basecolor.png", 0.5)
    with pytest.raises(DataError, match="more than one basecolor: other, thing"):
        read_pbr_folder(folder)


def test_plain_dielectric(folder: Path) -> None:
    material = read_pbr_folder(folder).validate()
    linear = float(srgb_to_linear(torch.full((3, 1, 1), 128 / 255))[0])
    assert float(material.diffuse.mean()) == pytest.approx(linear, abs=1e-5)
    assert float(material.roughness.mean()) == pytest.approx(0.6, abs=1e-5)
    assert float(material.specular.min()) == float(material.specular.max()) == pytest.approx(0.04)
    assert float(material.normal[:, 2].min()) > 0.999


def test_metallic_moves_colour_from_diffuse_to_specular(folder: Path) -> None:
    put(folder / "thing_metallic.png", 0.2)
    base = float(srgb_to_linear(torch.full((3, 1, 1), 128 / 255))[0])
    material = read_pbr_folder(folder)
    assert float(material.diffuse.mean()) == pytest.approx(0.8 * base, abs=1e-5)
    assert float(material.specular.mean()) == pytest.approx(0.04 * 0.8 + base * 0.2, abs=1e-5)


def test_glossiness_is_inverted(folder: Path) -> None:
    (folder / "thing_roughness.png").unlink()
    put(folder / "thing_gloss.png", 0.8)
    assert float(read_pbr_folder(folder).roughness.mean()) == pytest.approx(0.2, abs=1e-5)


def test_specular_is_a_level_or_f0_as_stated(folder: Path) -> None:
    put(folder / "thing_specular.png", (1.0, 0.0, 0.8))
    level = read_pbr_folder(folder)
    assert float(level.specular.mean()) == pytest.approx(0.08 * 0.6, abs=1e-5)
    assert float(level.specular.std()) < 1e-6
    stated = read_pbr_folder(folder, specular_workflow="f0")
    assert stated.specular[0, :, 0, 0].tolist() == pytest.approx([1.0, 0.0, 0.604], abs=2e-3)
    assert torch.equal(stated.diffuse, level.diffuse)
    put(folder / "thing_metallic.png", 0.2)
    with pytest.raises(DataError, match="metallic"):
        read_pbr_folder(folder, specular_workflow="f0")


def test_f0_workflow_needs_its_map(folder: Path) -> None:
    with pytest.raises(DataError, match="holds no specular map"):
        read_pbr_folder(folder, specular_workflow="f0")


@pytest.mark.parametrize("role", ["basecolor", "normal", "roughness"])
def test_missing_maps_are_named(folder: Path, role: str) -> None:
    (folder / f"thing_{role}.png").unlink()
    with pytest.raises(DataError, match=f"holds no {role}"):
        read_pbr_folder(folder)


def test_folders_must_exist(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is not a folder"):
        read_pbr_folder(tmp_path / "absent")


@pytest.mark.parametrize(
    ("name", "green_down", "convention"),
    [
        ("thing_normal.png", False, "opengl"),
        ("thing_normal.png", True, "directx"),
        ("thing_nor_dx.png", True, "opengl"),
        ("thing_NormalGL.png", False, "directx"),
    ],
)
def test_bumps_are_bright_towards_the_light(
    folder: Path, name: str, green_down: bool, convention: str
) -> None:
    (folder / "thing_normal.png").unlink()
    put(folder / "thing_basecolor.png", (0.5, 0.5, 0.5), 32)
    put(folder / name, dome(32, green_down))
    material = read_pbr_folder(folder, normal_convention=convention)
    for position, bright, dark in (
        ((0.0, 3.0, 3.0), (slice(6, 14), slice(12, 20)), (slice(18, 26), slice(12, 20))),
        ((3.0, 0.0, 3.0), (slice(12, 20), slice(18, 26)), (slice(12, 20), slice(6, 14))),
    ):
        picture = render(material, PointLight.at(position), Camera("orthographic"))[0].mean(dim=0)
        assert float(picture[bright].mean()) > 1.2 * float(picture[dark].mean())


def test_colour_encoded_normals_can_be_repaired(folder: Path) -> None:
    put(folder / "thing_normal.png", (0.7354, 0.7354, 1.0))
    assert float(read_pbr_folder(folder).normal[0, 0, 0, 0]) > 0.3
    repaired = read_pbr_folder(folder, normal_gamma="srgb").normal
    assert float(repaired[0, :2].abs().max()) < 0.01


def test_maps_are_brought_to_one_size(folder: Path) -> None:
    put(folder / "thing_roughness.png", np.repeat(np.eye(2), 8, 0).repeat(8, 1)[..., None])
    put(folder / "thing_normal.png", (0.5, 0.5, 1.0), 4)
    material = read_pbr_folder(folder)
    assert material.validate().size == (8, 8)
    assert float(material.roughness[0, 0, 0, 0]) == 1.0
    put(folder / "thing_basecolor.png", np.full((8, 16, 3), 0.5))
    assert read_pbr_folder(folder, size=8).validate().size == (4, 8)


def test_floating_point_base_colour_is_linear(folder: Path) -> None:
    (folder / "thing_basecolor.png").unlink()
    output = oiio.ImageOutput.create("a.exr")
    assert output.open(str(folder / "thing_basecolor.exr"), oiio.ImageSpec(8, 8, 3, "half"))
    assert output.write_image(np.full((8, 8, 3), 0.25, np.float32))
    output.close()
    assert float(read_pbr_folder(folder).diffuse.mean()) == pytest.approx(0.25, abs=1e-4)


@pytest.mark.parametrize(("source", "target"), [(8, 4), (7, 3), (9, 8), (5, 12), (6, 6)])
def test_resizing_keeps_the_mean_when_shrinking_and_constants_always(source: int, target: int) -> None:
    image = torch.rand(1, 2, source, source, generator=torch.Generator().manual_seed(0))
    smaller = resize(image, target, target)
    if target < source:
        torch.testing.assert_close(smaller.mean(dim=(2, 3)), image.mean(dim=(2, 3)))
    torch.testing.assert_close(resize(torch.full_like(image, 0.3), target, target), smaller * 0 + 0.3)
    assert float(smaller.min()) >= float(image.min())


# ---- scenes of several photos

POSITIONS = [[0.0, 1.0, 10.0], [2.0, -3.0, 8.0]]


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    for name in ("00.jpg", "01.jpg"):
        put(tmp_path / name, (0.5, 0.5, 0.5))
    put(tmp_path / "preview.jpg", (0.5, 0.5, 0.5))
    return tmp_path


def test_scene_in_text_files(scene: Path) -> None:
    table = "\n".join(",".join(str(number) for number in row) for row in POSITIONS) + "\n"
    (scene / "camera_pos.txt").write_text(table)
    (scene / "light_pos.txt").write_text(table)
    (scene / "image_size.txt").write_text("4.0\n")
    result = read_scene(scene)
    assert [path.name for path in result.photos] == ["00.jpg", "01.jpg"]
    assert result.positions is not None
    np.testing.assert_allclose(result.positions, np.array(POSITIONS) / 2.0, rtol=1e-6)
    assert result.measured


@pytest.mark.parametrize(("file", "measured"), [("calib.json", True), ("calib_fitted.json", False)])
def test_scene_in_json(scene: Path, file: str, measured: bool) -> None:
    fields = {"im_size": 4.0, "camera_pos": POSITIONS, "light_pos": POSITIONS, "reliability": "uncertain"}
    (scene / file).write_text(json.dumps(fields))
    result = read_scene(scene)
    assert result.positions is not None
    np.testing.assert_allclose(result.positions, np.array(POSITIONS) / 2.0, rtol=1e-6)
    assert result.measured == measured
    assert result.reliability == "uncertain"


def test_the_published_size_is_the_width_and_the_longer_side_counts(scene: Path) -> None:
    for name in ("00.jpg", "01.jpg"):
        put(scene / name, np.full((16, 8, 3), 0.5))
    (scene / "calib.json").write_text(json.dumps({"im_size": 4.0, "camera_pos": POSITIONS}))
    result = read_scene(scene)
    assert result.positions is not None
    np.testing.assert_allclose(result.positions, np.array(POSITIONS) / 4.0, rtol=1e-6)


def test_scene_without_calibration(scene: Path) -> None:
    result = read_scene(scene)
    assert result.positions is None
    assert not result.measured


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"im_size": 4.0, "camera_pos": POSITIONS[:1]}, "for 2 photos"),
        ({"im_size": 4.0, "camera_pos": [[0, 0, -1], [0, 0, 1]]}, "behind the surface"),
        ({"im_size": 4.0, "camera_pos": POSITIONS, "light_pos": POSITIONS[::-1]}, "apart from its camera"),
        ({"camera_pos": POSITIONS}, "not a calibration"),
    ],
)
def test_broken_calibrations_are_named(scene: Path, fields: dict, message: str) -> None:
    (scene / "calib.json").write_text(json.dumps(fields))
    with pytest.raises(DataError, match=rf"calib\.json .*{message}"):
        read_scene(scene)


def test_scenes_need_photos(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no numbered photos"):
        read_scene(tmp_path)
    with pytest.raises(DataError, match="not a folder"):
        read_scene(tmp_path / "absent")


# ---- contact sheet


def test_contact_sheet_of_folders_and_strips(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "sheet.png"
    contact_sheet.main(["--out", str(out), "--source", str(folder), "--count", "1", "--augment"])
    one, _ = read_image(out)
    strips = tmp_path / "strips"
    strips.mkdir()
    for name in ("a.png", "b.png"):
        write_strip(strips / name, random_svbrdf(16, 16))
    contact_sheet.main(["--out", str(out), "--source", str(strips), "--count", "2"])
    two, _ = read_image(out)
    assert two.shape[0] > 1.8 * one.shape[0]
    (strips / "a.png").unlink()
    (strips / "b.png").unlink()
    with pytest.raises(DataError, match="holds no materials"):
        contact_sheet.load(str(strips), 1, 0)
