"""One result on disk: maps, re-rendering, report and a JSON of how they were made. All of it or nothing.

What the maps' files hold is the business of `maps.py`, what the report shows that of `report/`.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import re
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nets.checkpoint import read_record, resolve
from nets.render import PointLight
from nets.text import parse_json
from refine import __version__
from refine.bands import render_in_bands
from refine.capture import Capture
from refine.errors import UserError
from refine.fidelity import rerendering_rmse
from refine.files import write_together
from refine.maps import (
    MAP_NAMES,
    RENDERING,
    MapFormat,
    NormalConvention,
    map_paths,
    write_image,
    write_maps,
)
from refine.photo import Photo
from refine.refiner import Refined
from refine.report.sheet import write_sheet
from refine.report.thumbnail import write_thumbnail
from refine.stages import LatentStage, Recipe

FORMAT = "svbrdf-refine result 1"

MAP_FORMATS: dict[str, MapFormat] = {
    "png": MapFormat("png", 16),
    "png8": MapFormat("png", 8),
    "exr": MapFormat("exr", 16),
    "exr32": MapFormat("exr", 32),
    "tif": MapFormat("tif", 16),
    "tif8": MapFormat("tif", 8),
    "tif32": MapFormat("tif", 32),
}
"""Formats by the name they are asked for."""

SECONDS = "seconds"
"""The one key of the JSON whose values differ from run to run."""


@dataclass(frozen=True)
class Output:
    """Where and how a result is written.

    Attributes:
        folder: created if missing.
        stem: beginning of every file name.
        format: a name in `MAP_FORMATS`.
        normals: what the green channel of the normal file means.
        report: whether `<stem>_report.png` is written.
        uncertainty: whether `<stem>_normal_deviation` and so on are written, and drawn in the report.
        thumbnail: whether `<stem>_thumbnail.jpg` is written, for an index of many results.
    """

    folder: Path
    stem: str
    format: str = "png"
    normals: NormalConvention = "opengl"
    report: bool = True
    uncertainty: bool = False
    thumbnail: bool = False

    def paths(self) -> dict[str, Path]:
        """Return every file of the result: maps and deviations by name, `rendering`, `report`, `json`.

        The record comes last, as `write_together` has it: where it is, the others are of the same run.
        """
        format = MAP_FORMATS[self.format]
        paths = map_paths(self.folder, self.stem, format=format)
        if self.uncertainty:
            for name in MAP_NAMES:
                key = _deviation(name)
                paths[key] = self.folder / f"{self.stem}_{key}.{format.extension}"
        if self.report:
            paths["report"] = self.folder / f"{self.stem}_report.png"
        if self.thumbnail:
            paths["thumbnail"] = self.folder / f"{self.stem}_thumbnail.jpg"
        return paths | {"json": self.folder / f"{self.stem}.json"}

    def require_writable(self, photo: Path) -> None:
        """Find out before the work, not after it, whether the files can be written; leaves nothing behind.

        Raises:
            UserError: a file could not be written, or would replace the photo itself.
        """
        for path in self.paths().values():
            if path.exists() and photo.exists() and path.samefile(photo):
                raise UserError(f"Writing {path} would replace the photo; give another folder with --out.")
        try:
            with write_together(list(self.paths().values())):
                raise _ProbeError
        except _ProbeError:
            pass


class _ProbeError(Exception):
    """Leaves `write_together` without writing."""


def write_result(refined: Refined, output: Output, record: dict[str, Any]) -> dict[str, Path]:
    """Write every file of a result, or none if anything goes wrong or is interrupted.

    Files that an earlier run of the same name left and this one does not replace (maps in another format, a
    report) are removed at the end, so that the folder never holds maps of two runs.

    Args:
        refined: the result.
        output: where and how.
        record: the JSON's content, see `describe`.

    Returns:
        The path of every file, keyed as in `Output.paths`.

    Raises:
        UserError: a file cannot be written.
    """
    paths = output.paths()

    def outdated() -> list[Path]:
        names = _files_of_record(paths["json"]) - {path.name for path in paths.values()}
        return [output.folder / name for name in sorted(names)]

    with write_together(list(paths.values()), outdated) as siblings:
        temporaries = dict(zip(paths, siblings, strict=True))
        with tempfile.TemporaryDirectory(dir=siblings[0].parent) as staging:
            maps = write_maps(
                staging,
                output.stem,
                refined.svbrdf,
                rendering=refined.render(),
                format=MAP_FORMATS[output.format],
                normal_convention=output.normals,
            )
            for name, path in maps.items():
                os.replace(path, temporaries[name])
        if output.uncertainty:
            for name, deviation in refined.deviations.items():
                key, pixels = _deviation(name), deviation[0].permute(1, 2, 0).cpu().float().numpy()
                write_image(
                    temporaries[key],
                    paths[key],
                    np.ascontiguousarray(pixels),
                    "data",
                    MAP_FORMATS[output.format],
                )
        temporaries["json"].write_text(to_json(record), encoding="utf-8", newline="\n")
        if output.report:
            write_sheet(temporaries["report"], refined, uncertainty=output.uncertainty)
        if output.thumbnail:
            write_thumbnail(temporaries["thumbnail"], refined)
    return paths


def _files_of_record(path: Path) -> set[str]:
    """Return the names of the files that an earlier run wrote, as far as they can only be its own."""
    try:
        record = parse_json(path.read_text(encoding="utf-8"))
        names = record["maps"]["files"].values() if record["format"] == FORMAT else ()
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return set()
    return {
        name
        for name in names
        if isinstance(name, str) and Path(name).name == name and name.startswith(f"{path.stem}_")
    }


def describe(
    refined: Refined,
    output: Output,
    *,
    settings: dict[str, Any],
    checkpoint: dict[str, Any],
    photo: Photo,
) -> dict[str, Any]:
    """Return everything that is known of a result as plain data, for the JSON beside its maps.

    Args:
        refined: the result.
        output: where and how it is written; only file names enter, so that a folder can be moved.
        settings: what was asked for, seed included.
        checkpoint: of `describe_checkpoint`.
        photo: as it was read, before it was resized.

    Returns:
        The record. It depends on the photo and the settings alone but for the key `SECONDS`.
    """
    before = rerendering_rmse(
        render_in_bands(refined.initial, refined.light, refined.camera), refined.capture
    )
    after = rerendering_rmse(refined.render(), refined.capture)
    height, width = refined.svbrdf.size
    return {
        "format": FORMAT,
        "photo": {
            "source": photo.source,
            "sha256": digest(Path(photo.source)) if photo.source != "array" else None,
            "width": photo.size[1],
            "height": photo.size[0],
            "saturated": 1.0 - float(photo.unsaturated.double().mean()),
            "notes": list(refined.notes),
        },
        **({"others": [_other(refined, capture) for capture in refined.others]} if refined.others else {}),
        "settings": {**settings, **refined.settings},
        "recipe": refined.recipe.as_dict(),
        "engine": refined.engine,
        "checkpoint": checkpoint,
        "auto_encoders": describe_auto_encoders(refined.recipe),
        "light": _light(refined.light),
        "camera": asdict(refined.camera),
        "maps": {
            "width": width,
            "height": height,
            "files": {name: path.name for name, path in output.paths().items()},
            "encodings": map_encodings(output),
        },
        **({"interrupted": True} if refined.interrupted else {}),
        "rmse": {
            "measure": "between re-rendering and photo, gamma-encoded (1/2.2), unsaturated pixels",
            "initialization": before,
            "refined": after,
        },
        "losses": {name: _loss(values) for name, values in refined.losses.items()},
        "versions": versions(),
        SECONDS: {name: round(value, 3) for name, value in refined.seconds.items()},
    }


def _light(light: PointLight) -> dict[str, Any]:
    position, intensity = (
        [float(value) for value in tensor[0]] for tensor in (light.position, light.intensity)
    )
    return {"position": position, "intensity": intensity, "falloff": light.falloff}


def _other(refined: Refined, capture: Capture) -> dict[str, Any]:
    """What is known of a further photo of the surface."""
    assert capture.light is not None
    before, after = (
        rerendering_rmse(render_in_bands(material, capture.light, capture.camera), capture)
        for material in (refined.initial, refined.svbrdf)
    )
    return {
        "source": capture.source,
        "sha256": digest(Path(capture.source)) if capture.source != "array" else None,
        "notes": list(capture.notes),
        "light": _light(capture.light),
        "rmse": {"initialization": before, "refined": after},
    }


def map_encodings(output: Output) -> dict[str, str]:
    """Say in words what every map's file holds."""
    format = MAP_FORMATS[output.format]
    color = "linear Rec. 709" if format.linear else "sRGB-encoded"
    green = {"opengl": "green up (OpenGL)", "directx": "green down (DirectX)"}[output.normals]
    storage = f"{format.bits}-bit {'float ' if format.linear else ''}{format.extension}"
    encodings = {
        "normal": f"(n + 1) / 2, raw, {green}; {storage}",
        "diffuse": f"albedo, {color}; {storage}",
        "specular": f"reflectance at normal incidence (F0), {color}; {storage}",
        "roughness": f"raw, GGX alpha is its square; {storage}",
        RENDERING: f"radiance, {color}{'' if format.linear else ', clipped at 1'}; {storage}",
    }
    if output.uncertainty:
        meaning = "standard deviation of the map's error, in linear units of the map"
        encodings |= {_deviation(name): f"{meaning}, raw; {storage}" for name in MAP_NAMES}
    return encodings


def _deviation(name: str) -> str:
    return f"{name}_deviation"


def describe_checkpoint(name: str | Path) -> dict[str, Any]:
    """Return a checkpoint's name, digest and what it says of itself (None for the authors' `.pth`).

    Raises:
        nets.checkpoint.CheckpointError: no such file, or not a checkpoint.
    """
    path = resolve(name)
    record = asdict(read_record(name)) if path.suffix == ".safetensors" else None
    return {"name": str(name), "sha256": digest(path), "record": record}


def describe_auto_encoders(recipe: Recipe) -> list[dict[str, Any]]:
    """Return the networks that a recipe needs besides the checkpoint, as above; most recipes need none."""
    return [describe_checkpoint(s.checkpoint) for s in recipe.stages if isinstance(s, LatentStage)]


def versions() -> dict[str, str]:
    """Return the versions that numbers may depend on."""
    return {
        "svbrdf-refine": __version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def to_json(record: dict[str, Any]) -> str:
    """Return strict JSON, indented, with every list of numbers on one line."""
    text = json.dumps(record, indent=2, allow_nan=False)
    return re.sub(r"\[\n\s+([-+\d.eE,\s]+?)\n\s+\]", _on_one_line, text) + "\n"


def _on_one_line(numbers: re.Match[str]) -> str:
    return "[" + re.sub(r",\s+", ", ", numbers.group(1)) + "]"


def _loss(values: list[float]) -> dict[str, Any]:
    if not all(math.isfinite(value) for value in values):
        raise ValueError("a loss is NaN or infinite")
    curve = [float(f"{value:.6g}") for value in values]
    return {
        "start": curve[0],
        "end": curve[-1],
        "lowest": min(curve),
        "iterations": len(curve) - 1,
        "curve": curve,
    }


def digest(path: Path) -> str:
    """Return the SHA-256 of a file's content, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
