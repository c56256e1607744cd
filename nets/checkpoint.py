"""Weights on disk: safetensors with a JSON header, and the authors' public `.pth`, nothing that runs code."""

from __future__ import annotations

import json
import os
import pickle
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialize
from torch import Tensor

from nets.architectures import CONFIGS, Network, NetworkConfig, build, find_config, kind_of
from nets.baselines.autoencoder import Autoencoder
from nets.baselines.des18 import Des18
from nets.baselines.des19 import Des19
from nets.generator import PAPER_GENERATOR, Generator, GeneratorConfig
from nets.svbrdf import MAPS
from nets.text import parse_json, printable

WEIGHTS = Path(__file__).parent / "weights"
"""Folder of the shipped checkpoints."""

FORMAT = "svbrdf-refine generator 1"
HEADER_KEY = "svbrdf_refine"

LARGEST_NUMBER = 1024
"""Widths, levels and so on beyond this are of no network: building it would take for ever."""

AUTHORS_NAMES = {"normal": "normal", "diffuse": "diff", "roughness": "rough", "specular": "spec"}
"""How the authors' state dict calls our maps."""


class CheckpointError(ValueError):
    """A checkpoint that cannot be loaded; one sentence that names the file and says why."""

    def __init__(self, sentence: str) -> None:
        """Take the sentence."""
        super().__init__(printable(sentence))


@dataclass(frozen=True)
class Record:
    """What a checkpoint says of itself.

    Attributes:
        architecture: the network's shape.
        training: iterations, samples, seconds, every setting.
        data: what it was trained on, with licences.
        licence: of the weights.
    """

    architecture: NetworkConfig
    training: dict[str, Any] = field(default_factory=dict)
    data: list[str] = field(default_factory=list)
    licence: str = "Apache-2.0"


def save_model(path: Path, network: Network, record: Record) -> None:
    """Write weights as float16 safetensors, header included, by write-and-rename."""
    header = {"format": FORMAT, "kind": kind_of(record.architecture), **asdict(record)}
    tensors = {name: value.detach().half().contiguous() for name, value in network.state_dict().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}.partial")
    try:
        temporary.write_bytes(serialize(tensors, metadata={HEADER_KEY: json.dumps(header, sort_keys=True)}))
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def load_model(name: str | Path = "default") -> Generator | Des18 | Des19:
    """Load a network ready for `predict`.

    Args:
        name: a shipped checkpoint's name (`default`), a `.safetensors` file of ours, or the authors' `.pth`.

    Raises:
        CheckpointError: no such file, not a checkpoint, another architecture, NaN weights, or a pickle
            that would run code.
    """
    network = load_network(name)
    if isinstance(network, Autoencoder):
        raise CheckpointError(
            f"{name}: an auto-encoder of materials, which says nothing of a photo; give a network of photos"
        )
    return network


def load_autoencoder(name: str | Path) -> Autoencoder:
    """Load an auto-encoder of materials; arguments and errors as `load_model`."""
    network = load_network(name)
    if not isinstance(network, Autoencoder):
        raise CheckpointError(
            f"{name}: a network of photos, not an auto-encoder of materials; give one such as gao19"
        )
    return network


def load_network(name: str | Path) -> Network:
    """Load a network of any kind; arguments and errors as `load_model`."""
    path = resolve(name)
    network = _load_authors(path) if path.suffix in {".pth", ".pt", ".tar"} else _load_own(path)
    for parameter_name, parameter in network.named_parameters():
        if not bool(torch.isfinite(parameter).all()):
            raise CheckpointError(
                f"{path}: {parameter_name} holds NaN or infinite weights; train or fetch it anew"
            )
    return network.eval()


def resolve(name: str | Path) -> Path:
    """Return the file behind a checkpoint's name or path."""
    shipped = WEIGHTS / f"{name}.safetensors"
    path = shipped if isinstance(name, str) and "/" not in name and shipped.is_file() else Path(name)
    if not path.is_file():
        names = ", ".join(sorted(file.stem for file in WEIGHTS.glob("*.safetensors")))
        raise CheckpointError(f"{path}: no such checkpoint; give a file, or one of the shipped: {names}")
    return path


def read_record(name: str | Path) -> Record:
    """Return the header of one of our checkpoints.

    Raises:
        CheckpointError: as `load_model`.
    """
    path = resolve(name)
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise CheckpointError(
            f"{path}: not a safetensors file ({error}); give one written by refine-train"
        ) from None
    try:
        header = parse_json(metadata[HEADER_KEY])
        if header.pop("format") != FORMAT:
            raise KeyError
        # Files of before there were other kinds do not name theirs.
        kind = header.pop("kind", "generator")
        if kind in CONFIGS:
            return Record(**{**header, "architecture": CONFIGS[kind](**header["architecture"])})
    except (AttributeError, KeyError, TypeError, ValueError):
        raise CheckpointError(
            f"{path}: safetensors, but not a network of this library; give one written by refine-train"
        ) from None
    raise CheckpointError(
        f"{path}: another architecture, {kind!r}; the known ones are {', '.join(CONFIGS)}, a newer version "
        "may know more"
    )


def _load_own(path: Path) -> Network:
    record = read_record(path)
    architecture = record.architecture
    network = _without_weights(path, kind_of(architecture), architecture.as_dict())
    expected = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    with safe_open(path, "pt") as file:
        found = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
        _check_shapes(path, expected, found)
        tensors = {name: file.get_tensor(name).float() for name in found}
    network.load_state_dict(tensors, assign=True)
    return network


def _load_authors(path: Path) -> Network:
    try:
        _require_uncompressed(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about pickles that are refused anyway
            state = torch.load(path, map_location="cpu", weights_only=True)
    except (
        pickle.UnpicklingError,
        RuntimeError,
        EOFError,
        zipfile.BadZipFile,
        ValueError,
        KeyError,
    ) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(
            f"{path}: refused, it is not a plain file of tensors ({reason[:120]}); "
            "save it anew as a state dict of tensors"
        ) from None
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise CheckpointError(
            f"{path}: holds something else than a state dict of tensors; save it anew as one"
        )
    renamed = from_authors_names({str(name): value for name, value in state.items()})
    first = renamed.get("encoder.0.weight")
    width = int(first.shape[0]) if first is not None and first.ndim == 4 else PAPER_GENERATOR.width
    network = _without_weights(path, "generator", {"width": width})
    expected = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    _check_shapes(path, expected, {name: tuple(tensor.shape) for name, tensor in renamed.items()})
    network.load_state_dict({name: value.float() for name, value in renamed.items()}, assign=True)
    return network


def _require_uncompressed(path: Path) -> None:
    """Refuse an archive that would be larger in memory than on disk: torch never writes one.

    Raises:
        ValueError: it is one.
        zipfile.BadZipFile: it is damaged.
    """
    if not zipfile.is_zipfile(path):
        return
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(entry.file_size for entry in archive.infolist())
    if unpacked > path.stat().st_size:
        raise ValueError(f"it is {path.stat().st_size} bytes that unpack to {unpacked}")


def _without_weights(path: Path, kind: str, architecture: Mapping[str, Any]) -> Network:
    try:
        if any(isinstance(value, int) and value > LARGEST_NUMBER for value in architecture.values()):
            raise ValueError
        with torch.device("meta"):
            return build(find_config(kind)(**architecture))
    except (RuntimeError, TypeError, ValueError):
        raise CheckpointError(
            f"{path}: another architecture, no {kind} can be built as {architecture}; "
            "load it with its own code"
        ) from None


def authors_names(config: GeneratorConfig = PAPER_GENERATOR) -> dict[str, str]:
    """Return the authors' parameter name of each of ours (facts of their format: DESIGN.md, "Networks")."""
    names: dict[str, str] = {}
    for level in range(config.levels):
        names[f"encoder.{level}.weight"] = f"conv{level + 1}.weight"
    for level in range(config.levels - 2):
        for kind in ("weight", "bias"):
            names[f"encoder_norms.{level}.{kind}"] = f"instance_normal{level + 2}.{kind}"
    for ours in MAPS:
        theirs = AUTHORS_NAMES[ours]
        for level in range(config.levels):
            for step in (1, 2):
                names[f"decoders.{ours}.blocks.{level}.conv{step}.weight"] = (
                    f"deconv{level + 1}_{theirs}.temp_conv{step}.weight"
                )
        for level in range(config.levels - 1):
            for kind in ("weight", "bias"):
                names[f"decoders.{ours}.norms.{level}.{kind}"] = (
                    f"instance_normal_de_{level + 1}_{theirs}.{kind}"
                )
    for layer in range(6):
        for kind in ("weight", "bias"):
            names[f"light_head.layers.{layer}.{kind}"] = f"FC{layer + 1}_Light.fc_layer.{kind}"
    return names


def from_authors_names(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Rename the authors' state dict to ours; unknown names stay as they are. A `module.` prefix goes."""
    ours = {theirs: name for name, theirs in authors_names().items()}
    plain = {name.removeprefix("module."): value for name, value in state.items()}
    return {ours.get(name, name): value for name, value in plain.items()}


def _check_shapes(
    path: Path, expected: dict[str, tuple[int, ...]], found: dict[str, tuple[int, ...]]
) -> None:
    for name, shape in expected.items():
        if name not in found:
            raise CheckpointError(
                f"{path}: another architecture, {name} is missing; load it with its own code"
            )
        if found[name] != shape:
            raise CheckpointError(
                f"{path}: another architecture, {name} has shape {found[name]} where {shape} is expected; "
                "load it with its own code"
            )
    unknown = sorted(set(found) - set(expected))
    if unknown:
        raise CheckpointError(
            f"{path}: another architecture, {unknown[0]} is unknown here; load it with its own code"
        )
