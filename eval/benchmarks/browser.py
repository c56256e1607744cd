"""An exported GLB rendered by three.js in a headless browser, for `eval.benchmarks.exports`.

A page is served on this machine, renders into a float target, and posts the pixels back. A point light of I
candela gives a white Lambertian surface that faces it at the distance r the radiance I / (pi r^2).
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import threading
from collections.abc import Mapping
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from refine.errors import UserError

PATIENCE = 120.0
"""Seconds until a browser that has not answered is given up."""

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
"""Of Chromium, for WebGL without a GPU and without a user."""

PAGE = """<!doctype html>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js"}}</script>
<script>
  const tell = (path, body) => fetch(path, {method: "POST", body});
  addEventListener("error", (event) => tell("/error", String(event.message)));
  addEventListener("unhandledrejection", (event) => tell("/error", String(event.reason)));
</script>
<script type="module">
  import * as THREE from "three";
  import {GLTFLoader} from "/three/examples/jsm/loaders/GLTFLoader.js";
  const {width, height, lights} = SETTINGS;
  const renderer = new THREE.WebGLRenderer();
  const scene = new THREE.Scene();
  scene.add((await new GLTFLoader().loadAsync("/material.glb")).scene);
  const longer = Math.max(width, height);
  const angle = (360 / Math.PI) * Math.atan(height / longer / 2.14);
  const camera = new THREE.PerspectiveCamera(angle, width / height, 0.1, 10);
  camera.position.set(0, 0, 2.14);
  const lamp = new THREE.PointLight(0xffffff, 1, 0, 2);
  scene.add(lamp);
  const target = new THREE.WebGLRenderTarget(width, height, {type: THREE.FloatType});
  renderer.setRenderTarget(target);
  for (const [name, position] of Object.entries(lights)) {
    lamp.position.set(...position);
    lamp.intensity = Math.PI * lamp.position.lengthSq();
    renderer.render(scene, camera);
    const pixels = new Float32Array(width * height * 4);
    renderer.readRenderTargetPixels(target, 0, 0, width, height, pixels);
    await tell("/light/" + name, pixels.buffer);
  }
  tell("/done", "");
</script>
"""


def render_in_browser(
    glb: Path,
    lights: Mapping[str, tuple[float, float, float]],
    width: int,
    height: int,
    *,
    three: Path,
    browser: str,
) -> dict[str, Float[Tensor, "1 3 height width"]]:
    """Render the plane of a GLB under lights that fall off with the squared distance, 1 at the centre.

    Args:
        glb: the file.
        lights: positions by name.
        width: of the pictures, pixels.
        height: of the pictures, pixels.
        three: the npm package `three`, unpacked.
        browser: a Chromium.

    Returns:
        Linear radiance by light.

    Raises:
        UserError: three.js or the browser is not there, or does not render.
    """
    if not (three / "build" / "three.module.js").exists():
        raise UserError(f"{three} is not the npm package three; unpack what npm pack three fetches.")
    settings = {"width": width, "height": height, "lights": dict(lights)}
    with tempfile.TemporaryDirectory(prefix="refine-") as temporary:
        folder = Path(temporary)
        (folder / "index.html").write_text(PAGE.replace("SETTINGS", json.dumps(settings)), encoding="utf-8")
        (folder / "material.glb").write_bytes(glb.read_bytes())
        (folder / "three").symlink_to(three.resolve())
        answers = _visit(browser, folder)
    if "/done" not in answers:
        reason = answers.get("/error", b"no answer").decode(errors="replace")
        raise UserError(f"{browser} could not render: {reason}; try another one with --browser.")
    return {name: _picture(answers[f"/light/{name}"], width, height) for name in lights}


def _picture(answer: bytes, width: int, height: int) -> Float[Tensor, "1 3 height width"]:
    """Turn WebGL's pixels, the lowest row first, into an image."""
    rows = np.frombuffer(answer, dtype="<f4").reshape(height, width, 4)[::-1, :, :3]
    return torch.from_numpy(np.ascontiguousarray(rows.transpose(2, 0, 1)))[None]


def _visit(browser: str, folder: Path) -> dict[str, bytes]:
    """Serve a folder, let the browser open its index, and return what the page posts, by path."""
    answers: dict[str, bytes] = {}
    done = threading.Event()

    class Handler(SimpleHTTPRequestHandler):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments, directory=str(folder))

        def do_POST(self) -> None:
            answers[self.path] = self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(204)
            self.end_headers()
            if self.path in ("/done", "/error"):
                done.set()

        def log_message(self, *arguments: Any) -> None:
            pass

    with (
        ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server,
        tempfile.TemporaryDirectory(prefix="refine-", ignore_cleanup_errors=True) as profile,
    ):
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/index.html"
        command = [browser, *FLAGS, f"--user-data-dir={profile}", address]
        try:
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        except OSError as error:
            raise UserError(
                f"{browser} cannot be started ({error.strerror}); name a Chromium with --browser."
            ) from error
        try:
            done.wait(PATIENCE)
        finally:
            process.terminate()
            process.wait()
            server.shutdown()
    return answers
