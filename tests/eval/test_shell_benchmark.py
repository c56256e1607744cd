"""The benchmark of whole runs makes photos, runs the command and tells medians; no clock is read."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import OpenImageIO as oiio
import pytest

from eval.benchmarks import shell
from nets.checkpoint import Record, save_model
from nets.generator import Generator, GeneratorConfig
from refine.errors import UserError


def test_a_photo_has_the_size_that_is_asked_for(tmp_path: Path) -> None:
    shell.write_photo(tmp_path / "photo.jpg", 48)
    spec = oiio.ImageBuf(str(tmp_path / "photo.jpg")).spec()
    assert (spec.width, spec.height, spec.nchannels) == (48, 48, 3)


def test_a_run_tells_time_memory_and_the_share_of_refinement(tmp_path: Path) -> None:
    config = GeneratorConfig(width=2, levels=5, deep_multiplier=2)
    save_model(tmp_path / "tiny.safetensors", Generator(config), Record(config))
    shell.write_photo(tmp_path / "photo.jpg", 32)
    options = ("--init", str(tmp_path / "tiny.safetensors"), "--light", "0,0,2.14", "--no-report")
    done = shell.run(tmp_path / "photo.jpg", "fast", 32, options)
    assert 0.0 < done.refinement < done.seconds
    assert 50.0 < done.memory_mib < 4096.0


def test_a_run_that_fails_is_not_timed(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"cannot be timed: .*absent\.jpg"):
        shell.run(tmp_path / "absent.jpg", "fast", 32)


def test_medians_are_told_by_recipe_and_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[tuple[str, int, Sequence[str]]] = []

    def timed(photo: Path, recipe: str, size: int, options: Sequence[str] = ()) -> shell.Run:
        assert photo.is_file()
        asked.append((recipe, size, options))
        return shell.Run(recipe, size, float(len(asked)), 0.5, 600.0)

    monkeypatch.setattr(shell, "run", timed)
    shell.main(["--sizes", "50", "100", "--rounds", "3", "--out", str(tmp_path), "--iters", "7"])
    assert asked[:2] == [("paper", 50, ["--iters", "7"]), ("default", 50, ["--iters", "7"])]  # not counted
    assert len(asked) == 2 + 3 * 3
    text = (tmp_path / "shell.md").read_text()
    assert capsys.readouterr().out == text
    assert "| default | 100 | 8.0 | 0.5 | 800.0 | 600 |" in text
    assert len(json.loads((tmp_path / "shell.json").read_text())["runs"]) == 9
