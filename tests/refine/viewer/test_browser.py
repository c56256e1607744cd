"""The page in headless Chromium: its shader against `nets.render`, and names that would be markup."""

from __future__ import annotations

import subprocess
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nets.color import linear_to_srgb
from nets.render import Camera, PointLight, render
from refine.files import decode_image
from refine.maps import read_maps
from refine.viewer import build_page

from .conftest import HEIGHT, WIDTH, WriteResult
from .devtools import BROWSER, FLAGS, needs_browser

pytestmark = needs_browser


def visit(page: Path, fragment: str, *flags: str) -> str:
    """Open a page and return what Chromium prints."""
    assert BROWSER is not None
    profile = page.parent / "profile"
    command = [
        BROWSER,
        *FLAGS,
        "--virtual-time-budget=10000",
        f"--user-data-dir={profile}",
        *flags,
        f"{page.as_uri()}#{fragment}",
    ]
    return subprocess.run(command, capture_output=True, text=True, timeout=180, check=True).stdout


def frame(page: Path, fragment: str) -> Float[Tensor, "1 3 h w"]:
    """Return what the page shows, a pixel of the maps for a pixel of the screen, sRGB-encoded."""
    shot = page.parent / "shot.png"
    visit(page, f"bare=1&{fragment}", f"--screenshot={shot}")
    pixels = decode_image(shot).pixels[:HEIGHT, :WIDTH, :3]
    return torch.from_numpy(pixels.copy()).permute(2, 0, 1)[None]


def test_the_shader_is_our_renderer(tmp_path: Path, write_result: WriteResult) -> None:
    cases = {
        "plain": (PointLight.at((-0.7, 0.5, 0.9)), Camera()),
        "falling": (
            PointLight.at((0.4, 0.3, 0.5), (0.9, 0.7, 0.4), "inverse_square"),
            Camera("perspective", (0.5, -0.4, 1.8)),
        ),
    }
    for name, (light, camera) in cases.items():
        x, y, z = light.position[0].tolist()
        write_result(
            tmp_path / name,
            "wall",
            light={
                "position": [0.0, 0.0, 2.0],
                "intensity": light.intensity[0].tolist(),
                "falloff": light.falloff,
            },
            camera={"kind": camera.kind, "position": list(camera.position)},
        )
        page = tmp_path / name / "page.html"
        page.write_text(build_page([tmp_path / name]), encoding="utf-8")
        shown = frame(page, f"light={x},{y},{z}")
        maps = read_maps(tmp_path / name, "wall")
        expected = linear_to_srgb(render(maps, light, camera).clamp(max=1.0))
        assert 0.05 < expected.mean() < 0.95
        error = (shown - expected).abs().amax(dim=1) * 255.0
        share = float((error <= 2.0).float().mean())
        print(f"{name}: largest error {float(error.max()):.2f}/255, within 2/255 on {share:.2%} of pixels")
        assert share >= 0.99, f"{name}: within 2/255 on {share:.2%}, largest {float(error.max()):.1f}"


def test_names_that_would_be_markup_are_text(tmp_path: Path, write_result: WriteResult) -> None:
    source = "</script><script>document.title = 'run'</script>.png"
    write_result(tmp_path, "<b onclick=alert(1)>x", photo={"source": source, "sha256": None})
    page = tmp_path / "page.html"
    page.write_text(build_page([tmp_path]), encoding="utf-8")
    document = visit(page, "", "--dump-dom")
    assert "&lt;b onclick=alert(1)&gt;x</h1>" in document
    assert "<title>&lt;b onclick=alert(1)&gt;x - refine</title>" in document
    assert "<b onclick" not in document
    assert "data-ready" in document
