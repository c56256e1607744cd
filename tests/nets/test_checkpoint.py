"""Weights on disk: our files, the authors' files, and files that must not be believed."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load as deserialize
from safetensors.torch import save as serialize
from torch import Tensor
from torch.nn import functional

from nets import checkpoint
from nets.architectures import NetworkConfig, build, kind_of
from nets.baselines.autoencoder import Autoencoder, AutoencoderConfig
from nets.baselines.des18 import Des18Config
from nets.baselines.des19 import Des19Config
from nets.checkpoint import (
    FORMAT,
    HEADER_KEY,
    WEIGHTS,
    CheckpointError,
    Record,
    authors_names,
    load_autoencoder,
    load_model,
    load_network,
    read_record,
    save_model,
)
from nets.generator import Generator, GeneratorConfig
from tests.helpers import seeded

TINY = GeneratorConfig(width=2, levels=3, deep_multiplier=2)
OTHERS = (Des18Config(2, 3, 2), Des19Config(2, 3, 2), AutoencoderConfig(2))
RECORD = Record(TINY, {"iterations": 3}, ["procedural, Apache-2.0"])


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "own.safetensors"
    save_model(path, Generator(TINY), RECORD)
    return path


# --- Our own format ---------------------------------------------------------------------------------------


def test_a_round_trip_keeps_weights_to_half_precision(tmp_path: Path) -> None:
    network = Generator(TINY)
    path = tmp_path / "new" / "folder" / "own.safetensors"
    save_model(path, network, RECORD)
    loaded = load_model(path)
    assert loaded.config == TINY
    assert not loaded.training
    for name, value in network.state_dict().items():
        assert loaded.state_dict()[name].dtype == torch.float32
        assert torch.equal(loaded.state_dict()[name], value.half().float()), name
    svbrdf, _ = loaded.predict(torch.rand(1, 3, 16, 16, generator=seeded(0)))
    svbrdf.validate()
    assert [file.name for file in path.parent.iterdir()] == ["own.safetensors"]


@pytest.mark.parametrize("config", OTHERS, ids=kind_of)
def test_networks_of_every_kind_make_the_round_trip(tmp_path: Path, config: NetworkConfig) -> None:
    network = build(config)
    path = tmp_path / "other.safetensors"
    record = Record(config, {"iterations": 2})
    save_model(path, network, record)
    assert read_record(path) == record
    loaded = load_network(path)
    assert type(loaded) is type(network)
    assert loaded.config == config
    for name, value in network.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value.half().float()), name


def test_auto_encoders_and_networks_of_photos_are_not_taken_for_each_other(
    saved: Path, tmp_path: Path
) -> None:
    config = AutoencoderConfig(width=2)
    path = tmp_path / "materials.safetensors"
    save_model(path, Autoencoder(config), Record(config))
    assert load_autoencoder(path).config == config
    assert_refused(path, "an auto-encoder of materials, which says nothing of a photo")
    with pytest.raises(CheckpointError, match="a network of photos, not an auto-encoder") as caught:
        load_autoencoder(saved)
    assert "\n" not in str(caught.value)


def test_files_of_before_there_were_kinds_are_generators(saved: Path) -> None:
    def look(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
        assert "kind" not in header

    saved.write_bytes(rewritten(saved, look))
    assert read_record(saved).architecture == load_model(saved).config == TINY


def test_the_record_comes_back(saved: Path) -> None:
    assert read_record(saved) == RECORD
    assert Record(TINY).licence == "Apache-2.0"


def test_same_weights_same_bytes(tmp_path: Path) -> None:
    network = Generator(TINY)
    for name in ("a", "b"):
        save_model(tmp_path / f"{name}.safetensors", network, RECORD)
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


def test_a_failing_write_leaves_the_old_file(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = saved.read_bytes()

    def fail(self: Path, data: bytes) -> int:
        with self.open("wb") as file:
            file.write(data[:10])
        raise OSError("disk full")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="disk full"):
        save_model(saved, Generator(TINY), RECORD)
    assert saved.read_bytes() == before


def test_loaded_weights_can_be_trained_on(saved: Path) -> None:
    network = load_model(saved)
    maps, light = network(torch.zeros(1, 3, 8, 8))
    (maps.sum() + light.sum()).backward()
    assert all(parameter.requires_grad for parameter in network.parameters())


def test_names_are_of_shipped_files_or_paths(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "WEIGHTS", saved.parent)
    assert load_model("own").config == TINY
    assert load_model(str(saved)).config == TINY
    with pytest.raises(CheckpointError, match=r"^nothing: no such checkpoint; .* shipped: own$"):
        load_model("nothing")


def test_the_shipped_default_predicts_and_says_where_it_is_from() -> None:
    file = WEIGHTS / "default.safetensors"
    assert file.stat().st_size <= 16e6
    record = read_record("default")
    assert record.data
    assert record.training["iterations"] > 0
    assert record.licence
    network = load_model("default")
    assert network.config == record.architecture
    photo = torch.rand(1, 3, 256, 256, generator=seeded(0))
    svbrdf, light = network.predict(photo)
    svbrdf.validate()
    assert bool(torch.isfinite(light.position).all())


# --- The authors' public format ---------------------------------------------------------------------------

WIDTHS = (1, 2, 4, 8, 8, 8, 8, 8)
"""Encoder channels as multiples of the first."""

HEADS = {"normal": 3, "diff": 3, "rough": 1, "spec": 3}
"""The authors' decoders in the order of our maps, with the channels of their last convolution."""


def authors_state(width: int, seed: int = 0) -> dict[str, Tensor]:
    """Draw weights under the authors' names, from the facts of their format alone."""
    generator = seeded(seed)
    state: dict[str, Tensor] = {}

    def draw(*shape: int, scale: float, mean: float = 0.0) -> Tensor:
        return mean + scale * torch.randn(shape, generator=generator)

    def norm(name: str, channels: int) -> None:
        state[f"{name}.weight"] = draw(channels, scale=0.2, mean=1.0)
        state[f"{name}.bias"] = draw(channels, scale=0.3)

    encoder = [3, *(width * multiple for multiple in WIDTHS)]
    for level in range(1, 9):
        fan_in = encoder[level - 1] * 16
        state[f"conv{level}.weight"] = draw(encoder[level], encoder[level - 1], 4, 4, scale=fan_in**-0.5)
        if 2 <= level <= 7:
            norm(f"instance_normal{level}", encoder[level])
    for head, channels in HEADS.items():
        inputs = encoder[8]
        for level in range(1, 9):
            outputs = encoder[8 - level] if level < 8 else channels
            for step, source in ((1, inputs), (2, outputs)):
                kernel = draw(outputs, source, 4, 4, scale=(source * 16) ** -0.5)
                state[f"deconv{level}_{head}.temp_conv{step}.weight"] = kernel
            if level < 8:
                norm(f"instance_normal_de_{level}_{head}", outputs)
                inputs = 2 * outputs
    sizes = (encoder[8], 256, 128, 64, 32, 16, 3)
    for layer in range(1, 7):
        inputs, outputs = sizes[layer - 1], sizes[layer]
        state[f"FC{layer}_Light.fc_layer.weight"] = draw(outputs, inputs, scale=inputs**-0.5)
        state[f"FC{layer}_Light.fc_layer.bias"] = draw(outputs, scale=0.1)
    return state


def authors_forward(state: dict[str, Tensor], photo: Tensor) -> tuple[dict[str, Tensor], Tensor]:
    """Run the authors' network as DESIGN.md states it: encoded photo in, maps in [-1, 1] and position out."""

    def leaky(x: Tensor) -> Tensor:
        return torch.where(x > 0, x, 0.2 * x)

    def normalized(x: Tensor, name: str) -> Tensor:
        mean = x.mean(dim=(2, 3), keepdim=True)
        variance = ((x - mean) ** 2).mean(dim=(2, 3), keepdim=True)
        scaled = (x - mean) / torch.sqrt(variance + 1e-5)
        return scaled * state[f"{name}.weight"][:, None, None] + state[f"{name}.bias"][:, None, None]

    def same(x: Tensor, kernel: Tensor) -> Tensor:
        return functional.conv2d(functional.pad(x, (1, 2, 1, 2)), kernel)

    skips = [functional.conv2d(photo, state["conv1.weight"], stride=2, padding=1)]
    for level in range(2, 9):
        x = functional.conv2d(leaky(skips[-1]), state[f"conv{level}.weight"], stride=2, padding=1)
        skips.append(normalized(x, f"instance_normal{level}") if level < 8 else x)

    maps = {}
    for head in HEADS:
        x = skips[7]
        for level in range(1, 9):
            x = leaky(x).repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
            x = same(x, state[f"deconv{level}_{head}.temp_conv1.weight"])
            x = same(x, state[f"deconv{level}_{head}.temp_conv2.weight"])
            if level < 8:
                x = torch.cat([normalized(x, f"instance_normal_de_{level}_{head}"), skips[7 - level]], dim=1)
        maps[head] = torch.tanh(x)
    maps["rough"] = maps["rough"].repeat(1, 3, 1, 1)

    light = skips[7].flatten(1)
    for layer in range(1, 7):
        weights = (state[f"FC{layer}_Light.fc_layer.{kind}"] for kind in ("weight", "bias"))
        light = functional.linear(light, *weights)
        light = leaky(light) if layer < 6 else light
    return maps, light * torch.tensor([1.6891, 1.6833, 2.7202]) + torch.tensor([-0.0012, 0.0018, 3.0988])


@pytest.mark.parametrize(("width", "prefix"), [(2, ""), (5, "module.")])
def test_imported_weights_give_the_authors_outputs(tmp_path: Path, width: int, prefix: str) -> None:
    state = authors_state(width)
    torch.save({prefix + name: value for name, value in state.items()}, tmp_path / "authors.pth")
    network = load_model(tmp_path / "authors.pth")
    assert network.config == GeneratorConfig(width=width)

    linear = torch.rand(2, 3, 256, 256, generator=seeded(7)) * 0.9 + 0.05
    encoded = linear ** (1 / 2.2) * 2.0 - 1.0
    with torch.no_grad():
        maps, position = authors_forward(state, encoded)
        found, _ = network(encoded)
    assert float(found.std()) > 0.1  # the comparison is not of zeros
    order = torch.cat([maps["normal"], maps["diff"], maps["rough"][:, :1], maps["spec"]], dim=1)
    torch.testing.assert_close(found, order, atol=1e-5, rtol=0)

    svbrdf, light = network.predict(linear)
    torch.testing.assert_close(svbrdf.diffuse, (maps["diff"] + 1) / 2, atol=1e-5, rtol=0)
    torch.testing.assert_close(svbrdf.specular, (maps["spec"] + 1) / 2, atol=1e-5, rtol=0)
    torch.testing.assert_close(light.position[:, :2], position[:, :2], atol=1e-5, rtol=0)
    torch.testing.assert_close(light.position[:, 2], position[:, 2].clamp(min=0.2), atol=1e-5, rtol=0)


def test_every_parameter_of_the_papers_network_has_an_authors_name() -> None:
    with torch.device("meta"):
        network = Generator()
    names = authors_names()
    assert set(names) == set(network.state_dict())
    assert len(set(names.values())) == len(names)
    assert set(names.values()) == set(authors_state(1))


# --- Files that must not be believed ----------------------------------------------------------------------


class Trap:
    """Creates a file when it is unpickled by a careless reader."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.path,)


def _zipped(path: Path, trap: Trap) -> None:
    torch.save({**authors_state(1), "extra": trap}, path)


def _legacy(path: Path, trap: Trap) -> None:
    torch.save({**authors_state(1), "extra": trap}, path, _use_new_zipfile_serialization=False)


def _bare(path: Path, trap: Trap) -> None:
    path.write_bytes(pickle.dumps(trap))


@pytest.mark.parametrize("suffix", [".pth", ".pt", ".tar"])
@pytest.mark.parametrize("write", [_zipped, _legacy, _bare])
def test_a_pickle_that_runs_code_is_refused_unrun(tmp_path: Path, write, suffix: str) -> None:  # type: ignore[no-untyped-def]
    path, sprung = tmp_path / f"trap{suffix}", tmp_path / "sprung"
    write(path, Trap(sprung))
    with pytest.raises(CheckpointError, match="refused") as caught:
        load_model(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value).splitlines()) == 1
    assert not sprung.exists()
    if write is _bare:  # the trap is real
        pickle.loads(path.read_bytes())
        assert sprung.exists()


def rewritten(path: Path, change: Callable[[dict[str, Tensor], dict[str, Any]], None]) -> bytes:
    """Return one of our files after `change(tensors, header)`."""
    record = read_record(path)
    header = {
        "format": FORMAT,
        "architecture": record.architecture.as_dict(),
        "training": {},
        "data": [],
        "licence": "",
    }
    tensors = deserialize(path.read_bytes())
    change(tensors, header)
    return serialize(tensors, metadata={HEADER_KEY: json.dumps(header)})


def _nan(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    tensors["encoder.1.weight"][0, 0, 0, 0] = torch.nan


def _infinite(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    tensors["light_head.layers.5.bias"][1] = torch.inf


def _wider(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    header["architecture"]["width"] = 3


def _deeper(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    header["architecture"]["levels"] = 4


def _missing(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    del tensors["encoder_norms.0.bias"]


def _unknown(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    tensors["zz.top"] = torch.zeros(1)


def _impossible(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    header["architecture"]["width"] = 0


def _not_a_number(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    header["architecture"]["width"] = "wide"


def _enormous(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    header["architecture"]["width"] = 10**18


def _unknown_option(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    header["architecture"]["heads"] = 4


def _other_format(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    header["format"] = "svbrdf-refine generator 99"


def _other_kind(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    header["kind"] = "des20"


def _no_kind(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    header["kind"] = ["des18"]


def _confused_kind(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    header["kind"] = "des18"
    header["architecture"] = {"width": 2, "levels": 3, "deep_multiplier": 2}


def _no_architecture(tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    del header["architecture"]


SPOILED = [
    (_nan, r"encoder\.1\.weight holds NaN or infinite weights"),
    (_infinite, r"light_head\.layers\.5\.bias holds NaN or infinite weights"),
    (_wider, r"another architecture, encoder\.0\.weight has shape \(2, 3, 4, 4\) where \(3, 3, 4, 4\)"),
    (_deeper, r"another architecture, \S+ is missing"),
    (_missing, r"another architecture, encoder_norms\.0\.bias is missing"),
    (_unknown, r"another architecture, zz\.top is unknown here"),
    (_impossible, "not a network of this library"),
    (_not_a_number, "not a network of this library"),
    (_enormous, "another architecture, no generator can be built"),
    (_unknown_option, "not a network of this library"),
    (_other_format, "not a network of this library"),
    (_other_kind, "another architecture, 'des20'; the known ones are generator, des18"),
    (_no_kind, "not a network of this library"),
    (_confused_kind, "another architecture, unet.first.weight is missing"),
    (_no_architecture, "not a network of this library"),
]


def assert_refused(path: Path, message: str) -> None:
    with pytest.raises(CheckpointError, match=message) as caught:
        load_model(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(("change", "message"), SPOILED)
def test_spoiled_files_of_ours_are_refused(saved: Path, change, message: str) -> None:  # type: ignore[no-untyped-def]
    saved.write_bytes(rewritten(saved, change))
    assert_refused(saved, message)


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        (None, "not a network of this library"),
        ({"other": "{}"}, "not a network of this library"),
        ({HEADER_KEY: "no json"}, "not a network of this library"),
        ({HEADER_KEY: "[]"}, "not a network of this library"),
        ({HEADER_KEY: '"text"'}, "not a network of this library"),
        ({HEADER_KEY: "null"}, "not a network of this library"),
    ],
)
def test_files_without_our_header_are_refused(saved: Path, metadata, message: str) -> None:  # type: ignore[no-untyped-def]
    saved.write_bytes(serialize(deserialize(saved.read_bytes()), metadata=metadata))
    assert_refused(saved, message)


@pytest.mark.parametrize("name", ["w.safetensors", "w.pth", "w.pt", "w.png"])
@pytest.mark.parametrize("content", [b"", b"hello, this is text\n", b"\x80\x02", bytes(range(256)) * 9])
def test_files_that_are_no_weights_are_refused(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    assert_refused(path, "refused" if name in ("w.pth", "w.pt") else "not a safetensors file")


@pytest.mark.parametrize("share", [0.001, 0.3, 0.999])
@pytest.mark.parametrize("kind", ["own", "authors"])
def test_truncated_files_are_refused(saved: Path, kind: str, share: float) -> None:
    path = saved
    if kind == "authors":
        path = saved.parent / "authors.pth"
        torch.save(authors_state(1), path)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    assert_refused(path, "refused" if kind == "authors" else "not a safetensors file")


AUTHORS_SPOILED: list[tuple[Any, str]] = [
    ({**authors_state(1), "conv2.weight": torch.zeros(2, 1, 3, 3)}, r"encoder\.1\.weight has shape"),
    ({**authors_state(1), "conv1.weight": torch.full((1, 3, 4, 4), torch.nan)}, "holds NaN"),
    ({**authors_state(1), "conv9.weight": torch.zeros(1)}, r"conv9\.weight is unknown"),
    ({k: v for k, v in authors_state(1).items() if k != "conv1.weight"}, r"encoder\.0\.weight"),
    ({k: v for k, v in authors_state(1).items() if "spec" not in k}, r"decoders\.specular\S+ is missing"),
    ({"epoch": 3, **authors_state(1)}, "something else than a state dict"),
    ({"conv1.weight": torch.zeros(0, 3, 4, 4)}, "another architecture"),
    ({}, "another architecture"),
    (torch.zeros(3), "something else than a state dict"),
    ([1, 2, 3], "something else than a state dict"),
]


@pytest.mark.parametrize(("state", "message"), AUTHORS_SPOILED)
def test_other_state_dicts_are_refused(tmp_path: Path, state: Any, message: str) -> None:
    torch.save(state, tmp_path / "other.pth")
    assert_refused(tmp_path / "other.pth", message)


@pytest.mark.parametrize("name", ["missing.safetensors", "missing.pth", ""])
def test_missing_files_and_folders_are_refused(tmp_path: Path, name: str) -> None:
    assert_refused(tmp_path / name, "no such checkpoint")
