"""`refine export FOLDER --to ...`: what `refine` wrote, for the next program."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from refine.errors import UserError
from refine.export.targets import TARGETS, export_material, parse_targets

FOLDER = "export"
"""Name of the folder exports go to, within that of the result."""

FORMATS = ("png", "png8", "exr", "exr32")
"""Names in `refine.result.MAP_FORMATS` that other programs read."""

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="rich")

_LIST = "; ".join(f"[bold]{name}[/bold]: {target.help}" for name, target in TARGETS.items()) + "."


@app.command(epilog=_LIST)
def export(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Of a result", show_default=False)],
    to: Annotated[str, typer.Option(metavar="NAME,NAME", help="What for: see below", show_default=False)],
    tile: Annotated[
        bool, typer.Option("--tile", help="Make the maps seamless first", show_default=False)
    ] = False,
    format: Annotated[
        str,
        typer.Option(metavar="NAME", help=f"({FORMATS[0]}), {', '.join(FORMATS[1:])}", show_default=False),
    ] = "png",
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="Which of several results", show_default=False)
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help=f"Folder (FOLDER/{FOLDER})", show_default=False)
    ] = None,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print nothing but errors", show_default=False)
    ] = False,
) -> None:
    """Write a material for other programs.

    FOLDER is what refine wrote. Defaults are in parentheses.
    Example: refine export wall_material --to gltf,blender
    """
    if Path(FOLDER).is_file() and not quiet:
        print(
            f"refine: taken as the command; for the photo of that name say refine ./{FOLDER}.",
            file=sys.stderr,
        )
    targets = parse_targets("--to", to)
    if format not in FORMATS:
        raise UserError(f"--format {format!r} is unknown; choose one of {', '.join(FORMATS)}.")
    export_folder(folder, targets, tile=tile, format=format, name=name, out=out, quiet=quiet)


def export_folder(
    folder: Path,
    targets: list[str],
    *,
    tile: bool = False,
    format: str = "png",
    name: str | None = None,
    out: Path | None = None,
    quiet: bool = False,
) -> list[Path]:
    """Export the result in a folder and say so; returns what was written.

    Raises:
        UserError: as `read_result` and `export_material`.
    """
    from refine.export.source import read_result
    from refine.result import MAP_FORMATS

    result = read_result(folder, name)
    record, paths = export_material(
        result.svbrdf,
        folder / FOLDER if out is None else out,
        result.stem,
        targets,
        format=MAP_FORMATS[format],
        tile=tile,
        keep=result.files,
        origin={"name": result.stem, "photo": result.photo},
    )
    if not quiet:
        _summarise(record, paths)
    return paths


def _summarise(record: dict[str, Any], paths: list[Path]) -> None:
    for name, target in record["targets"].items():
        lost = target.get("loss", {})
        told = "".join(
            f", {what} off by {value:.4f}" for what, value in lost.items() if f"{value:.4f}" != "0.0000"
        )
        print(f"{name}: {len(target['files'])} files{told}", file=sys.stderr)
    print(f"wrote {len(paths)} files to {paths[0].parent}", file=sys.stderr)
