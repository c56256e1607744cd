"""The pool stores what the readers read, samples as asked, and is built whole, resumably and repeatably."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from nets.data import DataError, pool
from nets.data.images import write_image
from nets.data.pool import Entry, MaterialPool, build_pool, decode, encode, make, part_of, plan
from nets.data.procedural import FAMILIES, HELD_OUT_FAMILIES, MaterialMaps
from nets.svbrdf import SVBRDF


def write_material(folder: Path, size: int, base: float, seed: int = 0, lean: float = 0.1) -> None:
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    colour = np.full((size, size, 3), base) + rng.random((size, size, 3)) * 0.1
    slopes = rng.normal(0, lean, (size, size, 2))
    normal = np.concatenate([slopes, np.ones((size, size, 1))], axis=2)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    for name, values in (
        ("basecolor", colour),
        ("normal", (normal + 1) / 2),
        ("roughness", rng.random((size, size, 1))),
    ):
        write_image(folder / f"{name}.png", np.rint(values * 255).astype(np.uint8))


def generate_waves(family: str, size: int, seed: int) -> MaterialMaps:
    """A stand-in for the families, which have tests of their own."""
    rng = np.random.default_rng([len(family), seed])
    ramp = np.linspace(0.0, rng.uniform(0.1, 0.3), size, dtype=np.float32)
    plane = np.broadcast_to(ramp, (size, size))
    colour = np.repeat(plane[..., None], 3, axis=2)
    return MaterialMaps(height=plane, diffuse=colour, roughness=plane + np.float32(0.2), specular=colour)


@pytest.fixture(autouse=True, scope="module")
def _light_families() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool, "generate", generate_waves)
        yield


@pytest.fixture(scope="module")
def materials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("materials")
    write_material(folder / "maker__small", 24, 0.2, 1)
    write_material(folder / "maker__large", 64, 0.5, 2)
    write_material(folder / "infinigen__Thing_1", 48, 0.8, 3)
    write_material(folder / "infinigen__Broken_1", 48, 0.8, 4, lean=20.0)
    return folder


@pytest.fixture(scope="module")
def built(materials: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("pool") / "pool"
    build_pool(out, size=32, procedural=3, folders=[materials], seed=7, workers=0)
    return out


def test_encoding_round_trip_keeps_dark_colours() -> None:
    maps = torch.rand(2, 10, 8, 8, generator=torch.Generator().manual_seed(0))
    maps[:, 2] = maps[:, 2] * 0.5 + 0.5
    normal = maps[:, :3] / torch.linalg.vector_norm(maps[:, :3], dim=1, keepdim=True)
    material = SVBRDF(normal, maps[:, 3:6] * 0.02, maps[:, 6:7].clamp(min=0.01), maps[:, 7:10])
    again = decode(encode(material)).validate()
    torch.testing.assert_close(again.normal, material.normal, atol=0.008, rtol=0)
    torch.testing.assert_close(again.diffuse, material.diffuse, atol=6e-4, rtol=0)  # linear codes: 2e-3
    torch.testing.assert_close(again.roughness, material.roughness, atol=0.0021, rtol=0)
    torch.testing.assert_close(again.specular, material.specular, atol=0.005, rtol=0)
    extremes = torch.tensor([0, 255], dtype=torch.uint8)
    for value in extremes:
        decode(torch.full((1, 10, 2, 2), int(value), dtype=torch.uint8)).validate()


def test_what_a_pool_holds(built: Path) -> None:
    opened = MaterialPool(built)
    kinds = [(entry.name.split("_")[0], entry.kind, entry.variant) for entry in opened.index]
    assert [kind for kind in kinds if kind[1] == "pbr"] == [
        ("infinigen", "pbr", "whole"),
        ("infinigen", "pbr", "crop"),
        ("maker", "pbr", "whole"),  # the large one
        ("maker", "pbr", "crop"),
        ("maker", "pbr", "whole"),  # the small one gives no crop
    ]
    assert sum(entry.kind == "procedural" for entry in opened.index) == 3
    assert opened.size == 32
    assert len(opened) == 8
    assert sorted(path.name for path in built.iterdir()) == ["index.json", "materials.npy"]
    record = json.loads((built / "index.json").read_text())
    assert record["left_out"] == ["infinigen__Broken_1"]
    assert {entry.licence for entry in opened.index if entry.collection == "infinigen"} == {
        "BSD-3-Clause (generator)"
    }
    for position in range(len(opened)):
        assert decode(opened[position]).validate().size == (32, 32)


def test_pictures_are_those_of_the_sources(built: Path) -> None:
    opened = MaterialPool(built)
    diffuse = {
        (entry.name, entry.variant): float(decode(opened[position]).diffuse.mean())
        for position, entry in enumerate(opened.index)
    }
    small, large = diffuse["maker__small", "whole"], diffuse["maker__large", "whole"]
    assert small == pytest.approx(0.0513, abs=0.01)  # sRGB 0.25
    assert large == pytest.approx(0.264, abs=0.01)  # sRGB 0.55
    assert diffuse["maker__large", "crop"] == pytest.approx(large, abs=0.01)


def test_held_out_families_are_not_planned() -> None:
    entries = plan([], size=32, procedural=3 * len(FAMILIES), seed=0)
    families = {entry.collection for entry in entries}
    assert families == set(FAMILIES) - set(HELD_OUT_FAMILIES)
    assert len({entry.seed for entry in entries}) == len(entries)


def test_same_seed_same_bytes_and_crops_differ_by_seed(materials: Path, built: Path, tmp_path: Path) -> None:
    build_pool(tmp_path / "again", size=32, procedural=3, folders=[materials], seed=7, workers=0)
    assert (tmp_path / "again" / "materials.npy").read_bytes() == (built / "materials.npy").read_bytes()
    crops = [
        make(entry, 32)
        for seed in (1, 2)
        for entry in plan([materials], size=32, procedural=0, seed=seed)
        if entry.name == "maker__large" and entry.variant == "crop"
    ]
    assert crops[0] is not None
    assert crops[1] is not None
    assert not torch.equal(crops[0], crops[1])


def test_stopped_builds_go_on_and_finished_ones_rest(
    materials: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, calls = tmp_path / "pool", []

    def failing(entry: Entry, size: int) -> torch.Tensor | None:
        if len(calls) == 3:
            raise KeyboardInterrupt
        calls.append(entry)
        return make(entry, size)

    monkeypatch.setattr(pool, "make", failing)
    with pytest.raises(KeyboardInterrupt):
        build_pool(out, size=16, procedural=2, folders=[materials], workers=0)
    with pytest.raises(DataError, match="not a complete material pool"):
        MaterialPool(out)

    def counting(entry: Entry, size: int) -> torch.Tensor | None:
        calls.append(entry)
        return make(entry, size)

    monkeypatch.setattr(pool, "make", counting)
    seen: list[tuple[int, int]] = []
    build_pool(
        out, size=16, procedural=2, folders=[materials], workers=0, progress=lambda *done: seen.append(done)
    )
    assert seen[-1] == (10, 10)
    first = [entry for entry in calls[:3] if make(entry, 16) is not None]
    assert not set(first) & set(calls[3:])  # what was stored is not made again
    count = len(calls)
    build_pool(out, size=16, procedural=2, folders=[materials], workers=0)
    assert len(calls) == count
    build_pool(out, size=16, procedural=1, folders=[materials], workers=0)  # another request
    assert sum(entry.kind == "procedural" for entry in MaterialPool(out).index) == 1


def test_command_line_in_other_processes_gives_the_same(
    materials: Path, built: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "pool"
    arguments = ["--out", str(out), "--procedural", "1", "--materials", str(materials)]
    pool.main([*arguments, "--size", "32", "--seed", "7", "--workers", "1"])
    assert "6 materials" in capsys.readouterr().out
    here, there = MaterialPool(built), MaterialPool(out)
    for position in range(1, 6):  # entry 0 is a real procedural material, made in the other process
        assert there.index[position] == here.index[position + 2]
        assert torch.equal(there[position], here[position + 2])
    decode(there[0]).validate()


def test_sampling_follows_weights_and_generator(built: Path) -> None:
    opened = MaterialPool(built)
    first, again = (opened.sample(4, torch.Generator().manual_seed(1)) for _ in range(2))
    assert torch.equal(first, again)
    assert first.shape == (4, 10, 32, 32)
    assert first.dtype == torch.uint8

    probabilities = opened._probabilities({"procedural": 0.5, "pbr": 0.3, "infinigen": 0.2})
    share = {"procedural": 0.0, "infinigen": 0.0, "maker": 0.0}
    for entry, probability in zip(opened.index, probabilities.tolist(), strict=True):
        share["procedural" if entry.kind == "procedural" else entry.collection] += probability
    assert share == pytest.approx({"procedural": 0.5, "infinigen": 0.2, "maker": 0.3})

    infinigen = [opened[p] for p, entry in enumerate(opened.index) if entry.collection == "infinigen"]
    for drawn in opened.sample(8, torch.Generator().manual_seed(2), {"infinigen": 1.0}):
        assert any(torch.equal(drawn, stored[0]) for stored in infinigen)


@pytest.mark.parametrize("weights", [{"marble_arch": 1.0}, {"pbr": -1.0, "procedural": 2.0}, {"pbr": 0.0}])
def test_senseless_weights_are_refused(built: Path, weights: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="weight"):
        MaterialPool(built).sample(1, torch.Generator(), weights)


def test_parts_divide_the_names(built: Path) -> None:
    whole = MaterialPool(built)
    train, validation = (MaterialPool(built, part, holdout=0.4) for part in ("train", "validation"))
    assert len(train) + len(validation) == len(whole)
    assert not {entry.name for entry in train.index} & {entry.name for entry in validation.index}
    assert torch.equal(train[0], whole[whole.index.index(train.index[0])])
    share = np.mean([part_of(f"material {number}", 0.1) == "validation" for number in range(2000)])
    assert share == pytest.approx(0.1, abs=0.03)
    with pytest.raises(DataError, match="no materials for validation"):
        MaterialPool(built, "validation", holdout=0.0)


def test_empty_and_absent_pools_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="not a complete material pool"):
        MaterialPool(tmp_path / "absent")
    with pytest.raises(DataError, match="pool of no materials"):
        build_pool(tmp_path / "pool", procedural=0)
    with pytest.raises(DataError, match="not a folder"):
        build_pool(tmp_path / "pool", procedural=0, folders=[tmp_path / "absent"])
