"""`python -m eval.benchmarks.exports`: exported materials rendered by Cycles and three.js, and by us.

Told is the RMSE against `nets.render`, both gamma-encoded (1/2.2), under the same light and camera. Others
shade with their own Fresnel, masking and layering, so it is not 0.

--python INTERPRETER renders Blender's export with Cycles: an interpreter that has Blender (`pip install bpy`,
360 MB, in an environment of its own). A point lamp of P watts gives a white Lambertian surface that faces it
at the distance r the radiance P / (4 pi^2 r^2). Ours is 1 for a light of intensity 1, so P is 4 pi^2 r^2, r
being the light's distance from the centre, where our inverse-square falloff is 1.

--three FOLDER renders the GLB with three.js in a headless browser: the unpacked package of `npm pack three`.
"""

from __future__ import annotations

import argparse
import inspect
import json
import math
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import torch
from jaxtyping import Float
from torch import Tensor

from eval.benchmarks.browser import render_in_browser
from eval.report import markdown_table, number, origin, provenance
from nets.color import gamma_encode, linear_to_srgb
from nets.data.procedural import generate
from nets.render import AUTHORS_CAMERA, PointLight, render
from nets.svbrdf import SVBRDF
from refine.errors import UserError
from refine.export import export_material
from refine.export.source import read_result

LIGHTS = {"flash": AUTHORS_CAMERA, "oblique": (0.9, 0.5, 1.5)}
"""Positions of the light, by name; it falls off with the squared distance."""

FAMILIES = {
    "white Lambertian": None,
    "rough dielectric (plaster)": "plaster",
    "wet dielectric (slate)": "slate",
    "glossy dielectric (glazed tile)": "glazed_tile",
    "metal (hammered)": "hammered_metal",
    "metal (brushed)": "brushed_metal",
    "metal under paint (rusted paint)": "rusted_paint",
}
"""Generated materials to render, by what they are."""

SEED = 3


@dataclass(frozen=True)
class Comparison:
    """One material under one light.

    Attributes:
        renderer: Cycles or three.js.
        material: its name.
        light: a name in `LIGHTS`.
        rmse: of gamma-encoded renderings, clipped at 1.
        bias: mean of theirs minus ours, gamma-encoded.
    """

    renderer: str
    material: str
    light: str
    rmse: float
    bias: float


def render_in_cycles(script: str, jobs: list[dict[str, Any]], width: int, height: int, samples: int) -> None:
    """Render the plane of an exported script under lamps; runs in Blender, so it imports what it needs.

    Args:
        script: path of the exported script.
        jobs: each with the lamp's `position` and `power` and the `file` to write, a linear EXR.
        width: of the pictures, pixels.
        height: of the pictures, pixels.
        samples: per pixel.
    """
    import math
    import runpy

    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    runpy.run_path(script)["plane"]()
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location = (0.0, 0.0, 2.14)
    camera.data.angle = 2.0 * math.atan(1.0 / 2.14)  # the longer side, which spans [-1, 1]
    scene.camera = camera
    lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "POINT"))
    lamp.data.shadow_soft_size = 0.0
    for made in (camera, lamp):
        scene.collection.objects.link(made)
    scene.render.engine = "CYCLES"
    scene.cycles.samples = samples
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.use_denoising = False
    scene.cycles.max_bounces = 0
    scene.cycles.pixel_filter_type = "BLACKMAN_HARRIS"  # the one whose width can be set
    scene.cycles.filter_width = 0.01  # pixel centres, as ours
    scene.render.threads_mode = "FIXED"
    scene.render.threads = 1
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.resolution_percentage = 100
    scene.view_settings.view_transform = "Standard"
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    for job in jobs:
        lamp.location = job["position"]
        lamp.data.energy = job["power"]
        scene.render.filepath = job["file"]
        bpy.ops.render.render(write_still=True)


def _file_name(name: str) -> str:
    return "".join(letter if letter.isalnum() else "_" for letter in name).strip("_")


Pictures = dict[str, Float[Tensor, "1 3 height width"]]
"""Linear radiance by light."""

Renderer = Callable[[SVBRDF, Path], Pictures]
"""Exports a material into a folder and renders it under all of `LIGHTS`."""


def cycles(python: str, samples: int) -> Renderer:
    """Return Cycles, in an interpreter that has Blender.

    The renderer raises a `UserError` if the interpreter cannot render.
    """

    def renderer(svbrdf: SVBRDF, folder: Path) -> Pictures:
        export_material(svbrdf, folder, "material", ["blender"])
        files = {light: folder / f"{light}.exr" for light in LIGHTS}
        jobs = [
            {
                "position": position,
                "power": 4.0 * math.pi**2 * sum(coordinate**2 for coordinate in position),
                "file": str(files[light].resolve()),
            }
            for light, position in LIGHTS.items()
        ]
        height, width = svbrdf.size
        script = str((folder / "material_blender.py").resolve())
        call = f"render_in_cycles({script!r}, {jobs!r}, {width}, {height}, {samples})"
        driver = folder / "driver.py"
        source = inspect.getsource(render_in_cycles)
        driver.write_text(f"from typing import Any\n\n\n{source}\n\n{call}\n", encoding="utf-8")
        done = subprocess.run([python, str(driver)], capture_output=True, text=True)
        if done.returncode != 0:
            reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise UserError(f"{python} could not render: {reason}; give an interpreter with bpy as --python.")
        return {light: _read_exr(file) for light, file in files.items()}

    return renderer


def three_js(package: Path, browser: str) -> Renderer:
    """Return three.js, in a headless browser; it raises a `UserError` as `render_in_browser` does."""

    def renderer(svbrdf: SVBRDF, folder: Path) -> Pictures:
        export_material(svbrdf, folder, "material", ["gltf"])
        height, width = svbrdf.size
        return render_in_browser(
            folder / "material.glb", LIGHTS, width, height, three=package, browser=browser
        )

    return renderer


def _read_exr(path: Path) -> Float[Tensor, "1 3 height width"]:
    pixels = np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT))[..., :3]
    return torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)))[None]


def compare(
    renderer: str, material: str, svbrdf: SVBRDF, theirs: Pictures
) -> tuple[list[Comparison], Float[Tensor, "3 rows columns"]]:
    """Compare renderings with ours under all lights.

    Returns:
        What was measured, and a picture, sRGB-encoded: a row for each light, ours left, theirs right.
    """
    found, rows = [], []
    for light, picture in theirs.items():
        ours = render(svbrdf, PointLight.at(LIGHTS[light], falloff="inverse_square"))
        difference = gamma_encode(picture) - gamma_encode(ours)
        rmse, bias = float(difference.square().mean().sqrt()), float(difference.mean())
        found.append(Comparison(renderer, material, light, rmse, bias))
        rows.append(linear_to_srgb(torch.cat([ours, picture], dim=-1).clamp(0.0, 1.0))[0])
    return found, torch.cat(rows, dim=-2)


def materials(size: int, results: Sequence[Path]) -> dict[str, SVBRDF]:
    """Return what is rendered: generated materials, and results of `refine`."""
    made = {name: _generated(family, size) for name, family in FAMILIES.items()}
    return made | {f"result ({folder.name})": read_result(folder).svbrdf for folder in results}


def _generated(family: str | None, size: int) -> SVBRDF:
    if family is None:
        return SVBRDF.constant(size, size, diffuse=1.0, roughness=1.0, specular=0.0)
    maps = generate(family, size, SEED)
    planes = (maps.normal, maps.diffuse, maps.roughness[..., None], maps.specular)
    return SVBRDF(*(torch.from_numpy(plane).movedim(-1, 0)[None].contiguous() for plane in planes)).validate()


def table(comparisons: Sequence[Comparison]) -> list[str]:
    """Return the lines of a Markdown table."""
    rows = [[c.material, c.renderer, c.light, number(c.rmse, 4), number(c.bias, 4)] for c in comparisons]
    return markdown_table(["material", "renderer", "light", "RMSE", "bias"], rows, 3)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m eval.benchmarks.exports",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--python", help="an interpreter that has bpy")
    parser.add_argument("--three", type=Path, help="the npm package three, unpacked")
    parser.add_argument("--browser", default="chromium", help="a Chromium")
    parser.add_argument("--results", type=Path, nargs="*", default=[], help="folders that refine wrote")
    parser.add_argument("--size", type=int, default=128, help="of generated materials, pixels")
    parser.add_argument("--samples", type=int, default=8, help="of Cycles, per pixel")
    parser.add_argument("--out", type=Path, default=Path("benchmark-exports"), help="folder")
    options = parser.parse_args(arguments)
    renderers: dict[str, Renderer] = {}
    if options.python:
        renderers["Cycles"] = cycles(options.python, options.samples)
    if options.three:
        renderers["three.js"] = three_js(options.three, options.browser)
    if not renderers:
        parser.error("give --python, --three or both")
    comparisons: list[Comparison] = []
    for material, svbrdf in materials(options.size, options.results).items():
        for name, renderer in renderers.items():
            folder = options.out / _file_name(f"{material} {name}")
            folder.mkdir(parents=True, exist_ok=True)
            found, picture = compare(name, material, svbrdf, renderer(svbrdf, folder))
            comparisons += found
            image = oiio.ImageBuf(np.ascontiguousarray(picture.movedim(0, -1).numpy()))
            image.write(f"{folder}.png", "uint8")
            print(f"{material}, {name}: {', '.join(f'{c.light} {c.rmse:.4f}' for c in found)}", flush=True)
    settings = {"size": options.size, "samples": options.samples, "seed": SEED, **provenance()}
    caption = (
        "Exported materials rendered by others, against `nets.render`: gamma-encoded (1/2.2), "
        f"{options.size} px, inverse-square light; {origin(settings)}."
    )
    text = "\n".join([caption, "", *table(comparisons)])
    record = {"settings": settings, "comparisons": [asdict(c) for c in comparisons]}
    (options.out / "exports.json").write_text(json.dumps(record, indent=2) + "\n")
    (options.out / "exports.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
