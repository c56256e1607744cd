"""A photo of a rendered material and a tiny random checkpoint, for running the console scripts on."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from nets.checkpoint import Record, save_model
from nets.generator import Generator, GeneratorConfig
from tests.e2e.pictures import flash_photo, save_picture

TINY = GeneratorConfig(width=2, levels=7, deep_multiplier=2)


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a random network of the right shape."""
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(5)
        save_model(path, Generator(TINY), Record(TINY, data=["nothing: random weights"]))
    return path


@pytest.fixture(scope="session")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an 8-bit photo, wider than high."""
    return save_picture(tmp_path_factory.mktemp("photos") / "wall.png", flash_photo(60, 96))
