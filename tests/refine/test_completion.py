"""`refine completion`: what a shell is told, held to what the command line itself answers to nonsense."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command

import refine.cli
from nets.checkpoint import WEIGHTS
from refine.completion import LINES, SCRIPTS, answers
from refine.export.targets import TARGETS

ROOT = Path(__file__).parents[2]
REFUSED = re.compile(r"choose one of (.*)\.")
OTHERWISE = {"--camera": ["perspective", "orthographic", "collocated"], "--device": ["cpu", "cuda", "mps"]}
"""Names of options that take other things, too, and so have another error."""


def words(*line: str) -> list[str]:
    return [word for word, _ in answers(line)]


def named(option: str) -> list[str]:
    return sorted(words("wall.png", option, ""))


@pytest.mark.parametrize("option", ["--falloff", "--color-space", "--recipe", "--format", "--normals"])
def test_names_are_those_that_the_error_lists(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert refine.cli.run(["wall.png", option, "nonsense"]) == 2
    listed = REFUSED.search(capsys.readouterr().err)
    assert listed is not None
    assert named(option) == sorted(listed[1].split(", "))


@pytest.mark.parametrize("option", OTHERWISE)
def test_other_names(option: str) -> None:
    assert named(option) == sorted(OTHERWISE[option])


def test_names_of_engines_and_networks(capsys: pytest.CaptureFixture[str]) -> None:
    assert set(named("--engine")) >= {"auto", "fused", "compiled", "reference"}
    assert named("--init") == sorted(path.stem for path in WEIGHTS.glob("*.safetensors"))
    assert words("export", "out", "--format", "ex") == ["exr", "exr32"]


def test_targets_are_completed_one_after_the_other() -> None:
    assert words("export", "out", "--to", "") == list(TARGETS)
    assert words("wall.png", "--export", "gltf,us") == ["gltf,usd"]
    assert "gltf,gltf" not in words("export", "--to", "gltf,")


def test_commands_and_options() -> None:
    assert words("") == list(refine.cli.SUBCOMMANDS)
    assert words("ex") == ["export"]
    assert words("wall.png", "") == []  # files are the shell's business
    every = {name for one in get_command(refine.cli.app).params for name in one.opts if name[:2] == "--"}
    assert set(words("wall.png", "-")) == every | {"--help"}
    assert words("wall.png", "--recipe", "fast", "--reci") == []
    assert set(words("view", "out", "--")) == {"--html", "--no-browser", "--quiet", "--help"}
    assert words("completion", "") == list(SCRIPTS)
    assert words("wall.png", "--out", "") == []
    assert words("wall.png", "--quiet", "") == []


@pytest.mark.parametrize("line", [("x.png", "--recipe", "=", "fa"), ("x.png", "--recipe", "fa")])
def test_a_value_after_an_equals_sign_as_bash_takes_it_apart(line: tuple[str, ...]) -> None:
    assert words(*line) == ["fast"]


def test_a_value_after_an_equals_sign() -> None:
    assert words("x.png", "--recipe", "=") == list(words("x.png", "--recipe", ""))
    assert words("x.png", "--recipe=fa") == ["--recipe=fast"]


def test_what_shells_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    for shell, script in SCRIPTS.items():
        assert refine.cli.run(["completion", shell]) == 0
        assert capsys.readouterr().out == script
    assert LINES["zsh"](("cuda:1", "a: b")) == r"cuda\:1:a\: b"
    assert refine.cli.run(["completion", "fish", "--", "wall.png", "--see"]) == 0
    assert capsys.readouterr().out == "--seed\tSame seed, same bytes (0)\n"
    assert refine.cli.run(["completion", "tcsh"]) == 2
    assert "bash, zsh, fish" in capsys.readouterr().err


def test_bash_completes(tmp_path: Path) -> None:
    (tmp_path / "example pictures").mkdir()
    command = tmp_path / "refine"
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m refine.cli "$@"\n')
    command.chmod(0o755)
    bash = shutil.which("bash")
    assert bash is not None
    program = SCRIPTS["bash"] + (
        'ask() { COMP_WORDS=(refine "$@") COMP_CWORD=$#; _refine; printf \'%s\\n\' "${COMPREPLY[@]}" --; }\n'
        "ask ex; ask wall.png --recipe pa; ask wall.png --recipe = pa\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(
        [bash, "--norc", "-euc", program],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split("--\n")[:3] == ["export\nexample pictures\n", "paper\n", "paper\n"]


@pytest.mark.parametrize("shell", SCRIPTS)
def test_scripts_are_sound_where_their_shell_is_there(shell: str) -> None:
    if (program := shutil.which(shell)) is None:
        return
    done = subprocess.run([program, "-n"], input=SCRIPTS[shell], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_answers_import_nothing_heavy() -> None:
    program = (
        "import sys; from refine.cli import run;"
        "code = run(['completion', 'bash', '--', 'wall.png', '--export', '']) + run(['--help']);"
        "heavy = {'torch', 'numpy', 'scipy', 'matplotlib', 'numba', 'OpenImageIO'} & set(sys.modules);"
        "sys.exit(code or ', '.join(heavy) or None)"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, "")
