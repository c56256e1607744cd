"""`refine photos/ --out mats/` as a person runs it: killed, resumed, with failures, on a cluster."""

from __future__ import annotations

import functools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import refine.batch.run
import refine.cli
from refine.batch.plan import Job
from refine.engine.compilation import prepare
from refine.maps import read_maps
from tests.e2e.pictures import flash_photo, save_picture

ROOT = Path(__file__).parents[2]
PATIENCE = 900.0
OPTIONS = ("--resolution", "32", "--iters", "2", "--no-report")
MAPS = ("diffuse.png", "normal.png", "rendering.png", "roughness.png", "specular.png", "thumbnail.jpg")


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of three photos, two of one stem, and a file that is none."""
    folder = tmp_path_factory.mktemp("batch") / "photos"
    folder.mkdir()
    for name, (height, width) in {"a.png": (32, 32), "a.tif": (24, 32), "b.png": (32, 28)}.items():
        save_picture(folder / name, flash_photo(height, width))
    (folder / "broken.jpg").write_text("no picture at all")
    return folder


@pytest.fixture(scope="module")
def arguments(photos: Path, checkpoint: Path) -> list[str]:
    prepare()  # compile once, here: a first run would announce it
    return [str(photos), "--init", str(checkpoint), *OPTIONS]


@pytest.fixture(scope="module")
def whole(arguments: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a batch that ran through."""
    out = tmp_path_factory.mktemp("whole") / "mats"
    assert refine.cli.run([*arguments, "--out", str(out), "--workers", "1", "--quiet"]) == 3
    return out


@pytest.fixture
def copy(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "mats"))


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the names of the photos that are handed to processes, of which none starts."""
    names: list[str] = []

    def no_work(opening: object, jobs: list[Job], *_: object, **__: object) -> Iterator[tuple[Job, None]]:
        names.extend(job.name for job in jobs)
        yield from ()

    monkeypatch.setattr(refine.batch.run, "work_in_processes", no_work)
    return names


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "refine.cli", *arguments]


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


def wait_until(happened: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def is_gone(group: int) -> bool:
    """Whether no process of a group is left."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


def test_every_photo_has_a_result_of_its_own(whole: Path, photos: Path) -> None:
    expected = {
        f"{name}/{name[0]}{end}"
        for name in ("a.png", "a.tif", "b")
        for end in (*(f"_{m}" for m in MAPS), ".json")
    }
    assert content(whole).keys() == {*expected, "index.html", "batch.json"}
    sizes = {}
    for name, source in (("a.png", "a.png"), ("a.tif", "a.tif"), ("b", "b.png")):
        record = json.loads((whole / name / f"{name[0]}.json").read_text())
        assert record["photo"]["source"] == str(photos / source)
        assert record["settings"]["threads"] == 1
        sizes[name] = read_maps(whole / name, name[0]).validate().size
    assert sizes == {"a.png": (32, 32), "a.tif": (24, 32), "b": (32, 28)}


def test_a_failed_photo_is_recorded_and_the_rest_done(whole: Path, photos: Path) -> None:
    record = json.loads((whole / "batch.json").read_text())
    states = {entry["name"]: entry["state"] for entry in record["photos"]}
    assert states == {"a.png": "done", "a.tif": "done", "b": "done", "broken": "failed"}
    reason = next(entry["reason"] for entry in record["photos"] if entry["name"] == "broken")
    assert reason.startswith(f"{photos / 'broken.jpg'} is not an image")
    page = (whole / "index.html").read_text()
    assert "3 done · 1 failed" in page
    assert page.count("<img ") == 3


def test_what_is_finished_is_not_done_again(
    copy: Path, arguments: list[str], tried: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*.*") if path.parent != copy}
    assert refine.cli.run([*arguments, "--out", str(copy)]) == 0
    assert tried == ["broken"]
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert "3 of them before" in capfd.readouterr().err


def amend(mats: Path, change: Callable[[dict[str, Any]], object]) -> None:
    record = json.loads((mats / "b" / "b.json").read_text())
    change(record)
    (mats / "b" / "b.json").write_text(json.dumps(record))


def another_photo(mats: Path) -> None:
    amend(mats, lambda record: record["photo"].update(sha256="0" * 64))


def another_network(mats: Path) -> None:
    amend(mats, lambda record: record["checkpoint"].update(sha256="0" * 64))


def another_auto_encoder(mats: Path) -> None:
    amend(mats, lambda record: record.update(auto_encoders=[{"sha256": "0" * 64}]))


def interrupted(mats: Path) -> None:
    amend(mats, lambda record: record.update(interrupted=True))


def a_map_is_gone(mats: Path) -> None:
    (mats / "b" / "b_normal.png").unlink()


def a_map_is_empty(mats: Path) -> None:
    (mats / "b" / "b_normal.png").write_bytes(b"")


def no_record(mats: Path) -> None:
    (mats / "b" / "b.json").unlink()


def another_record(mats: Path) -> None:
    (mats / "b" / "b.json").write_text("[]")


@pytest.mark.parametrize(
    "change",
    [
        another_photo,
        another_network,
        another_auto_encoder,
        interrupted,
        a_map_is_gone,
        a_map_is_empty,
        no_record,
        another_record,
    ],
)
def test_what_is_not_finished_is_done(
    change: Callable[[Path], None], copy: Path, arguments: list[str], tried: list[str]
) -> None:
    change(copy)
    assert refine.cli.run([*arguments, "--out", str(copy), "--quiet"]) == 0
    assert tried == ["b", "broken"]


@pytest.mark.parametrize(
    "changed",
    [["--iters", "3"], ["--seed", "1"], ["--format", "exr"], ["--uncertainty"], ["--export", "orm"]],
)
def test_other_settings_are_other_results(
    changed: list[str], copy: Path, arguments: list[str], tried: list[str]
) -> None:
    assert refine.cli.run([*arguments, *changed, "--out", str(copy), "--quiet"]) == 0
    assert tried == ["a.png", "a.tif", "b", "broken"]


def test_a_killed_batch_goes_on_where_it_stopped(arguments: list[str], whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "mats"
    killed = subprocess.Popen(
        command(*arguments, "--out", str(out), "--workers", "1", "--quiet"), env=environment()
    )
    first = out / "a.png" / "a.json"
    wait_until(first.exists)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    for folder in (out / "b" / "export", out):  # as kills in the middle of writing leave them
        half = folder / ".refine-0123456789abcdef" / "0.png"
        half.parent.mkdir(parents=True)
        half.touch()
    assert len(list(out.glob("*/*.json"))) < 3, "the batch was done before it was killed"
    written = first.stat().st_mtime_ns
    assert refine.cli.run([*arguments, "--out", str(out), "--workers", "2", "--quiet"]) == 3
    assert first.stat().st_mtime_ns == written
    assert content(out) == content(whole)


def test_control_c_ends_all_processes_and_says_how_to_go_on(arguments: list[str], tmp_path: Path) -> None:
    out = tmp_path / "mats"
    slow = [*arguments, "--iters", "1000000", "--engine", "reference", "--out", str(out), "--workers", "1"]
    listening = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(
        command(*slow), env=environment(), stderr=subprocess.PIPE, text=True, preexec_fn=listening,
        start_new_session=True,
    ) as process:  # fmt: skip
        try:
            wait_until((out / "batch.json").exists)
            os.killpg(process.pid, signal.SIGINT)  # as a terminal does, to all of them
            _, error = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
    assert process.returncode == 130
    assert error == "refine: interrupted; 0 of 4 photos are done, the same command does the rest.\n"
    assert {entry["state"] for entry in json.loads((out / "batch.json").read_text())["photos"]} == {"waiting"}
    wait_until(lambda: is_gone(process.pid))


def test_a_cluster_does_the_same_and_survives_a_worker(
    arguments: list[str], whole: Path, tmp_path: Path
) -> None:
    out = tmp_path / "mats"
    done = subprocess.run(
        [sys.executable, "-m", "tests.e2e.local_cluster", *arguments, "--out", str(out)],
        cwd=ROOT,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    told: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    assert told["code"] == 3, done.stderr
    assert len(told["held"]) == 1
    assert told["held"][0] >= 1
    assert content(out) == content(whole)


def test_several_photos_are_a_batch_if_a_folder_is_named(
    photos: Path, checkpoint: Path, tried: list[str], tmp_path: Path
) -> None:
    given = [str(photos / name) for name in ("b.png", "a.png")]
    options = ["--init", str(checkpoint), *OPTIONS, "--quiet"]
    assert refine.cli.run([*given, *options]) == 2
    assert refine.cli.run([*given, *options, "--out", str(tmp_path / "mats")]) == 0
    assert tried == ["b", "a"]


def test_a_folder_can_show_one_surface(checkpoint: Path, tmp_path: Path) -> None:
    folder = tmp_path / "wall"
    folder.mkdir()
    for name in ("1.png", "2.png"):
        save_picture(folder / name, flash_photo(24, 24))
    lights = tmp_path / "lights.json"  # given: finding them takes long and is another's test
    lights.write_text(json.dumps({"positions": [[0.0, 0.1, 2.0], [0.9, 0.1, 2.0]]}))
    out = tmp_path / "out"
    known = ("--one-surface", "--lights", str(lights), "--threads", "1")
    options = (*known, "--init", str(checkpoint), *OPTIONS, "--quiet", "--out", str(out))
    assert refine.cli.run([str(folder), *options]) == 0
    record = json.loads((out / "1.json").read_text())
    assert [other["source"] for other in record["others"]] == [str(folder / "2.png")]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--engine", "dask"], "go together"),
        (["--scheduler", "tcp://127.0.0.1:1"], "go together"),
        (["--engine", "dask", "--scheduler", "tcp://127.0.0.1:1", "--workers", "2"], "leave out --workers"),
        (["--engine", "dask", "--scheduler", "soup://127.0.0.1:1"], "No Dask scheduler answers"),
        (["--workers", "0"], "--workers 0"),
        (["--init", "none.safetensors"], "none.safetensors"),
        (["--recipe", "soup"], "paper"),
    ],
)
def test_mistakes_end_in_one_sentence(
    options: list[str],
    sentence: str,
    arguments: list[str],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "mats"
    assert refine.cli.run([*arguments, *options, "--out", str(out), "--quiet"]) == 2
    error = capfd.readouterr().err
    assert sentence in error
    assert len(error.splitlines()) == 1


def test_options_of_batches_are_refused_for_one_photo(
    photos: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for options in (["--workers", "2"], ["--engine", "dask"], ["--scheduler", "tcp://127.0.0.1:1"]):
        assert refine.cli.run([str(photos / "b.png"), *options]) == 2
        assert "are for batches" in capfd.readouterr().err


def test_the_default_folder_is_named_after_the_photos(
    arguments: list[str], photos: Path, tried: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert refine.cli.run([*arguments, "--quiet"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["photos_materials"]
