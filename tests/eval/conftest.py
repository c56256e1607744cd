"""Fixtures of the evaluation's tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.eval_files import FakeModel, write_checkpoint, write_development


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Return a data folder in the layout of the development set, two or three scenes each."""
    return write_development(tmp_path)


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Load a grey guess in place of any checkpoint."""
    monkeypatch.setattr("refine.refiner.load_model", lambda name: FakeModel())


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """Return the checkpoint of a tiny network that was never trained."""
    return write_checkpoint(tmp_path / "tiny.safetensors")
