"""What can be exported to, and how one material becomes the files of several targets, all or none."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from refine.errors import UserError

if TYPE_CHECKING:
    from nets.svbrdf import SVBRDF
    from refine.export.bundle import Bundle, Source
    from refine.maps import MapFormat

FORMAT = "svbrdf-refine export 1"

UNREADABLE = re.compile(r"\\|:SDF_FORMAT_ARGS:")
"""What MaterialX and USD take for something else than a part of a file's name."""


@dataclass(frozen=True)
class Target:
    """One thing to export to.

    Attributes:
        function: `module:function` of `refine.export`, from a source to a bundle; imported when asked for.
        help: what it writes, in a few words.
        package: the module it needs beyond those of the library.
    """

    function: str
    help: str
    package: str | None = None

    def bundle(self, source: Source) -> Bundle:
        """Return the target's files."""
        module, _, name = self.function.partition(":")
        function: Callable[[Source], Bundle] = getattr(import_module(f"refine.export.{module}"), name)
        return function(source)


TARGETS: dict[str, Target] = {
    "materialx": Target("materialx:materialx", "standard_surface and OpenPBR", "MaterialX"),
    "gltf": Target("gltf:glb", "one GLB, a textured plane", "pygltflib"),
    "usd": Target("usd:usd", "UsdPreviewSurface on a plane", "pxr"),
    "blender": Target("blender:blender", "a script that builds the node tree"),
    "orm": Target("packed:orm", "metallic workflow, packed for Unreal and others"),
    "unity": Target("packed:unity", "metallic workflow, packed for Unity's HDRP"),
    "height": Target("packed:height", "a height map, from the normals"),
    "tile": Target("packed:tile", "the four maps, seamless"),
}
"""Targets by the name they are asked for."""


def parse_targets(option: str, text: str) -> list[str]:
    """Read names of targets, separated by commas, and find out whether they can be had.

    Raises:
        UserError: a name is unknown, or a package is not installed.
    """
    names = list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if not names or (unknown := [name for name in names if name not in TARGETS]):
        wrong = unknown[0] if names else text
        raise UserError(f"{option} {wrong!r} is unknown; choose of {', '.join(TARGETS)}.")
    for name in names:
        package = TARGETS[name].package
        if package is not None and find_spec(package) is None:
            raise UserError(
                f"{option} {name} needs the package {package}, which is not installed; "
                "run pip install 'svbrdf-refine[export]'."
            )
    return names


def export_material(
    svbrdf: SVBRDF,
    folder: Path | str,
    stem: str,
    targets: Sequence[str],
    *,
    format: MapFormat | None = None,
    tile: bool = False,
    keep: Iterable[Path] = (),
    origin: dict[str, Any] | None = None,
) -> tuple[dict[str, Any], list[Path]]:
    """Write a material for other programs: all files of all targets, and a record of them, or nothing.

    Args:
        svbrdf: one material (a batch of one).
        folder: created if missing; files of the same names are replaced.
        stem: beginning of every file name, but that `UNREADABLE` parts are replaced in all but the record's.
        targets: names in `TARGETS`.
        format: of pictures that are files of their own; 16-bit PNG unless said otherwise.
        tile: whether the material is made seamless first.
        keep: files that must not be replaced.
        origin: what the record says of where the material is from.

    Returns:
        The record, and the path of every file.

    Raises:
        UserError: a target is unknown or its package missing, a file cannot be written or must be kept, the
            maps are too small to tile.
    """
    from refine import __version__
    from refine.export.bundle import Source, merge, write_files
    from refine.export.tile import make_seamless
    from refine.maps import MapFormat
    from refine.result import to_json

    names = parse_targets("target", ",".join(targets))
    format = format or MapFormat()
    shown = UNREADABLE.sub("_", stem)
    source = Source(make_seamless(svbrdf) if tile else svbrdf, shown, format, repeats=tile)
    bundles = {name: TARGETS[name].bundle(source) for name in names}
    height, width = source.svbrdf.size
    record = {
        "format": FORMAT,
        "of": origin or {},
        "width": width,
        "height": height,
        "seamless": tile,
        "normals": "green up (OpenGL) but for files named directx",
        "targets": {name: {"files": list(bundle.files), **bundle.notes} for name, bundle in bundles.items()},
        "version": __version__,
    }
    contents = {**merge(bundles.values()), f"{stem}_export.json": to_json(record)}
    kept = [path.resolve() for path in keep]
    for name in contents:
        if (Path(folder) / name).resolve() in kept:
            raise UserError(
                f"Writing {Path(folder) / name} would replace the result; give another folder with --out."
            )
    return record, write_files(Path(folder), contents, format)
