"""`refine` as a person runs it: files written, bytes repeated, mistakes answered in one sentence."""

from __future__ import annotations

import json
import os
import pickle
import pty
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

import refine.cli
import refine.result
from nets.checkpoint import Record, load_model, save_model
from nets.ensemble import FlipAverage
from nets.generator import Generator, GeneratorConfig
from nets.svbrdf import MAPS
from refine.engine.compilation import prepare
from refine.initialization import initialize
from refine.maps import read_maps
from refine.photo import read_photo, resize_photo
from tests.e2e.pictures import flash_photo, save_picture
from tests.helpers import assert_close

CONTRACT = ("normal.png", "diffuse.png", "specular.png", "roughness.png", "rendering.png", "report.png")
PNG = {f"wall_{name}" for name in CONTRACT} | {"wall.json"}

ROOT = Path(__file__).parents[2]
FAST = ("--resolution", "64", "--threads", "1")


def script(*arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run the console script in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "refine.cli", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=120)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty current folder."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def cli(checkpoint: Path) -> Callable[..., int]:
    """Return the command line, in this process, with a tiny network and few pixels."""
    return lambda *arguments: refine.cli.run(["--init", str(checkpoint), *FAST, *map(str, arguments)])


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory, photo: Path, checkpoint: Path) -> tuple[Path, str, str]:
    """Run once as a person would; return the current folder, standard output and standard error."""
    prepare()  # compile once, here: a first run would announce it
    cwd = tmp_path_factory.mktemp("cwd")
    done = script(photo, "--init", checkpoint, "--iters", "6", *FAST, "--json", cwd=cwd)
    assert done.returncode == 0, done.stderr
    return cwd, done.stdout, done.stderr


def listing(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_all_files_of_the_contract_are_written_and_nothing_else(result: tuple[Path, str, str]) -> None:
    assert os.listdir(result[0]) == ["wall_material"]
    assert set(os.listdir(result[0] / "wall_material")) == PNG


def test_the_maps_are_legal_and_of_the_right_size(result: tuple[Path, str, str]) -> None:
    maps = read_maps(result[0] / "wall_material", "wall")
    assert maps.validate().size == (40, 64)
    picture = oiio.ImageBuf(str(result[0] / "wall_material" / "wall_rendering.png"))
    assert (picture.spec().width, picture.spec().height, str(picture.spec().format)) == (64, 40, "uint16")


def test_standard_output_is_the_json_alone(result: tuple[Path, str, str]) -> None:
    printed = json.loads(result[1])
    assert printed.pop("folder") == "wall_material"
    assert printed == json.loads((result[0] / "wall_material" / "wall.json").read_text())


def test_standard_error_of_a_pipe_is_one_plain_line(result: tuple[Path, str, str]) -> None:
    assert len(result[2].splitlines()) == 1
    assert "\x1b" not in result[2]
    assert "shrunk from 96 x 60 to 64 x 40" in result[2]


def test_the_json_tells_everything(result: tuple[Path, str, str], photo: Path, checkpoint: Path) -> None:
    record = json.loads((result[0] / "wall_material" / "wall.json").read_text())
    assert record["photo"]["source"] == str(photo)
    assert (record["photo"]["width"], record["photo"]["height"]) == (96, 60)
    assert any("shrunk" in note for note in record["photo"]["notes"])
    assert record["settings"]["iters"] == 6
    assert record["settings"]["seed"] == 0
    assert record["recipe"]["name"] == "default"
    assert record["checkpoint"]["record"]["architecture"] == GeneratorConfig(2, 7, 2).as_dict()
    assert len(record["checkpoint"]["sha256"]) == 64
    assert record["auto_encoders"] == []
    assert len(record["light"]["position"]) == len(record["light"]["intensity"]) == 3
    assert record["light"]["falloff"] == "none"
    assert record["camera"] == {"kind": "perspective", "position": [0.0, 0.0, 2.14]}
    assert set(record["maps"]["files"].values()) == PNG
    assert "sRGB" in record["maps"]["encodings"]["diffuse"]
    assert 0.0 < record["rmse"]["refined"] < record["rmse"]["initialization"] < 1.0
    stages = {name: stage["iterations"] for name, stage in record["losses"].items()}
    assert stages == {"initialization": 0, "global": 3, "posterior": 3}
    curve = record["losses"]["posterior"]["curve"]
    assert len(curve) == 4
    assert (
        record["losses"]["posterior"]["start"] == curve[0] > curve[-1] == record["losses"]["posterior"]["end"]
    )
    assert set(record["versions"]) >= {"svbrdf-refine", "torch", "numpy", "python"}
    assert set(record["seconds"]) >= {"initialization", "global", "posterior"}


def test_same_seed_same_bytes(
    result: tuple[Path, str, str], cli: Callable[..., int], photo: Path, here: Path
) -> None:
    assert cli(photo, "--iters", "6", "--out", "again") == 0
    for name in sorted(PNG):
        first, second = (
            (result[0] / "wall_material" / name).read_bytes(),
            (here / "again" / name).read_bytes(),
        )
        if name.endswith(".json"):
            records = [json.loads(data) for data in (first, second)]
            for record in records:
                del record["seconds"]
            assert records[0] == records[1]
        else:
            assert first == second, name


def test_no_iterations_write_what_the_network_says(
    cli: Callable[..., int], photo: Path, checkpoint: Path, here: Path
) -> None:
    assert cli(photo, "--iters", "0", "--format", "exr32", "--out", "zero") == 0
    expected, light = initialize(
        FlipAverage(load_model(checkpoint)), resize_photo(read_photo(photo), 64).linear
    )
    found = read_maps(here / "zero", "wall")
    for name in MAPS:
        assert_close(getattr(found, name), getattr(expected, name))
    record = json.loads((here / "zero" / "wall.json").read_text())
    assert record["light"]["position"] == pytest.approx(light.position[0].tolist())
    assert record["rmse"]["refined"] == record["rmse"]["initialization"]
    assert (here / "zero" / "wall_report.png").exists()


def test_directx_flips_green_and_exr_is_linear(cli: Callable[..., int], photo: Path, here: Path) -> None:
    common = (photo, "--iters", "0", "--no-report")
    assert cli(*common, "--out", "gl", "--format", "exr") == 0
    assert cli(*common, "--out", "dx", "--format", "exr", "--normals", "directx") == 0
    assert cli(*common, "--out", "png") == 0
    gl, dx, png = (read_maps(here / folder, "wall") for folder in ("gl", "dx", "png"))
    assert_close(dx.normal[:, 1], -gl.normal[:, 1], atol=2e-3)
    assert_close(dx.normal[:, 0], gl.normal[:, 0], atol=2e-3)
    assert_close(png.diffuse, gl.diffuse, atol=2e-3)
    assert set(os.listdir(here / "gl")) == {"wall.json"} | {
        f"wall_{name}.exr" for name in ("normal", "diffuse", "specular", "roughness", "rendering")
    }
    record = json.loads((here / "dx" / "wall.json").read_text())
    assert "DirectX" in record["maps"]["encodings"]["normal"]


def test_uncertainty_is_a_file_for_every_map_and_a_row_of_the_report(
    cli: Callable[..., int], photo: Path, here: Path
) -> None:
    assert cli(photo, "--iters", "4", "--uncertainty", "--out", "doubt") == 0
    assert cli(photo, "--iters", "4", "--out", "sure") == 0
    assert set(os.listdir(here / "doubt")) == PNG | {f"wall_{name}_deviation.png" for name in MAPS}
    encodings = json.loads((here / "doubt" / "wall.json").read_text())["maps"]["encodings"]
    for name in MAPS:
        deviation = oiio.ImageBuf(str(here / "doubt" / f"wall_{name}_deviation.png")).get_pixels()
        assert deviation.shape[2] == 1
        assert float(deviation.min()) > 0.0
        assert "standard deviation" in encodings[f"{name}_deviation"]
        same = (here / folder / f"wall_{name}.png" for folder in ("doubt", "sure"))
        assert len({path.read_bytes() for path in same}) == 1
    tall, short = (oiio.ImageBuf(str(here / f / "wall_report.png")).spec() for f in ("doubt", "sure"))
    assert tall.height > short.height
    assert tall.width == short.width


def test_maps_of_two_runs_never_mix(cli: Callable[..., int], photo: Path, here: Path) -> None:
    folder = here / "wall_material"
    assert cli(photo, "--iters", "1", "--uncertainty") == 0
    (folder / "wall_notes.txt").write_text("mine")
    assert cli(photo, "--iters", "2", "--format", "exr", "--no-report") == 0
    names = {f"wall_{name}.exr" for name in ("normal", "diffuse", "specular", "roughness", "rendering")}
    assert set(os.listdir(folder)) == names | {"wall.json", "wall_notes.txt"}
    assert read_maps(folder, "wall").size == (40, 64)
    # A record that names what is not a run's own removes nothing.
    record = json.loads((folder / "wall.json").read_text())
    record["maps"]["files"] |= {"a": "wall_notes.txt/../wall_notes.txt", "b": "other.png", "c": 3}
    (folder / "wall.json").write_text(json.dumps(record))
    (folder / "other.png").write_text("mine")
    assert cli(photo, "--iters", "1", "--format", "exr", "--no-report") == 0
    assert set(os.listdir(folder)) == names | {"wall.json", "wall_notes.txt", "other.png"}


def test_a_given_light_and_camera_are_kept(cli: Callable[..., int], photo: Path, here: Path) -> None:
    options = ("--light", "0.2,-0.1,2.0", "--falloff", "inverse_square", "--camera", "collocated")
    assert cli(photo, "--iters", "2", "--no-report", *options) == 0
    record = json.loads((here / "wall_material" / "wall.json").read_text())
    assert record["light"]["position"] == pytest.approx([0.2, -0.1, 2.0])
    assert record["light"]["falloff"] == "inverse_square"
    assert record["camera"]["kind"] == "collocated"


def test_an_estimated_light_can_fall_off_too(cli: Callable[..., int], photo: Path, here: Path) -> None:
    options = ("--falloff", "inverse_square", "--camera", "0,0,3")
    assert cli(photo, "--iters", "0", "--no-report", *options) == 0
    record = json.loads((here / "wall_material" / "wall.json").read_text())
    assert record["light"]["falloff"] == "inverse_square"
    assert record["camera"] == {"kind": "perspective", "position": [0.0, 0.0, 3.0]}


def as_turned_jpeg(path: Path) -> tuple[Path, str, tuple[int, int]]:
    return (
        save_picture(path.with_suffix(".jpg"), flash_photo(60, 96), Orientation=6),
        "turned upright",
        (64, 40),
    )


def as_grey(path: Path) -> tuple[Path, str, tuple[int, int]]:
    return save_picture(path, flash_photo(64, 64)[..., :1], "uint16"), "grey", (64, 64)


def as_rgba(path: Path) -> tuple[Path, str, tuple[int, int]]:
    pixels = np.concatenate([flash_photo(40, 64), np.full((40, 64, 1), 0.5, np.float32)], axis=-1)
    return save_picture(path, pixels), "alpha dropped", (40, 64)


def as_linear_exr(path: Path) -> tuple[Path, str, tuple[int, int]]:
    return save_picture(path.with_suffix(".exr"), flash_photo(50, 30), "half"), "linear", (50, 30)


@pytest.mark.parametrize("make", [as_turned_jpeg, as_grey, as_rgba, as_linear_exr])
def test_any_photo_is_taken_and_what_was_done_is_said(
    make: Callable[[Path], tuple[Path, str, tuple[int, int]]],
    cli: Callable[..., int],
    here: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    picture, note, size = make(tmp_path / "picture.png")
    assert cli(picture, "--iters", "1", "--no-report") == 0
    assert read_maps(here / "picture_material", "picture").size == size
    assert note in capsys.readouterr().err
    assert note in " ".join(
        json.loads((here / "picture_material" / "picture.json").read_text())["photo"]["notes"]
    )


def test_quick_and_quiet(
    cli: Callable[..., int], photo: Path, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli(photo, "--quick", "--quiet") == 0
    assert tuple(capsys.readouterr()) == ("", "")
    assert set(os.listdir(here / "wall_material")) == PNG - {"wall_report.png"}
    losses = json.loads((here / "wall_material" / "wall.json").read_text())["losses"]
    assert sum(stage["iterations"] for stage in losses.values()) == 50


# --- mistakes ---


def bad_arguments(*arguments: str) -> Callable[[Path, Path], list[str]]:
    return lambda folder, photo: [str(photo), *arguments]


def missing(folder: Path, photo: Path) -> list[str]:
    return ["no_such.png"]


def an_empty_folder(folder: Path, photo: Path) -> list[str]:
    (folder / "empty").mkdir()
    return ["empty"]


def an_empty_file(folder: Path, photo: Path) -> list[str]:
    (folder / "bad.png").touch()
    return ["bad.png"]


def text(folder: Path, photo: Path) -> list[str]:
    (folder / "bad.png").write_text("not a picture at all\n" * 40)
    return ["bad.png"]


def one_pixel(folder: Path, photo: Path) -> list[str]:
    return [str(save_picture(folder / "bad.png", np.full((1, 1, 3), 0.5, np.float32)))]


def nan(folder: Path, photo: Path) -> list[str]:
    pixels = flash_photo(32, 32)
    pixels[3, 4, 1] = np.nan
    return [str(save_picture(folder / "bad.exr", pixels, "float"))]


def cut_short(folder: Path, photo: Path) -> list[str]:
    (folder / "bad.png").write_bytes(photo.read_bytes()[:600])
    return ["bad.png"]


def another_architecture(folder: Path, photo: Path) -> list[str]:
    path = folder / "other.safetensors"
    save_model(path, Generator(GeneratorConfig(2, 7, 2)), Record(GeneratorConfig(4, 7, 2)))
    return [str(photo), "--init", str(path)]


def text_as_checkpoint(folder: Path, photo: Path) -> list[str]:
    (folder / "other.safetensors").write_text("hello")
    return [str(photo), "--init", "other.safetensors"]


def foreign_state_dict(folder: Path, photo: Path) -> list[str]:
    torch.save({"layer.weight": torch.zeros(3)}, folder / "other.pth")
    return [str(photo), "--init", "other.pth"]


class Malicious:
    """Unpickling this makes a file."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, ("pwned",)


def malicious_pickle(folder: Path, photo: Path) -> list[str]:
    (folder / "evil.pth").write_bytes(pickle.dumps({"layer": Malicious()}))
    return [str(photo), "--init", "evil.pth"]


def malicious_archive(folder: Path, photo: Path) -> list[str]:
    torch.save({"layer": Malicious()}, folder / "evil.pt")
    return [str(photo), "--init", "evil.pt"]


def out_is_a_file(folder: Path, photo: Path) -> list[str]:
    (folder / "taken").touch()
    return [str(photo), "--out", "taken"]


def out_below_a_file(folder: Path, photo: Path) -> list[str]:
    (folder / "taken").touch()
    return [str(photo), "--out", "taken/new/folder"]


def a_folder_in_the_way(folder: Path, photo: Path) -> list[str]:
    (folder / "out" / "wall_report.png").mkdir(parents=True)
    return [str(photo), "--out", "out"]


def over_the_photo(folder: Path, photo: Path) -> list[str]:
    (folder / "wall.json").write_bytes(photo.read_bytes())  # a PNG all the same
    return ["wall.json", "--out", "."]


@pytest.mark.parametrize(
    ("mistake", "hint"),
    [
        (missing, "no_such.png does not exist"),
        (an_empty_folder, "The folder empty holds no photos"),
        (an_empty_file, "bad.png is empty"),
        (text, "bad.png is not an image"),
        (one_pixel, "1 x 1"),
        (nan, "NaN"),
        (cut_short, "bad.png is damaged"),
        (another_architecture, "another architecture"),
        (text_as_checkpoint, "not a safetensors file"),
        (foreign_state_dict, "another architecture"),
        (malicious_pickle, "refused"),
        (malicious_archive, "refused"),
        (out_is_a_file, "taken"),
        (out_below_a_file, "taken"),
        (a_folder_in_the_way, "wall_report.png"),
        (over_the_photo, "replace the photo"),
        (bad_arguments("--init", "no_such.safetensors"), "no_such.safetensors"),
        (bad_arguments("--iters", "-3"), "--iters -3"),
        (bad_arguments("--iters", "many"), "--iters"),
        (bad_arguments("--seed", "-1"), "--seed -1"),
        (bad_arguments("--threads", "0"), "--threads 0"),
        (bad_arguments("--resolution", "5"), "5 x 3"),
        (bad_arguments("--light", "1,2"), "--light"),
        (bad_arguments("--light", "0,0,nan"), "--light"),
        (bad_arguments("--light", "0,0,-2"), "in front of the surface"),
        (bad_arguments("--camera", "fisheye"), "collocated"),
        (bad_arguments("--falloff", "linear"), "inverse_square"),
        (bad_arguments("--light", "0,0,2", "--falloff", "auto"), "leave out --light"),
        (bad_arguments("--color-space", "rec2020"), "display-p3"),
        (bad_arguments("--normals", "vulkan"), "directx"),
        (bad_arguments("--recipe", "soup"), "paper"),
        (bad_arguments("--format", "gif"), "exr32"),
        (bad_arguments("--device", "cuda:99"), "--device cpu"),
        (bad_arguments("--device", "toaster"), "--device cpu"),
        (bad_arguments("--iter", "3"), "--iters"),
        (bad_arguments("second.png"), "second.png"),
        (lambda folder, photo: [], "PHOTO"),
    ],
)
def test_a_mistake_ends_in_one_sentence_and_leaves_nothing(
    mistake: Callable[[Path, Path], list[str]],
    hint: str,
    cli: Callable[..., int],
    photo: Path,
    here: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    arguments = mistake(here, photo)
    before = listing(here), listing(photo.parent)
    assert cli(*arguments) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert hint in err
    assert err.startswith("refine: ")
    assert err.count("\n") == 1
    assert err.endswith(".\n")
    assert (listing(here), listing(photo.parent)) == before


def test_a_process_ends_with_2_and_no_traceback(photo: Path, tmp_path: Path) -> None:
    done = script(photo, "--iters", "-3", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert listing(tmp_path) == []


def test_help_and_version_do_not_wait_for_torch(tmp_path: Path) -> None:
    program = (
        "import sys; from refine.cli import run; codes = [run(['--version']), run(['--help'])];"
        "sys.exit(1 if any(codes) or {'torch', 'matplotlib', 'scipy'} & set(sys.modules) else 0)"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "80"}
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert re.match(r"refine \S+\n", done.stdout)
    assert "--color-space" in done.stdout
    assert len(done.stdout.splitlines()) < 50


def test_a_failure_while_writing_leaves_nothing(
    cli: Callable[..., int],
    photo: Path,
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(refine.result, "write_sheet", interrupted)
    assert cli(photo, "--iters", "1") == 130
    assert capsys.readouterr().err == "refine: interrupted; nothing was written.\n"
    assert listing(here) == []


def test_a_terminal_sees_progress_and_control_c_keeps_the_best_so_far(
    photo: Path, checkpoint: Path, tmp_path: Path
) -> None:
    ours, theirs = pty.openpty()
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
        "TERM": "xterm",
        "COLUMNS": "100",
    }
    options = ("--iters", "100000", "--engine", "reference")  # the fused engine might be done too soon
    command = [sys.executable, "-m", "refine.cli", photo, "--init", checkpoint, *options, *FAST]
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        env=environment,
        stderr=theirs,
        stdout=subprocess.PIPE,
        # A shell's background jobs, and all they start, are born deaf to Control-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        os.close(theirs)
        seen = b""
        while b"loss 0." not in seen and b"loss 1." not in seen:
            seen += os.read(ours, 1024)
        process.send_signal(signal.SIGINT)
        while b"interrupted" not in seen:
            seen += os.read(ours, 1024)
        assert process.wait(timeout=60) == 130
        assert b"interrupted; the best until then is in wall_material." in seen
    os.close(ours)
    assert b"global" in seen
    assert b"Traceback" not in seen
    assert set(os.listdir(tmp_path / "wall_material")) == PNG
    assert read_maps(tmp_path / "wall_material", "wall").size == (40, 64)
    record = json.loads((tmp_path / "wall_material" / "wall.json").read_text())
    assert record["interrupted"] is True
    assert record["losses"]["global"]["iterations"] < 50_000
    assert record["rmse"]["refined"] <= record["rmse"]["initialization"]


def test_the_shipped_checkpoint_is_the_default(photo: Path, here: Path) -> None:
    assert refine.cli.run([str(photo), "--iters", "20", "--no-report", *FAST]) == 0
    record = json.loads((here / "wall_material" / "wall.json").read_text())
    assert record["checkpoint"]["name"] == "default"
    assert record["checkpoint"]["record"]["data"]
    assert record["rmse"]["refined"] < 0.5 * record["rmse"]["initialization"]
