"""The benchmark of batches makes photos, runs the command, writes what it says; no clock is read."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import OpenImageIO as oiio
import pytest

from eval.benchmarks import batch
from refine.errors import UserError


def test_photos_are_different_crops_the_same_every_time(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("one", "two", "other")]
    for folder, seed in zip(folders, (0, 0, 1), strict=True):
        folder.mkdir()
        batch.write_photos(folder, 4, seed)
    contents = [[path.read_bytes() for path in sorted(folder.iterdir())] for folder in folders]
    assert contents[0] == contents[1]
    assert len(set(contents[0])) == 4
    assert not set(contents[0]) & set(contents[2])
    spec = oiio.ImageBuf(str(folders[0] / "03.png")).spec()
    assert spec.width == spec.height
    assert spec.nchannels == 3


def test_workers_take_turns_and_ratios_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    runs: list[tuple[int, Sequence[str]]] = []
    seconds = iter([40.0, 20.0, 50.0, 30.0, 44.0, 24.2])

    def timed(photos: Path, workers: int, options: Sequence[str] = ()) -> float:
        assert len(list(photos.iterdir())) == 2
        runs.append((workers, options))
        return next(seconds)

    monkeypatch.setattr(batch, "run_batch", timed)
    batch.main(["--photos", "2", "--out", str(tmp_path), "--iters", "3"])
    assert runs == [(workers, ["--iters", "3"]) for _ in range(3) for workers in (1, 2)]
    text = (tmp_path / "batch.md").read_text()
    assert capsys.readouterr().out.endswith(text)
    assert "| 1 | 44.00 | 22.00 | 1.00 | 40.00 | 50.00 |" in text
    assert "| 2 | 24.20 | 12.10 | 0.55 | 20.00 | 30.00 |" in text
    assert json.loads((tmp_path / "batch.json").read_text())["seconds"]["2"] == [20.0, 30.0, 24.2]


def test_a_batch_that_fails_is_not_timed(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no photos"):
        batch.run_batch(tmp_path, 1)
