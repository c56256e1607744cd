"""`refine view`, as a person would run it on what `refine` wrote."""

from __future__ import annotations

import functools
import http.client
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import refine.cli


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory, checkpoint: Path, photo: Path) -> Path:
    folder = tmp_path_factory.mktemp("view") / "wall"
    arguments = [photo, "--init", checkpoint, "--iters", "0", "--resolution", "64", "--no-report", "-q"]
    arguments += ["--engine", "reference", "--out", folder]
    assert refine.cli.run([str(argument) for argument in arguments]) == 0
    return folder


def test_a_page_is_written(result: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    before = sorted(result.iterdir())
    page = tmp_path / "new" / "wall.html"
    assert refine.cli.run(["view", str(result), "--html", str(page)]) == 0
    assert f"wrote {page}" in capfd.readouterr().err
    text = page.read_text(encoding="utf-8")
    assert text.startswith("<!doctype html>")
    assert '"photo":"' in text  # it is still there
    assert sorted(result.iterdir()) == before


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nowhere"], "is not a folder"),
        (["."], "There is no"),
        ([".", "--html", "wall.json"], "end it in .html"),
        ([], "see refine view --help"),
    ],
)
def test_mistakes_end_in_one_sentence(
    arguments: list[str],
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert refine.cli.run(["view", *arguments]) == 2
    error = capfd.readouterr().err
    assert sentence in error
    assert len(error.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C is sent as a POSIX signal")
def test_it_serves_until_ctrl_c(result: Path) -> None:
    command = [sys.executable, "-m", "refine.cli", "view", str(result), "--no-browser"]
    # What a shell starts in its background ignores SIGINT, and so would the server.
    listening = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=listening) as process:
        assert process.stderr is not None
        told = process.stderr.readline()
        host, _, port = told.partition("http://")[2].partition("/")[0].partition(":")
        connection = http.client.HTTPConnection(host, int(port), timeout=30)
        connection.request("GET", "/")
        answer = connection.getresponse()
        assert answer.status == 200
        assert b"wall - refine</title>" in answer.read()
        connection.close()
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        assert process.stderr.read() == ""
