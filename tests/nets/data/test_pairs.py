"""Pairs are two photos of one surface, pixel on pixel, and bad scenes are known before training starts."""

from pathlib import Path

import numpy as np
import pytest
import torch

from nets.color import srgb_to_linear, to_network_input
from nets.data import DataError
from nets.data.images import write_image
from nets.data.pairs import SCALE, PairBatch, PhotoPairs, decode_photo, encode_photo
from tests.helpers import seeded


def write_photo(path: Path, height: int, width: int, level: int) -> None:
    """A photo whose red and green say where a pixel lies, and whose blue says which photo it is."""
    path.parent.mkdir(parents=True, exist_ok=True)
    y, x = np.mgrid[:height, :width]
    pixels = np.stack([2 * y, 2 * x, np.full_like(x, level)], axis=2)
    write_image(path, pixels.astype(np.uint8))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("scenes")
    for number in range(4):
        write_photo(root / "square" / f"{number:02}.png", 80, 80, 10 + 10 * number)
    for number in range(2):
        write_photo(root / "wide" / f"IMG_{number}.png", 60, 90, 110 + 10 * number)
    (root / ".partial").mkdir()
    write_photo(root / "contact_sheet.png", 10, 10, 0)
    return root


def test_a_pair_shows_one_surface_pixel_on_pixel(folder: Path) -> None:
    pairs = PhotoPairs(folder, size=128, crop=40)
    assert (len(pairs), pairs.scenes, pairs.skipped) == (2, ("square", "wide"), ())
    batch = pairs.sample(16, 40, seeded(0))
    assert batch.a.shape == batch.b.shape == (16, 3, 40, 40)
    assert batch.a.dtype == torch.float32
    torch.testing.assert_close(batch.a[:, :2], batch.b[:, :2], rtol=0, atol=0)


def test_a_pair_is_two_photos_of_one_scene_in_any_order(folder: Path) -> None:
    batch = PhotoPairs(folder, size=128, crop=40).sample(150, 4, seeded(0))
    first, second = ((encode_photo(photo)[:, 2, 0, 0] // 10).tolist() for photo in (batch.a, batch.b))
    seen = set(zip(first, second, strict=True))
    square = {(a, b) for a in range(1, 5) for b in range(1, 5) if a != b}
    assert seen == square | {(11, 12), (12, 11)}


def test_a_square_is_most_of_the_photo_turned_and_mirrored(folder: Path) -> None:
    (photos,) = (
        decode_photo(encode_photo(b)) for b in [PhotoPairs(folder, crop=32).sample(80, 32, seeded(1)).a]
    )
    codes = encode_photo(photos).float() / 2.0
    rows, columns = codes[:, 0], codes[:, 1]
    extents, poses = [], set()
    for y, x in zip(rows, columns, strict=True):
        turned = float((y[:, 0] - y[:, -1]).abs().max()) > 1.0  # rows of the photo lie along columns
        down, across = (x, y) if turned else (y, x)
        poses.add((turned, bool(down[0, 0] < down[-1, 0]), bool(across[0, 0] < across[0, -1])))
        extents.append((float(down.max() - down.min()), float(across.max() - across.min())))
    assert len(poses) == 8
    assert all(abs(height - width) <= 1.5 for height, width in extents)
    heights = [height for height, _ in extents]
    assert SCALE[0] * 60 - 3.0 <= min(heights) < 40.0
    assert 75.0 < max(heights) <= 80.0


def test_nothing_is_enlarged(folder: Path) -> None:
    batch = PhotoPairs(folder, size=128, crop=60).sample(12, 60, seeded(0))
    codes = encode_photo(batch.a)
    wide = codes[:, 2, 0, 0] > 100
    # A whole short side at the photo's own pixels: every code of the ramp occurs, none is averaged.
    assert {len(photo.unique()) for photo in codes[wide][:, 0]} == {60}


def test_large_photos_are_held_small(tmp_path: Path) -> None:
    for number in range(2):
        write_photo(tmp_path / "scene" / f"{number}.png", 96, 120, 90)
    pairs = PhotoPairs(tmp_path, size=48, crop=48)
    (held,) = pairs._photos
    assert (held.shape, held.dtype) == ((2, 3, 48, 60), torch.uint8)
    assert abs(int(held[0, 2].max()) - 90) <= 1
    assert abs(int(held[0, 2].min()) - 90) <= 1


def test_light_is_decoded_with_the_curve_of_files() -> None:
    codes = torch.arange(256, dtype=torch.uint8).expand(3, 2, 256)
    torch.testing.assert_close(decode_photo(codes), srgb_to_linear(codes / 255.0))
    assert torch.equal(encode_photo(decode_photo(codes)), codes)


def test_networks_see_pairs_as_any_other_photo() -> None:
    batch = PairBatch(torch.rand(2, 3, 4, 4), torch.rand(2, 3, 4, 4))
    for seen, photo in ((batch.network_input, batch.a), (batch.network_input_b, batch.b)):
        assert torch.equal(seen, to_network_input(photo))
        assert seen.is_contiguous(memory_format=torch.channels_last)


def test_the_generator_alone_decides(folder: Path) -> None:
    pairs = PhotoPairs(folder, crop=32)
    first, again = (pairs.sample(6, 32, seeded(5)) for _ in range(2))
    other = pairs.sample(6, 32, seeded(6))
    assert torch.equal(first.a, again.a)
    assert torch.equal(first.b, again.b)
    assert not torch.equal(first.a, other.a)


def test_bad_photos_and_scenes_are_named_and_skipped(folder: Path, tmp_path: Path) -> None:
    for number in range(3):
        write_photo(tmp_path / "good" / f"{number}.png", 64, 64, 50)
    damaged = tmp_path / "good" / "1.png"
    write_image(damaged, np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8))
    damaged.write_bytes(damaged.read_bytes()[:9000])
    write_photo(tmp_path / "lonely" / "0.png", 64, 64, 50)
    write_photo(tmp_path / "mixed" / "0.png", 64, 64, 50)
    write_photo(tmp_path / "mixed" / "1.png", 64, 66, 50)
    write_photo(tmp_path / "halved" / "0.png", 64, 64, 50)
    (tmp_path / "halved" / "1.png").write_text("not a photo")
    for number in range(2):
        write_photo(tmp_path / "small" / f"{number}.png", 31, 64, 50)
    (tmp_path / "empty").mkdir()
    pairs = PhotoPairs(tmp_path, crop=32)
    assert pairs.scenes == ("good",)
    reasons = "\n".join(pairs.skipped)
    assert len(pairs.skipped) == 7
    for expected in (
        f"{tmp_path}/empty holds no photos; a pair needs two",
        f"{damaged} is damaged or truncated",
        f"{tmp_path}/halved/1.png is not a readable image",
        f"{tmp_path}/halved holds one photo that can be read; a pair needs two",
        f"{tmp_path}/lonely holds one photo; a pair needs two",
        "mixed holds photos of different sizes: 0.png with 64 x 64 pixels, 1.png with 66 x 64 pixels",
        "small holds photos smaller than the crop of 32 pixels: 0.png has 64 x 31",
    ):
        assert expected in reasons


def test_a_folder_without_a_pair_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is not a folder"):
        PhotoPairs(tmp_path / "absent")
    with pytest.raises(DataError, match="holds no folders"):
        PhotoPairs(tmp_path)
    for number in range(2):
        write_photo(tmp_path / f"{number}.png", 64, 64, 50)
    with pytest.raises(DataError, match="holds photos, not scenes; give the folder that holds it"):
        PhotoPairs(tmp_path, crop=32)
    for number in range(7):
        write_photo(tmp_path / f"scene{number}" / "0.png", 64, 64, 50)
    with pytest.raises(DataError, match=r"no scene to train on: .*scene0 holds one photo.*; and 2 more"):
        PhotoPairs(tmp_path, crop=32)


def test_crops_that_were_not_checked_are_refused(folder: Path) -> None:
    pairs = PhotoPairs(folder, crop=32)
    with pytest.raises(ValueError, match="from 1 to 32 pixels, got 33"):
        pairs.sample(1, 33, seeded(0))
    with pytest.raises(ValueError, match="from 1 to 64 pixels, got 65"):
        PhotoPairs(folder, size=64, crop=65)


@pytest.mark.parametrize(
    ("count", "kept"), [(3, []), (4, [3]), (11, [3]), (13, [3, 11])], ids=lambda value: str(value)
)
def test_some_scenes_are_kept_from_training_where_there_are_many(
    tmp_path: Path, count: int, kept: list[int]
) -> None:
    for number in range(count):
        for photo in range(2):
            write_photo(tmp_path / f"scene{number:02}" / f"{photo}.png", 8, 8, 10 * number)
    pairs = PhotoPairs(tmp_path, crop=8)
    train, validation = pairs.parts()
    names = [f"scene{number:02}" for number in range(count)]
    if not kept:
        assert train is validation is pairs
        return
    assert validation.scenes == tuple(names[number] for number in kept)
    assert train.scenes == tuple(name for name in names if name not in validation.scenes)
    for part in (train, validation):
        blues = encode_photo(part.sample(60, 8, seeded(0)).a)[:, 2, 0, 0].tolist()
        assert {f"scene{blue // 10:02}" for blue in blues} == set(part.scenes)
