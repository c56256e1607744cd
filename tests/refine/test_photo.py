"""Any photo becomes linear Rec. 709 light, upright, three channels, and nothing is lost silently."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from refine import photo as photo_module
from refine.errors import UserError
from refine.photo import Photo, photo_from_array, read_photo, resize_photo

P3_TO_709 = [[1.22494, -0.22494, 0.0], [-0.04206, 1.04206, 0.0], [-0.01964, -0.07864, 1.09827]]
ADOBE_TO_709 = [[1.39836, -0.39836, 0.0], [0.0, 1.0, 0.0], [0.0, -0.04293, 1.04293]]
AP1_TO_709 = [[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]]


def save(path: Path, pixels: np.ndarray, kind: str, **attributes: Any) -> Path:
    """Write pixels with OpenImageIO, as `kind`, with metadata ("__" in a name stands for ":")."""
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, kind)
    for name, value in attributes.items():
        if isinstance(value, bytes):
            described = oiio.TypeDesc(f"uint8[{len(value)}]")
            spec.attribute(name, described, np.frombuffer(value, np.uint8))
        elif isinstance(value, tuple):
            spec.attribute(name, oiio.TypeDesc(f"float[{len(value)}]"), value)
        else:
            spec.attribute(name.replace("__", ":"), value)
    output = oiio.ImageOutput.create(str(path))
    assert output is not None, path
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(np.ascontiguousarray(pixels)), output.geterror()
    assert output.close()
    return path


def srgb_decoded(encoded: np.ndarray) -> np.ndarray:
    """The piecewise curve, written out again (IEC 61966-2-1)."""
    encoded = encoded.astype(np.float64)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def picture(height: int = 20, width: int = 32, channels: int = 3) -> np.ndarray:
    """Every 8-bit value below 255 occurs; no two pixels of the first rows agree."""
    count = height * width * channels
    return (np.arange(count) * 7 % 255).astype(np.uint8).reshape(height, width, channels)


def icc_profile(description: str) -> bytes:
    """A matrix profile with that description and nonsense for colours: only its name is looked at."""
    text = description.encode() + b"\0"
    tags = {
        b"desc": b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + b"\0" * 78,
        b"cprt": b"text\0\0\0\0none\0",
    }
    for name in (b"wtpt", b"rXYZ", b"gXYZ", b"bXYZ"):
        tags[name] = b"XYZ \0\0\0\0" + struct.pack(">3i", 63190, 65536, 54061)
    for name in (b"rTRC", b"gTRC", b"bTRC"):
        tags[name] = b"curv\0\0\0\0" + struct.pack(">IH", 1, 563)
    table, body = struct.pack(">I", len(tags)), b""
    start = 128 + 4 + 12 * len(tags)
    for name, data in tags.items():
        table += name + struct.pack(">II", start + len(body), len(data))
        body += data + b"\0" * (-len(data) % 4)
    header = struct.pack(">I4sI4s4s4s", start + len(body), b"none", 0x02100000, b"mntr", b"RGB ", b"XYZ ")
    header += (
        struct.pack(">6H", 2020, 1, 1, 0, 0, 0)
        + b"acsp"
        + b"\0" * 28
        + struct.pack(">3i", 63190, 65536, 54061)
    )
    return header.ljust(128, b"\0") + table + body


def png_chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def hand_made_png(path: Path, width: int, height: int, color_type: int, rows: bytes, *before: bytes) -> Path:
    header = struct.pack(">IIBBBBB", width, height, 8, color_type, 0, 0, 0)
    chunks = [
        png_chunk(b"IHDR", header),
        *before,
        png_chunk(b"IDAT", zlib.compress(rows)),
        png_chunk(b"IEND", b""),
    ]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    return path


def rows(photo: Photo) -> np.ndarray:
    """Linear pixels as [h, w, 3]."""
    assert photo.linear.dtype == torch.float32
    return photo.linear[0].permute(1, 2, 0).numpy()


def noted(photo: Photo, words: str) -> bool:
    return any(words in note for note in photo.notes)


# Files: formats and colour


@pytest.mark.parametrize(
    ("extension", "kind"), [("png", "uint8"), ("png", "uint16"), ("tif", "uint8"), ("tif", "uint16")]
)
def test_integer_files_are_decoded_with_the_srgb_curve(tmp_path: Path, extension: str, kind: str) -> None:
    stored = picture() if kind == "uint8" else picture().astype(np.uint16) * 257 + 3
    photo = read_photo(save(tmp_path / f"a.{extension}", stored, kind))
    expected = srgb_decoded(stored / np.iinfo(stored.dtype).max)
    np.testing.assert_allclose(rows(photo), expected, rtol=1e-5, atol=1e-7)
    assert photo.linear.shape == (1, 3, 20, 32)
    assert photo.size == (20, 32)
    assert noted(photo, "colours read as sRGB")
    assert noted(photo, "uint16") == (kind == "uint16")
    assert photo.source == str(tmp_path / f"a.{extension}")


@pytest.mark.parametrize(
    ("extension", "kind"), [("exr", "half"), ("exr", "float"), ("tif", "float"), ("hdr", "float")]
)
def test_float_files_are_linear_already(tmp_path: Path, extension: str, kind: str) -> None:
    stored = picture().astype(np.float32) / 64.0  # up to 4
    photo = read_photo(save(tmp_path / f"a.{extension}", stored, kind))
    tolerance = 1 / 128 * 4 if extension == "hdr" else 0.0  # shared exponents
    np.testing.assert_allclose(rows(photo), stored, rtol=1e-3, atol=tolerance)
    assert bool(photo.unsaturated.all())
    assert noted(photo, "linear Rec. 709")


@pytest.mark.parametrize(
    ("color_space", "decode"),
    [("srgb", srgb_decoded), ("linear", lambda v: v), ("gamma22", lambda v: v**2.2)],
)
def test_the_caller_overrules_the_file(tmp_path: Path, color_space: Any, decode: Any) -> None:
    path = save(tmp_path / "a.png", picture(), "uint8", ICCProfile=icc_profile("Display P3"))
    photo = read_photo(path, color_space=color_space)
    np.testing.assert_allclose(rows(photo), decode(picture() / 255.0), rtol=1e-5, atol=1e-7)
    assert noted(photo, "as asked")


@pytest.mark.parametrize("extension", ["jpg", "png", "tif"])
@pytest.mark.parametrize(
    ("name", "choice", "matrix", "decode"),
    [
        ("Display P3", "display-p3", P3_TO_709, srgb_decoded),
        ("Adobe RGB (1998)", "adobe-rgb", ADOBE_TO_709, lambda v: v ** (563 / 256)),
    ],
)
def test_embedded_profiles_are_converted(
    tmp_path: Path, extension: str, name: str, choice: Any, matrix: Any, decode: Any
) -> None:
    color = np.array([200, 90, 40], np.uint8)
    path = save(
        tmp_path / f"a.{extension}", np.tile(color, (16, 16, 1)), "uint8", ICCProfile=icc_profile(name)
    )
    photo = read_photo(path)
    expected = np.array(matrix) @ decode(color / 255.0)
    jpeg_loss = 0.01 if extension == "jpg" else 1e-4
    np.testing.assert_allclose(rows(photo)[8, 8], expected.clip(min=0.0), atol=jpeg_loss)
    assert noted(photo, f"colours read as {name}")
    assert not np.allclose(expected, srgb_decoded(color / 255.0), atol=0.02)  # the profile matters
    torch.testing.assert_close(read_photo(path, color_space=choice).linear, photo.linear)


def test_a_srgb_profile_changes_nothing_and_white_stays_white(tmp_path: Path) -> None:
    white = np.full((16, 16, 3), 255, np.uint8)
    for name in ("sRGB IEC61966-2.1", "Display P3", "Adobe RGB (1998)", "ProPhoto RGB"):
        photo = read_photo(save(tmp_path / "a.png", white, "uint8", ICCProfile=icc_profile(name)))
        np.testing.assert_allclose(rows(photo), 1.0, atol=1e-5, err_msg=name)
    path = save(tmp_path / "a.png", picture(), "uint8", ICCProfile=icc_profile("sRGB IEC61966-2.1"))
    np.testing.assert_allclose(rows(read_photo(path)), srgb_decoded(picture() / 255.0), rtol=1e-5, atol=1e-7)


def test_a_profile_that_is_not_understood_is_noted(tmp_path: Path) -> None:
    path = save(tmp_path / "a.png", picture(), "uint8", ICCProfile=icc_profile("My scanner"))
    photo = read_photo(path)
    assert noted(photo, "'My scanner' not understood")
    np.testing.assert_allclose(rows(photo), srgb_decoded(picture() / 255.0), rtol=1e-5, atol=1e-7)


def test_colors_outside_rec709_are_clamped_and_noted(tmp_path: Path) -> None:
    green = np.tile(np.array([0, 200, 0], np.uint8), (16, 16, 1))
    photo = read_photo(save(tmp_path / "a.png", green, "uint8", ICCProfile=icc_profile("Display P3")))
    assert float(photo.linear.min()) == 0.0
    assert noted(photo, "outside Rec. 709 in 100.0%")


def test_exr_chromaticities_and_color_tags_are_honoured(tmp_path: Path) -> None:
    ap1 = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
    color = np.array([0.5, 0.3, 0.4], np.float32)
    expected = np.array(AP1_TO_709) @ color
    flat = np.tile(color, (16, 16, 1))
    chromatic = read_photo(save(tmp_path / "a.exr", flat, "float", chromaticities=ap1))
    tagged = read_photo(save(tmp_path / "b.exr", flat, "float", oiio__ColorSpace="lin_ap1_scene"))
    np.testing.assert_allclose(rows(chromatic)[0, 0], expected, atol=2e-4)
    np.testing.assert_allclose(rows(tagged)[0, 0], expected, atol=2e-4)


def test_the_gamma_of_a_png_is_honoured(tmp_path: Path) -> None:
    path = save(tmp_path / "a.png", picture(), "uint8", oiio__ColorSpace="lin_rec709_scene")
    assert b"gAMA" in path.read_bytes()
    np.testing.assert_allclose(rows(read_photo(path)), picture() / 255.0, rtol=1e-6)


# Files: orientation and channels


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("extension", ["jpg", "tif"])
def test_every_exif_orientation_is_turned_upright(tmp_path: Path, extension: str, orientation: int) -> None:
    """What the EXIF standard says row 0 and column 0 of the stored picture show, undone."""
    upright = np.full((24, 48, 3), 20, np.uint8)
    upright[:8, :16] = (250, 30, 30)  # red at the top left
    upright[:8, 32:] = (30, 250, 30)  # green at the top right
    upright[16:, :16] = (30, 30, 250)  # blue at the bottom left
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.transpose(1, 0, 2),
        6: np.rot90(upright, 1),  # the camera was turned: rotate 90 degrees clockwise to view
        7: upright[::-1, ::-1].transpose(1, 0, 2),
        8: np.rot90(upright, -1),
    }[orientation]
    path = save(
        tmp_path / f"a.{extension}", stored, "uint8", Orientation=orientation, jpeg__subsampling="4:4:4"
    )
    photo = read_photo(path)
    assert photo.size == (24, 48)
    np.testing.assert_allclose(rows(photo), srgb_decoded(upright / 255.0), atol=0.15)
    assert noted(photo, f"EXIF orientation {orientation}") == (orientation != 1)


def test_grey_becomes_three_equal_channels(tmp_path: Path) -> None:
    photo = read_photo(save(tmp_path / "a.png", picture(channels=1), "uint8"))
    expected = srgb_decoded(np.repeat(picture(channels=1), 3, axis=2) / 255.0)
    np.testing.assert_allclose(rows(photo), expected, rtol=1e-5, atol=1e-7)
    assert noted(photo, "grey")


@pytest.mark.parametrize("channels", [2, 4])
def test_straight_alpha_is_dropped_without_touching_colors(tmp_path: Path, channels: int) -> None:
    stored = picture(channels=channels)
    stored[..., -1] = 255
    opaque = read_photo(save(tmp_path / "a.png", stored, "uint8", oiio__UnassociatedAlpha=1))
    assert "alpha dropped" in opaque.notes
    stored[:10, :, -1] = 0
    half = read_photo(save(tmp_path / "b.png", stored, "uint8", oiio__UnassociatedAlpha=1))
    assert noted(half, "50.0% of the pixels were not opaque")
    colors = srgb_decoded(stored[..., :-1] / 255.0) * np.ones(3)
    np.testing.assert_allclose(rows(opaque), colors, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(rows(half), colors, rtol=1e-5, atol=1e-7)


def test_colors_multiplied_by_alpha_are_divided_again(tmp_path: Path) -> None:
    stored = np.full((16, 16, 4), 0.25, np.float32)
    stored[..., 3] = 0.5
    stored[0, 0] = 0.0
    photo = read_photo(save(tmp_path / "a.exr", stored, "float"))
    assert rows(photo)[5, 5].tolist() == [0.5, 0.5, 0.5]
    assert rows(photo)[0, 0].tolist() == [0.0, 0.0, 0.0]
    assert noted(photo, "divided by it")


def test_extra_channels_are_ignored_and_named(tmp_path: Path) -> None:
    spec = oiio.ImageSpec(20, 16, 5, "float")
    spec.channelnames = ("R", "G", "B", "depth.Z", "mask")
    output = oiio.ImageOutput.create("a.exr")
    assert output is not None
    assert output.open(str(tmp_path / "a.exr"), spec)
    stored = np.random.default_rng(0).random((16, 20, 5), np.float32)
    assert output.write_image(stored)
    assert output.close()
    photo = read_photo(tmp_path / "a.exr")
    np.testing.assert_array_equal(rows(photo), stored[..., :3])
    assert noted(photo, "mask")
    assert noted(photo, "depth.Z")
    assert noted(photo, "ignored, R, G, B used")


def test_palettes_are_looked_up(tmp_path: Path) -> None:
    colors = bytes([200, 10, 10, 10, 200, 10])
    indices = b"".join(b"\0" + bytes((x + y) % 2 for x in range(20)) for y in range(16))
    path = hand_made_png(tmp_path / "a.png", 20, 16, 3, indices, png_chunk(b"PLTE", colors))
    linear = rows(read_photo(path))
    np.testing.assert_allclose(linear[0, 0], srgb_decoded(np.array([200, 10, 10]) / 255.0), rtol=1e-5)
    np.testing.assert_allclose(linear[0, 1], srgb_decoded(np.array([10, 200, 10]) / 255.0), rtol=1e-5)


def test_the_content_decides_the_format_not_the_name(tmp_path: Path) -> None:
    save(tmp_path / "a.jpg", picture(), "uint8")
    (tmp_path / "a.jpg").rename(tmp_path / "100%? #04d")
    assert read_photo(tmp_path / "100%? #04d").size == (20, 32)


# Saturation


@pytest.mark.parametrize(("kind", "below", "clipped"), [("uint8", 254, 255), ("uint16", 65406, 65407)])
def test_a_pixel_is_saturated_when_any_channel_is_clipped(
    tmp_path: Path, kind: str, below: int, clipped: int
) -> None:
    stored = np.full((16, 20, 3), below, kind)
    stored[3, 5, 0] = clipped
    stored[4, 6, 2] = clipped
    expected = np.ones((16, 20), bool)
    expected[3, 5] = expected[4, 6] = False
    for photo in (
        read_photo(save(tmp_path / "a.png", stored, kind)),
        read_photo(tmp_path / "a.png", color_space="linear"),
        photo_from_array(stored),
    ):
        assert photo.unsaturated.dtype == torch.bool
        np.testing.assert_array_equal(photo.unsaturated[0, 0].numpy(), expected)


def test_saturation_is_judged_before_colors_are_converted(tmp_path: Path) -> None:
    stored = np.full((16, 16, 3), 250, np.uint8)
    stored[..., 1] = 100  # red exceeds 1 in Rec. 709, but the camera did not clip it
    photo = read_photo(save(tmp_path / "a.png", stored, "uint8", ICCProfile=icc_profile("Display P3")))
    assert float(photo.linear.max()) > 1.0
    assert bool(photo.unsaturated.all())


def test_transparency_does_not_count_as_saturation(tmp_path: Path) -> None:
    stored = picture(channels=4)
    stored[..., 3] = 255
    photo = read_photo(save(tmp_path / "a.png", stored, "uint8", oiio__UnassociatedAlpha=1))
    assert bool(photo.unsaturated.all())


# Files: errors, each one sentence that names the file


def broken_files(folder: Path) -> dict[str, tuple[Path, str]]:
    """Path of something that is no photo, and what the error should say about it."""
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    cases = {
        "missing": (folder / "missing.png", "does not exist"),
        "folder": (folder, "is a folder"),
    }
    (folder / "empty.png").touch()
    cases["empty"] = (folder / "empty.png", "is empty")
    (folder / "text.png").write_text("this is text, not a picture\n" * 20)
    cases["text"] = (folder / "text.png", "not an image that can be read")
    os.mkfifo(folder / "pipe.png")
    cases["pipe"] = (folder / "pipe.png", "pipe or a device")
    for extension, kind in (
        ("png", "uint8"),
        ("jpg", "uint8"),
        ("tif", "uint8"),
        ("exr", "half"),
        ("hdr", "float"),
    ):
        whole = save(folder / f"whole.{extension}", noise, kind).read_bytes()
        cut = folder / f"cut.{extension}"
        cut.write_bytes(whole[: len(whole) // 2])
        cases[f"cut {extension}"] = (cut, "damaged or cut short")
    cases["1x1"] = (
        save(folder / "one.png", noise[:1, :1], "uint8"),
        "1 x 1 pixels; both sides need at least 16",
    )
    cases["narrow"] = (save(folder / "narrow.png", noise[:, :15], "uint8"), "15 x 64 pixels")
    for value in (np.nan, np.inf, -np.inf):
        pixels = np.full((16, 16, 3), 0.5, np.float32)
        pixels[2, 3, 1] = value
        cases[str(value)] = (
            save(folder / f"{value}.exr", pixels, "half"),
            "NaN or infinity in 1 of its pixels",
        )
    huge = hand_made_png(folder / "huge.png", 100_000, 100_000, 2, bytes(100))
    cases["huge"] = (huge, "too large")
    wide = hand_made_png(folder / "wide.png", 32_769, 16, 2, bytes(100))
    cases["wide"] = (wide, "too large (32769 x 16)")
    return cases


BROKEN = (
    *("missing", "folder", "empty", "text", "pipe", "cut png", "cut jpg", "cut tif", "cut exr", "cut hdr"),
    *("1x1", "narrow", "nan", "inf", "-inf", "huge", "wide"),
)


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, str]]:
    return broken_files(tmp_path_factory.mktemp("broken"))


@pytest.mark.parametrize("case", BROKEN)
def test_what_is_no_photo_ends_in_one_sentence(
    broken: dict[str, tuple[Path, str]], case: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert set(broken) == set(BROKEN)
    path, words = broken[case]
    with pytest.raises(UserError) as caught:
        read_photo(path)
    message = str(caught.value)
    assert words in message
    assert str(path) in message
    assert "\n" not in message
    assert message.endswith(".")
    assert tuple(capfd.readouterr()) == ("", "")


def test_negative_light_is_clamped_with_a_note(tmp_path: Path) -> None:
    stored = np.full((16, 16, 3), 0.5, np.float32)
    stored[0, :8] = -0.25
    photo = read_photo(save(tmp_path / "a.exr", stored, "float"))
    assert float(photo.linear.min()) == 0.0
    assert noted(photo, "negative values in 3.1% of the pixels clamped")


def test_an_unknown_color_space_is_refused() -> None:
    """Below the public functions, whose signatures the suite's type checker guards first."""
    with pytest.raises(UserError, match="'cmyk' is unknown; choose one of auto, srgb"):
        photo_module._chosen("cmyk")


# Arrays


def test_arrays_are_srgb_unless_said_otherwise(tmp_path: Path) -> None:
    stored = picture()
    expected = read_photo(save(tmp_path / "a.png", stored, "uint8")).linear
    floats = stored.astype(np.float32) / 255.0
    channels_first = torch.from_numpy(stored.transpose(2, 0, 1).copy())
    for array in (
        stored,
        stored.astype(np.uint16) * 257,
        floats,
        floats.astype(np.float64),
        channels_first,
        channels_first[None],
        torch.from_numpy(floats.transpose(2, 0, 1).copy())[None].requires_grad_(),
        stored[::-1][::-1],
    ):
        photo = photo_from_array(array)
        torch.testing.assert_close(photo.linear, expected, rtol=1e-5, atol=1e-6)
        assert photo.source == "array"
        assert noted(photo, "colours read as sRGB")
        assert not photo.linear.requires_grad


def test_linear_arrays_pass_unchanged_and_are_never_clipped() -> None:
    light = torch.linspace(0.0, 5.0, 3 * 16 * 20).reshape(1, 3, 16, 20)
    photo = photo_from_array(light, color_space="linear")
    assert torch.equal(photo.linear, light)
    assert bool(photo.unsaturated.all())
    with pytest.raises(UserError, match=r'reaches 5 .*color_space="linear"'):
        photo_from_array(light)


def test_encoded_float_arrays_are_clipped_at_one() -> None:
    array = np.full((16, 16, 3), 0.9)
    array[1, 2, 0] = 1.0
    photo = photo_from_array(array)
    assert int((~photo.unsaturated).sum()) == 1
    assert not bool(photo.unsaturated[0, 0, 1, 2])


@pytest.mark.parametrize("channels", [0, 1, 2, 4])
def test_arrays_of_other_channel_counts(channels: int) -> None:
    stored = picture(channels=max(channels, 1))
    photo = photo_from_array(stored[..., 0] if channels == 0 else stored)
    colors = stored[..., :3] if channels == 4 else np.repeat(stored[..., :1], 3, axis=2)
    np.testing.assert_allclose(rows(photo), srgb_decoded(colors / 255.0), rtol=1e-5, atol=1e-7)
    assert noted(photo, "alpha dropped") == (channels in (2, 4))
    assert noted(photo, "grey") == (channels in (0, 1, 2))


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros((3, 32, 32), np.uint8), "expected an array of height, width"),
        (np.zeros((32, 32, 5), np.uint8), "expected an array of height, width"),
        (np.zeros((1, 32, 32, 3), np.uint8), "expected an array of height, width"),
        (torch.zeros(32, 32, 3), "expected a tensor of"),
        (torch.zeros(2, 3, 32, 32), "expected a tensor of"),
        (np.zeros(32, np.uint8), "expected an array"),
        (np.zeros((0, 32, 3), np.uint8), "at least 16"),
        (np.zeros((15, 32, 3), np.uint8), "32 x 15 pixels"),
        (np.zeros((32, 32, 3), np.int64), "holds int64"),
        (np.zeros((32, 32, 3), bool), "holds bool"),
        (np.full((32, 32, 3), np.nan), "NaN or infinity in 1024"),
    ],
    ids=lambda value: value if isinstance(value, str) else f"{type(value).__name__}{tuple(value.shape)}",
)
def test_arrays_that_are_no_photo_are_refused(array: Any, words: str) -> None:
    with pytest.raises(UserError, match=words):
        photo_from_array(array)


# Resizing


def test_shrinking_keeps_the_aspect_and_the_mean_of_linear_light() -> None:
    checker = np.indices((120, 200)).sum(axis=0) % 2 * 0.8
    photo = photo_from_array(checker, color_space="linear")
    small = resize_photo(photo, 50)
    assert small.size == (30, 50)
    inner = small.linear[..., 2:-2, 2:-2]
    assert float(inner.mean()) == pytest.approx(0.4, abs=1e-4)  # not the 0.33 of averaging in sRGB
    assert float(inner.std()) < 1e-3  # antialiased: no checks survive
    assert noted(small, "shrunk from 200 x 120 to 50 x 30 pixels")

    smooth = np.random.default_rng(0).random((96, 64))
    tall = resize_photo(photo_from_array(smooth, color_space="linear"), 37)
    assert tall.size == (37, 25)
    assert float(tall.linear.mean()) == pytest.approx(smooth.mean(), rel=0.01)


def test_a_shrunk_pixel_is_saturated_if_any_contributor_is() -> None:
    stored = np.full((64, 64, 3), 100, np.uint8)
    stored[20, 40, 1] = 255
    small = resize_photo(photo_from_array(stored), 16)
    saturated = ~small.unsaturated
    assert bool(saturated[0, 0, 5, 10])
    changed = (small.linear - small.linear[..., :1, :1]).abs().amax(dim=1, keepdim=True) > 1e-7
    assert torch.equal(saturated, changed)  # exactly the pixels the clipped one has reached
    assert 1 <= int(saturated.sum()) <= 9


def test_photos_are_never_enlarged() -> None:
    photo = photo_from_array(picture())
    same = resize_photo(photo, 1000)
    assert torch.equal(same.linear, photo.linear)
    assert noted(same, "not enlarged: kept at 32 x 20 pixels")
    assert resize_photo(photo, 32) is photo


def test_shrinking_below_the_minimum_is_refused() -> None:
    with pytest.raises(UserError, match="20 x 4 pixels"):
        resize_photo(photo_from_array(np.zeros((16, 80, 3), np.uint8)), 20)
