"""`refine video`: every frame is the renderer's picture of the maps on disk under the light of its time."""

from __future__ import annotations

import json
import math
from pathlib import Path

import av
import numpy as np
import pytest
import torch

import refine.cli
from nets.color import linear_to_srgb
from nets.render import Camera, PointLight, render
from nets.svbrdf import SVBRDF
from refine.errors import UserError
from refine.maps import read_maps, write_maps
from refine.result import FORMAT
from refine.shrinking import shrink
from refine.video.frames import read_scene, relit_frames

HEIGHT, WIDTH = 48, 64


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a result: a smooth bump, shiny, under a reddish light that falls off."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, HEIGHT), torch.linspace(-1, 1, WIDTH), indexing="ij")
    slopes = torch.stack([-0.6 * x, -0.6 * y, torch.ones_like(x)])[None]
    flat = SVBRDF.constant(HEIGHT, WIDTH, diffuse=0.4, roughness=0.4, specular=0.1)
    normal = torch.nn.functional.normalize(slopes, dim=1)
    paths = write_maps(tmp_path / "wall", "wall", SVBRDF(normal, flat.diffuse, flat.roughness, flat.specular))
    record = {
        "format": FORMAT,
        "settings": {"format": "png", "normals": "opengl"},
        "light": {"position": [0, 0, 2], "intensity": [1.2, 0.9, 0.8], "falloff": "inverse_square"},
        "camera": {"kind": "orthographic", "position": [0, 0, 2.14]},
        "maps": {"files": {name: path.name for name, path in paths.items()}},
    }
    (tmp_path / "wall" / "wall.json").write_text(json.dumps(record))
    return tmp_path / "wall"


def rendered(folder: Path, angle: float, falloff: str = "inverse_square") -> np.ndarray:
    light = PointLight.at((math.cos(angle), math.sin(angle), 1.0), (1.2, 0.9, 0.8), falloff)  # type: ignore[arg-type]
    linear = render(read_maps(folder, "wall"), light, Camera("orthographic")).clamp(max=1.0)
    return np.asarray(linear_to_srgb(linear)[0].permute(1, 2, 0).numpy() * 255.0)


@pytest.mark.parametrize("options", [[], ["--falloff", "none"]], ids=["as the result's", "none"])
def test_every_frame_is_the_renderer_s(options: list[str], folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "new" / "wall.mp4"
    assert (
        refine.cli.run(["video", str(folder), "--to", str(path), "--seconds", "1", "--fps", "8", *options])
        == 0
    )
    with av.open(str(path)) as container:
        frames = [frame.to_ndarray(format="rgb24").astype(float) for frame in container.decode(video=0)]
    assert len(frames) == 8
    falloff = options[1] if options else "inverse_square"
    errors = np.array(
        [
            [
                np.abs(frame - rendered(folder, 2.0 * math.pi * other / 8, falloff)).mean()
                for other in range(8)
            ]
            for frame in frames
        ]
    )
    assert np.diag(errors).max() < 3.0  # of 255, after compression
    assert (errors.argmin(axis=1) == np.arange(8)).all()


def test_frames_are_exact_before_compression(folder: Path) -> None:
    _, scene = read_scene(folder, None, 0)
    (frame,) = relit_frames(scene, [(1.0, 0.0, 1.0)])
    assert np.abs(frame - rendered(folder, 0.0)).max() <= 0.5 + 1e-3
    (brighter,) = relit_frames(scene, [(1.0, 0.0, 1.0)], exposure=1.0)
    assert brighter.mean() > 1.2 * frame.mean()


def test_large_maps_make_small_frames(folder: Path) -> None:
    name, scene = read_scene(folder, "wall", 16)
    assert (name, scene.svbrdf.size) == ("wall", (12, 16))
    whole = read_maps(folder, "wall")
    assert scene.svbrdf.validate().normal.shape == (1, 3, 12, 16)
    assert torch.allclose(scene.svbrdf.diffuse, whole.diffuse[..., ::4, ::4], atol=1e-4)
    with pytest.raises(ValueError, match="cannot be shrunk"):
        shrink(whole, 2 * HEIGHT, WIDTH)


def test_a_camera_at_the_flash_does_not_follow_the_light(folder: Path) -> None:
    record = json.loads((folder / "wall.json").read_text())
    record["camera"]["kind"] = "collocated"
    (folder / "wall.json").write_text(json.dumps(record))
    assert read_scene(folder, None, 0)[1].camera == Camera()


@pytest.mark.parametrize("damage", [{"light": None}, {"camera": {"kind": "fisheye", "position": [0, 0, 1]}}])
def test_a_damaged_record_is_refused(damage: dict[str, object], folder: Path) -> None:
    record = json.loads((folder / "wall.json").read_text())
    (folder / "wall.json").write_text(json.dumps(record | damage))
    with pytest.raises(UserError, match="does not say how its photo was lit"):
        read_scene(folder, None, 0)


def test_the_default_file_is_beside_the_maps(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert refine.cli.run(["video", str(folder), "--seconds", "0.1", "--size", "32", "--path", "sweep"]) == 0
    assert (folder / "wall_relit.mp4").is_file()
    assert "2 frames" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--to", "wall.avi"], "end it in .mp4"),
        (["--path", "spiral"], "figure-eight"),
        (["--fps", "0"], "--fps 0"),
        (["--seconds", "nan"], "--seconds nan"),
        (["--seconds", "600", "--fps", "120"], "72000 frames"),
        (["--falloff", "linear"], "inverse_square"),
        (["--name", "floor"], "floor"),
    ],
)
def test_mistakes_end_in_one_sentence(
    arguments: list[str], sentence: str, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    before = sorted(folder.iterdir())
    assert refine.cli.run(["video", str(folder), *arguments]) == 2
    error = capfd.readouterr().err
    assert sentence in error
    assert len(error.splitlines()) == 1
    assert sorted(folder.iterdir()) == before
