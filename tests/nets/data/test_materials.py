"""Where training materials come from: bad files are named before training starts, parts do not overlap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from nets.data import DataError
from nets.data.images import write_image
from nets.data.materials import Materials, PoolMaterials, StripMaterials, open_materials, strip_size
from nets.data.pool import MaterialPool, decode
from nets.data.strips import read_strip
from tests.helpers import seeded
from tests.training_files import entry, write_pool, write_strips


@pytest.fixture(scope="module")
def strips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_strips(tmp_path_factory.mktemp("strips"), 7, size=8)


@pytest.fixture(scope="module")
def pool(tmp_path_factory: pytest.TempPathFactory) -> Path:
    entries = [entry(f"brick_{n}", "procedural", "brick", n) for n in range(40)]
    entries += [entry(f"maker__{n}", "pbr", "maker", 100 + n) for n in range(40)]
    return write_pool(tmp_path_factory.mktemp("pool") / "pool", entries, size=8)


# Strips


def test_strips_are_drawn_with_replacement_and_by_the_stream(strips: Path) -> None:
    materials = StripMaterials(strips)
    first, again, other = (materials.draw(40, seeded(seed)) for seed in (1, 1, 2))
    assert first.validate().size == (8, 8)
    assert torch.equal(first.channels(), again.channels())
    assert not torch.equal(first.channels(), other.channels())
    known = [read_strip(path).svbrdf.channels()[0] for path in sorted(strips.iterdir())]
    drawn = [next(n for n, k in enumerate(known) if torch.equal(k, found)) for found in first.channels()]
    assert set(drawn) == set(range(7))
    assert materials.skipped == ()


@pytest.mark.parametrize(
    ("count", "holdout", "held"), [(7, 0.02, 1), (7, 0.25, 2), (2, 0.02, 1), (60, 0.1, 6)]
)
def test_the_parts_are_disjoint_and_complete(
    count: int, holdout: float, held: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(count):
        (tmp_path / f"{number:03}.png").touch()
    monkeypatch.setattr("nets.data.materials.strip_size", lambda path: (32, 8))
    training, validation, whole = (
        StripMaterials(tmp_path, part, holdout).paths for part in ("train", "validation", None)
    )
    assert len(validation) == held
    assert not set(training) & set(validation)
    assert sorted([*training, *validation]) == whole == sorted(tmp_path.iterdir())


def test_a_single_strip_serves_both_ends(strips: Path, tmp_path: Path) -> None:
    (tmp_path / "only.png").write_bytes((strips / "000.png").read_bytes())
    for part in ("train", "validation"):
        assert [path.name for path in StripMaterials(tmp_path, part).paths] == ["only.png"]


def test_bad_strips_are_named_and_left_out(strips: Path, tmp_path: Path) -> None:
    whole = [path.read_bytes() for path in sorted(strips.iterdir())]
    for number in range(3):
        (tmp_path / f"good{number}.PNG").write_bytes(whole[number])
    (tmp_path / "truncated.png").write_bytes(whole[3][:-20])
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "text.png").write_text("this is no picture, whatever its name may say")
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "notes.txt").write_text("ignored")
    write_image(tmp_path / "photo.png", np.zeros((8, 12, 3), np.uint8))
    write_strips(tmp_path / "larger", 1, size=16)
    (tmp_path / "larger" / "000.png").rename(tmp_path / "larger.png")
    (tmp_path / "larger").rmdir()

    materials = StripMaterials(tmp_path)
    assert [path.name for path in materials.paths] == ["good0.PNG", "good1.PNG", "good2.PNG"]
    reasons = "\n".join(materials.skipped)
    for said in (
        "truncated.png is truncated",
        "empty.png cannot be read",
        "text.png is not a PNG",
        "folder.png cannot be read",
        "photo.png is 12 x 8 pixels, which is not four or five square tiles",
        "larger.png is 64 x 16 pixels, most others are 32 x 8",
    ):
        assert said in reasons
    assert len(materials.skipped) == 6
    materials.draw(10, seeded(0)).validate()


def test_a_strip_damaged_inside_is_replaced_with_a_warning(strips: Path, tmp_path: Path) -> None:
    whole = [path.read_bytes() for path in sorted(strips.iterdir())]
    middle = len(whole[0]) // 2
    damaged = whole[0][:middle] + b"\0" * 40 + whole[0][middle + 40 :]
    (tmp_path / "0.png").write_bytes(damaged)
    (tmp_path / "1.png").write_bytes(whole[1])
    materials = StripMaterials(tmp_path)
    assert len(materials.paths) == 2  # its ends are whole
    with pytest.warns(UserWarning, match=r"skipped: .*0\.png"):
        drawn = materials.draw(8, seeded(0))
    expected = read_strip(tmp_path / "1.png").svbrdf.channels()
    assert torch.equal(drawn.channels(), expected.expand(8, -1, -1, -1))
    (tmp_path / "1.png").write_bytes(damaged)
    with (
        pytest.warns(UserWarning, match="skipped"),
        pytest.raises(DataError, match="none of the 2 strips such as"),
    ):
        materials.draw(1, seeded(0))


def test_folders_without_strips_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="absent is not a folder"):
        StripMaterials(tmp_path / "absent")
    with pytest.raises(DataError, match=r"holds no usable strip \(\.png\)"):
        StripMaterials(tmp_path)
    (tmp_path / "a.png").write_text("no picture at all, just some text")
    with pytest.raises(DataError, match=r"holds no usable strip \(.*a\.png is not a PNG\)"):
        StripMaterials(tmp_path)


def test_the_size_is_read_from_the_header(strips: Path, tmp_path: Path) -> None:
    assert strip_size(strips / "000.png") == (32, 8)
    nothing = bytearray((strips / "000.png").read_bytes())
    nothing[16:24] = bytes(8)
    (tmp_path / "nothing.png").write_bytes(nothing)
    with pytest.raises(DataError, match="is 0 x 0 pixels"):
        strip_size(tmp_path / "nothing.png")


# Pools


def test_a_pool_is_drawn_by_shares_of_what_it_holds(pool: Path) -> None:
    opened = MaterialPool(pool)
    assert PoolMaterials(opened).shares is None
    assert PoolMaterials(opened, {"infinigen": 1.0}).shares is None
    some = PoolMaterials(opened, {"procedural": 0.5, "infinigen": 0.2})
    assert some.shares == {"procedural": 0.5}
    bricks = {number for number, entry in enumerate(opened.index) if entry.kind == "procedural"}
    drawn = some.draw(60, seeded(0)).channels()
    known = PoolMaterials(opened).pool
    stored = [decode(known[number]).channels()[0] for number in range(len(known))]
    found = {next(n for n, k in enumerate(stored) if torch.equal(k, one)) for one in drawn}
    assert found <= bricks
    assert len(found) > 10


def test_both_kinds_of_folder_open_alike(pool: Path, strips: Path) -> None:
    for folder, kind in ((pool, PoolMaterials), (strips, StripMaterials)):
        parts = [open_materials(folder, part, {"procedural": 1.0}) for part in ("train", "validation", None)]
        for materials in parts:
            assert isinstance(materials, kind)
            assert isinstance(materials, Materials)
            first, again = (materials.draw(3, seeded(5)).channels() for _ in range(2))
            assert torch.equal(first, again)
            assert first.shape == (3, 10, 8, 8)
    names = [
        {entry.name for entry in MaterialPool(pool, part=part).index}  # type: ignore[arg-type]
        for part in ("train", "validation", None)
    ]
    assert names[0] | names[1] == names[2]
    assert not names[0] & names[1]


def test_what_is_neither_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="holds no usable strip"):
        open_materials(tmp_path)
    (tmp_path / "index.json").write_text("{}")
    with pytest.raises(DataError, match="not a complete material pool"):
        open_materials(tmp_path)
