"""Videos become scenes whose photos lie pixel on pixel under different lights; bad ones are named."""

import math
import sys
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nets.color import linear_to_srgb, luminance
from nets.data import DataError, frames, videos
from nets.data.frames import read_frames
from nets.data.images import read_image, write_image
from nets.data.pairs import PhotoPairs, decode_photo
from nets.data.pool_format import from_planes
from nets.data.procedural import generate
from nets.data.selection import LIGHT_CHANGE, choose_frames, find_crops
from nets.data.stabilize import corner_motion, normalize_contrast, stabilize, warp
from nets.data.videos import VideoSettings, convert, main, make_scenes
from nets.render import PointLight, render
from tests.helpers import seeded

IDENTITY = torch.eye(3, dtype=torch.float64)
HEIGHT, WIDTH = 144, 192
BLURRED = (4, 10)
"""Frames of the synthetic video that were exposed during a jolt."""


def shake(seed: int) -> Float[Tensor, "3 3"]:
    """A few pixels of shift, half a degree of turn, a little zoom and perspective."""
    size = torch.tensor([[0.008, 0.008, 0.04], [0.008, 0.008, 0.04], [0.004, 0.004, 0.0]])
    return IDENTITY + (torch.rand(3, 3, generator=seeded(seed)) * 2.0 - 1.0).double() * size


def film(count: int, *, moving: bool = True) -> tuple[list[Float[Tensor, "1 3 h w"]], list[Tensor]]:
    """Render a procedural material under a light on its way, seen by a camera that shakes as told.

    Returns the frames, sRGB-encoded, and the homographies from the first frame to each.
    """
    surface = from_planes(generate("terrazzo", 224, 3))
    view = torch.diag(torch.tensor([WIDTH / 224, HEIGHT / 224, 1.0], dtype=torch.float64))
    pictures, truth = [], []
    for number in range(count):
        angle = 2.0 * math.pi * number / count
        light = PointLight.at((math.cos(angle), math.sin(2.0 * angle), 1.4), 0.8, "inverse_square")
        encoded = linear_to_srgb(render(surface, light).clamp(0.0, 1.0))
        homography = shake(number) if moving and number else IDENTITY
        picture = warp(encoded, view @ torch.linalg.inv(homography), HEIGHT, WIDTH, mode="bicubic")
        if number in BLURRED:
            picture = functional.avg_pool2d(picture, (1, 11), 1, (0, 5))
        noise = torch.randn(picture.shape, generator=seeded(number)) * 0.005
        pictures.append((picture + noise).clamp(0.0, 1.0))
        truth.append(homography)
    return pictures, truth


def pixels_of(picture: Float[Tensor, "1 3 h w"]) -> np.ndarray:
    return np.ascontiguousarray((picture[0] * 255.0).round().byte().permute(1, 2, 0).numpy())


def write_video(path: Path, pictures: Sequence[np.ndarray], codec: str = "mpeg4") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(15))
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 8_000_000
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return path


@pytest.fixture(scope="module")
def filmed() -> tuple[list[Float[Tensor, "1 3 h w"]], list[Tensor]]:
    return film(16)


@pytest.fixture(scope="module")
def video(filmed: tuple[list[Tensor], list[Tensor]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("film") / "floor.mp4", [pixels_of(p) for p in filmed[0]])


@pytest.fixture(scope="module")
def scenes(video: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "scenes"
    done = convert([video], out, VideoSettings(crops=2, frames=6, size=64))
    assert done.skipped == done.present == ()
    assert done.scenes == (out / "floor-1", out / "floor-2")
    return out


def load(folder: Path) -> Float[Tensor, "photos 3 h w"]:
    photos = [torch.from_numpy(read_image(path)[0]).permute(2, 0, 1) for path in sorted(folder.glob("*"))]
    return decode_photo((torch.stack(photos) * 255.0).round().byte())


def test_a_known_shake_is_found_under_a_moving_light(filmed: tuple[list[Tensor], list[Tensor]]) -> None:
    pictures, truth = ([part[frame] for frame in range(9) if frame not in BLURRED] for part in filmed)
    found = stabilize([luminance(picture) for picture in pictures])
    known = torch.stack(truth)
    moved = corner_motion(known, IDENTITY.expand_as(known), HEIGHT, WIDTH)[1:]
    assert float(moved.min()) > 1.5
    error = corner_motion(found.homographies, known, HEIGHT, WIDTH)
    assert float(error.max()) < 0.5, error
    assert bool(found.reliable.all())
    assert torch.allclose(found.homographies[0], IDENTITY, atol=1e-9)


def test_a_frame_of_something_else_is_told_and_leads_no_other_astray(
    filmed: tuple[list[Tensor], list[Tensor]],
) -> None:
    part = slice(5, 10)
    start = torch.linalg.inv(filmed[1][5])
    pictures = [luminance(picture) for picture in filmed[0][part]]
    pictures[2] = torch.rand(1, 1, HEIGHT, WIDTH, generator=seeded(0))
    found = stabilize(pictures)
    assert found.reliable.tolist() == [True, True, False, True, True]
    error = corner_motion(found.homographies, torch.stack(filmed[1][part]) @ start, HEIGHT, WIDTH)
    assert float(error[found.reliable].max()) < 0.5


def test_local_contrast_forgets_slow_light_and_clipped_pixels() -> None:
    texture = torch.rand(1, 1, 40, 60, generator=seeded(0)) * 0.3 + 0.2
    slope = torch.linspace(0.6, 1.6, 60)
    first, second = (normalize_contrast(image)[0] for image in (texture, texture * slope))
    correlation = torch.corrcoef(torch.stack([first.flatten(), second.flatten()]))[0, 1]
    assert float(correlation) > 0.99
    texture[..., :20, :20] = 1.0
    contrast, weight = normalize_contrast(texture)
    assert float(contrast[..., :20, :20].abs().max()) == float(weight[..., :20, :20].max()) == 0.0
    assert float(weight[..., 30:, 30:].min()) == 1.0


def test_a_warp_samples_where_the_homography_points() -> None:
    image = torch.rand(1, 2, 6, 8, generator=seeded(0))
    assert torch.allclose(warp(image, IDENTITY, 6, 8), image, atol=1e-6)
    one_right = IDENTITY.clone()
    one_right[0, 2] = 2.0 / 8
    moved = warp(image, one_right, 6, 8)
    assert torch.allclose(moved[..., :-1], image[..., 1:], atol=1e-5)
    assert float(moved[..., -1].abs().max()) < 1e-5
    assert float(corner_motion(one_right, IDENTITY, 6, 8)) == pytest.approx(1.0)


def test_photos_of_a_scene_lie_pixel_on_pixel(scenes: Path) -> None:
    for scene in sorted(path for path in scenes.iterdir() if path.is_dir()):
        photos = load(scene)
        assert len(photos) == 6
        assert photos.shape[1:] == (3, 64, 64)
        logarithm = (luminance(photos) + 0.01).log()
        detail = logarithm - functional.avg_pool2d(logarithm, 7, 1, 3, count_include_pad=False)
        detail = detail.clamp(-0.5, 0.5)  # glints move with the light
        for number, photo in enumerate(detail):
            others = detail[[other for other in range(len(detail)) if other != number]].mean(dim=0)
            likeness = {}
            for shift in ((down, right) for down in (-1, 0, 1) for right in (-1, 0, 1)):
                both = torch.stack([others[0], photo[0].roll(shift, (0, 1))])[:, 4:-4, 4:-4]
                likeness[shift] = float(torch.corrcoef(both.flatten(1))[0, 1])
            assert max(likeness, key=lambda shift: likeness[shift]) == (0, 0), likeness
            assert likeness[0, 0] > 0.3


def test_photos_of_a_scene_differ_in_light(scenes: Path) -> None:
    photos = load(scenes / "floor-1")
    blocks = functional.avg_pool2d(luminance(photos), 8)[:, 0].flatten(1)
    patterns = (blocks + 0.01).log()
    patterns = patterns - patterns.mean(dim=1, keepdim=True)
    difference = (patterns[:, None] - patterns[None]).square().mean(dim=-1).sqrt()
    assert float(difference[~torch.eye(len(photos), dtype=torch.bool)].min()) > 0.9 * LIGHT_CHANGE


def test_scenes_are_what_pairs_are_drawn_from(scenes: Path) -> None:
    sheet, _ = read_image(scenes / "contact_sheet.png")
    assert sheet.shape[0] > 2 * 112
    pairs = PhotoPairs(scenes, crop=64)
    assert (pairs.scenes, pairs.skipped) == (("floor-1", "floor-2"), ())
    assert not list(scenes.glob(".*"))


def test_farthest_frames_are_chosen_and_bad_ones_are_not() -> None:
    x = torch.linspace(-1.0, 1.0, 64).expand(64, 64)
    texture = 0.2 + 0.1 * torch.rand(64, 64, generator=seeded(0))
    slopes = [0.0, 0.02, 0.04, 0.3, 0.31, 0.6, 0.6, 0.62, -0.3, -0.6]
    photos = torch.stack([texture * (1.0 + slope * x) for slope in slopes])[:, None].repeat(1, 3, 1, 1)
    photos[5] = functional.avg_pool2d(photos[5], (9, 9), 1, 4, count_include_pad=False)
    photos[9, :, :32] = 1.0
    for seed in range(3):
        chosen = choose_frames(photos, 4, seeded(seed))
        assert 5 not in chosen
        assert 9 not in chosen
        assert sorted(round(slopes[row], 1) for row in chosen) == [-0.3, 0.0, 0.3, 0.6]
    assert len(choose_frames(photos * 0.0, 4, seeded(0))) == 0
    assert len(choose_frames(photos[:3], 4, seeded(0))) == 1


def test_crops_are_lit_textured_and_where_all_frames_see() -> None:
    survey = 0.2 + 0.1 * torch.rand(5, 3, 90, 160, generator=seeded(0))
    room = torch.ones(90, 160, dtype=torch.bool)
    assert len(find_crops(survey, room, 1, 60.0)) == 1
    assert find_crops(survey, room, 3, 91.0) == []
    assert find_crops(survey * 0.0 + 0.3, room, 3, 20.0) == []  # nothing to see
    room[:, :70] = False
    survey[:, :, :10] = 1.0  # a clipped stripe
    ((x, y, half_width, half_height),) = find_crops(survey, room, 1, 40.0)
    assert (x - half_width) >= 2 * 70 / 160 - 1.0 - 1e-9
    assert half_width * 160 == pytest.approx(half_height * 90)
    assert max(x + half_width, y + half_height) <= 1.0 + 1e-9
    three = find_crops(0.2 + 0.1 * torch.rand(5, 3, 90, 160), torch.ones(90, 160).bool(), 3, 40.0)
    assert len(three) == 3


def test_a_camera_that_stands_still_is_left_alone() -> None:
    pictures, _ = film(7, moving=False)
    codes = [pixels_of(picture) for frame, picture in enumerate(pictures) if frame not in BLURRED]
    pushed = [*codes[:5], np.roll(codes[5], 8, axis=1)]
    for given, tripod, lost in ((codes, False, 0), (codes, True, 0), (pushed, False, 1)):
        homographies, usable = videos._register(given, tripod)
        assert torch.equal(homographies, IDENTITY.expand(6, 3, 3))
        assert int((~usable).sum()) == lost


def test_of_a_long_video_the_sharper_frames_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frames, "KEPT_FRAMES", 6)
    checks = np.indices((64, 64)).sum(axis=0) // 4 % 2
    pictures = []
    for number in range(37):
        contrast = 100 if number % 2 else 20
        picture = 60 + 2 * number + checks * contrast
        pictures.append(np.repeat(picture[..., None], 3, axis=2).astype(np.uint8))
    kept = read_frames(write_video(tmp_path / "long.mp4", pictures))
    assert 6 <= len(kept) < 12
    assert all(int(frame.max()) - int(frame.min()) > 70 for frame in kept)
    assert [float(frame.min()) for frame in kept] == sorted(float(frame.min()) for frame in kept)


def test_bad_videos_are_named_and_skipped(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grey = np.full((96, 128, 3), 90, dtype=np.uint8)
    rng = np.random.default_rng(0)
    textured = rng.integers(60, 140, (96, 128, 3), dtype=np.uint8)
    short = write_video(tmp_path / "short.mp4", [grey] * 3)
    static = write_video(tmp_path / "static.mp4", [textured] * 8)
    plain = write_video(tmp_path / "plain.mp4", [grey] * 8)
    text = tmp_path / "text.mp4"
    text.write_text("not a video")
    damaged = tmp_path / "damaged.mp4"
    damaged.write_bytes(video.read_bytes()[:20_000])
    out = tmp_path / "out"
    bad = [short, static, plain, text, damaged, tmp_path / "absent.mp4"]
    assert main([*map(str, bad), "--out", str(out), "--size", "48", "--tripod"]) == 2
    said = capsys.readouterr().err
    for expected in (
        f"{short} gives 3 frames, fewer than 5: it is too short",
        f"{static}: no crop has 5 sharp frames with different light; the best has 1",
        f"{plain}: no crop of 48 pixels is in all frames, well lit and textured",
        f"{text} gives 0 frames, fewer than 5: it is damaged or not a video",
        f"{damaged} gives 0 frames, fewer than 5: it is damaged or not a video",
        f"{tmp_path}/absent.mp4 is not a file",
        "none of 6 videos gave a scene",
    ):
        assert expected in said
    assert not out.exists()


def test_one_bad_video_costs_no_other(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = (torch.rand(5, 3, 32, 32) * 255.0).byte()
    monkeypatch.setattr(videos, "make_scenes", lambda frames, settings: [made, made])
    text = tmp_path / "text.mp4"
    text.write_text("not a video")
    out = tmp_path / "out"
    arguments = [str(text), str(video), "--out", str(out)]
    assert main(arguments) == 0
    assert sorted(path.name for path in out.iterdir()) == ["contact_sheet.png", "floor-1", "floor-2"]
    assert [path.name for path in sorted((out / "floor-2").iterdir())] == [f"0{n}.png" for n in range(5)]
    assert "2 new scenes, 0 videos done before, 1 skipped" in capsys.readouterr().out
    before = (out / "floor-1" / "00.png").stat().st_mtime_ns
    assert main(arguments) == 0
    assert "0 new scenes, 1 videos done before, 1 skipped" in capsys.readouterr().out
    assert (out / "floor-1" / "00.png").stat().st_mtime_ns == before


def test_a_disk_that_is_full_leaves_nothing_behind(
    video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = (torch.rand(5, 3, 32, 32) * 255.0).byte()

    def write(path: Path, pixels: np.ndarray) -> None:
        if path.name == "03.png":
            raise DataError(f"{path} cannot be written: no space left")
        write_image(path, pixels)

    monkeypatch.setattr(videos, "make_scenes", lambda frames, settings: [made])
    monkeypatch.setattr(videos, "write_image", write)
    assert main([str(video), "--out", str(tmp_path / "out")]) == 2
    assert "cannot be written: no space left" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_mistakes_of_the_command_line_are_one_sentence(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def said(*arguments: str) -> str:
        assert main([str(video), *arguments]) == 2
        return capsys.readouterr().err

    occupied = tmp_path / "file"
    occupied.write_text("")
    assert said("--out", str(occupied)).count("\n") == 1
    assert "of one name" in said("elsewhere/floor.mov", "--out", str(tmp_path / "out"))
    assert "at least 16 pixels, got 4" in said("--size", "4", "--out", str(tmp_path / "out"))
    monkeypatch.setitem(sys.modules, "av", None)
    assert "needs PyAV" in said("--out", str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_too_few_frames_that_fit_are_told() -> None:
    noise = [pixels_of(torch.rand(1, 3, 64, 64, generator=seeded(number))) for number in range(6)]
    with pytest.raises(DataError, match=r"only \d of 6 frames could be registered"):
        make_scenes(noise, VideoSettings(size=16))
