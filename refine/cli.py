"""`refine PHOTO`: the command line, a rim around `Refiner`. It parses, shows progress and reports.

Heavy imports happen inside the command, after the arguments have been checked, so that help and typing
mistakes answer at once. Every mistake a user can make ends in one sentence on standard error and exit code 2.
"""

from __future__ import annotations

import json
import logging
import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast, get_args

import typer

from refine import __version__
from refine.console import progress_bar, summarise
from refine.errors import UserError
from refine.export.targets import parse_targets

if TYPE_CHECKING:
    from nets.render import PointLight

USER_ERROR, INTERRUPTED = 2, 130

SUBCOMMANDS: dict[str, str] = {"export": "refine.export.cli:app"}
"""Commands besides the default one, as `name: "module:typer_app"`; imported only when asked for."""

QUICK_ITERATIONS = 50

LARGEST_COORDINATE = 1e6
"""Positions farther away than this, in surface units, are taken for mistakes."""

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="rich")


def _option(metavar: str, help: str, panel: str | None, **more: Any) -> Any:
    return typer.Option(metavar=metavar, help=help, rich_help_panel=panel, show_default=False, **more)


def _switch(*names: str, help: str, panel: str | None = None, **more: Any) -> Any:
    return typer.Option(*names, help=help, rich_help_panel=panel, show_default=False, **more)


def _surface(metavar: str, help: str, **more: Any) -> Any:
    return _option(metavar, help, "The photo", **more)


def _refinement(metavar: str, help: str, **more: Any) -> Any:
    return _option(metavar, help, "Refinement", **more)


def _output(metavar: str, help: str, **more: Any) -> Any:
    return _option(metavar, help, "Output", **more)


def _version(asked: bool) -> bool:
    if asked:
        print(f"refine {__version__}")
        raise typer.Exit
    return asked


@app.command()
def fit(
    photo: Annotated[Path, typer.Argument(metavar="PHOTO", help="JPEG, PNG, TIFF, EXR", show_default=False)],
    light: Annotated[str, _surface("X,Y,Z", "Position of the flash (estimated)")] = "estimated",
    falloff: Annotated[str, _surface("NAME", "(none), inverse_square, auto")] = "none",
    camera: Annotated[
        str, _surface("NAME", "(perspective), orthographic, collocated, X,Y,Z")
    ] = "perspective",
    color_space: Annotated[
        str, _surface("NAME", "(auto), srgb, linear, gamma22, display-p3, adobe-rgb")
    ] = "auto",
    resolution: Annotated[int, _surface("PIXELS", "Longer side (256); 0 keeps the photo's")] = 256,
    init: Annotated[str, _refinement("NAME|FILE", "Network to start from (default)")] = "default",
    recipe: Annotated[str, _refinement("NAME", "Stages of refinement (default), fast, paper")] = "default",
    iters: Annotated[int | None, _refinement("N", "Steps of all stages (the recipe's); 0 for none")] = None,
    quick: Annotated[
        bool,
        _switch("--quick", help=f"--iters {QUICK_ITERATIONS} --no-report", panel="Refinement"),
    ] = False,
    engine: Annotated[str, _refinement("NAME", "(auto), fused, compiled, reference")] = "auto",
    seed: Annotated[int, _refinement("N", "Same seed, same bytes (0)")] = 0,
    out: Annotated[Path | None, _output("DIR", "Folder (./<photo>_material)")] = None,
    format: Annotated[str, _output("NAME", "(png), png8, tif, tif8, tif32, exr, exr32")] = "png",
    normals: Annotated[str, _output("NAME", "(opengl): green is up, directx: down")] = "opengl",
    no_report: Annotated[bool, _switch("--no-report", help="No <photo>_report.png", panel="Output")] = False,
    export: Annotated[
        str | None, _output("NAME,NAME", "For other programs, too: see refine export --help")
    ] = None,
    as_json: Annotated[bool, _switch("--json", help="Print the JSON record, too", panel="Output")] = False,
    quiet: Annotated[bool, _switch("--quiet", "-q", help="Print nothing but errors")] = False,
    device: Annotated[str, _option("NAME", "(cpu), cuda, cuda:1, mps", None)] = "cpu",
    threads: Annotated[int | None, _option("N", "CPU threads (one per core)", None)] = None,
    version: Annotated[
        bool, _switch("--version", help="Print the version", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Turn one flash photo of a flat surface into a relightable material.

    Writes <photo>_normal.png, _diffuse, _specular, _roughness and _rendering,
    <photo>.json and <photo>_report.png. Defaults are in parentheses.
    """
    position = (
        None
        if light == "estimated"
        else parse_point("--light", light, "or leave it out to have it estimated")
    )
    kind, viewpoint = parse_camera(camera)
    _choose("--falloff", falloff, ("none", "inverse_square", "auto"))
    if falloff == "auto" and position is not None:
        raise UserError("--falloff auto needs a light to fit; leave out --light or name the falloff.")
    _choose("--normals", normals, ("opengl", "directx"))
    for name, number, lowest in (("iters", iters, 0), ("resolution", resolution, 0), ("threads", threads, 1)):
        if number is not None and not lowest <= number < 2**31:
            raise UserError(f"--{name} {number} is out of range; give {lowest} or more.")
    if not 0 <= seed < 2**63:
        raise UserError(f"--seed {seed} is out of range; give a number from 0 to 2^63 - 1.")
    if quick:
        iters = QUICK_ITERATIONS if iters is None else iters
        no_report = True
    targets = parse_targets("--export", export) if export is not None else []

    import torch

    from nets.render import Camera, PointLight
    from refine.engine import ENGINES, obstacle
    from refine.export.cli import export_folder
    from refine.light import FalloffChoice
    from refine.photo import ColorSpaceChoice, read_photo
    from refine.refiner import Refiner
    from refine.result import MAP_FORMATS, Output, describe, describe_checkpoint, write_result
    from refine.stages import RECIPES

    _choose("--color-space", color_space, get_args(ColorSpaceChoice))
    _choose("--recipe", recipe, tuple(RECIPES))
    _choose("--format", format, tuple(MAP_FORMATS))
    _choose("--engine", engine, ("auto", *ENGINES))
    _require_device(device)
    if engine != "auto" and (reason := obstacle(engine, torch.device(device).type)) is not None:
        raise UserError(f"--engine {engine} cannot be used: {reason}; leave --engine or --device out.")
    if threads is not None:
        torch.set_num_threads(threads)
    read = read_photo(photo, color_space=cast(ColorSpaceChoice, color_space))
    output = Output(
        out if out is not None else Path(f"{photo.stem}_material"),
        photo.stem,
        format,
        cast(Literal["opengl", "directx"], normals),
        report=not no_report,
    )
    output.require_writable(photo)
    checkpoint = describe_checkpoint(init)
    seen_from = Camera(kind) if viewpoint is None else Camera(kind, viewpoint)
    refiner = Refiner(
        init,
        recipe,
        camera=seen_from,
        resolution=resolution or None,
        seed=seed,
        device=device,
        engine=None if engine == "auto" else engine,
    )
    flash: PointLight | None = None
    if position is not None:
        flash = PointLight.at(position, falloff=cast(Literal["none", "inverse_square"], falloff)).to(device)

    settings = {
        "init": init,
        "recipe": recipe,
        "iters": iters,
        "engine": engine,
        "resolution": resolution,
        "light": light,
        "falloff": falloff,
        "camera": camera,
        "color_space": color_space,
        "normals": normals,
        "format": format,
        "device": device,
        "seed": seed,
        "threads": torch.get_num_threads(),
    }
    with progress_bar(shown=not quiet and sys.stderr.isatty()) as progress, _enough_memory(), _log(quiet):
        refined = refiner.fit(
            read,
            light=flash,
            falloff=None if flash else cast(FalloffChoice, falloff),
            iters=iters,
            progress=progress,
        )
        record = describe(refined, output, settings=settings, checkpoint=checkpoint, photo=read)
        paths = write_result(refined, output, record)
    if as_json:
        json.dump({**record, "folder": str(output.folder)}, sys.stdout, indent=2)
        print()
    if not quiet:
        summarise(record, paths, estimated=position is None)
    if targets:
        export_folder(output.folder, targets, name=output.stem, quiet=quiet)


def parse_point(option: str, text: str, otherwise: str) -> tuple[float, float, float]:
    """Read `X,Y,Z` in surface units, above the surface.

    Raises:
        UserError: text of another form, or a point that is not in front of the surface.
    """
    try:
        x, y, z = (float(number) for number in text.split(","))
    except ValueError:
        raise UserError(
            f"{option} {text!r} is not a position; give X,Y,Z such as 0.1,-0.2,2.1, {otherwise}."
        ) from None
    if not all(math.isfinite(value) and abs(value) <= LARGEST_COORDINATE for value in (x, y, z)) or z < 1e-3:
        raise UserError(
            f"{option} {text!r} is not in front of the surface; "
            "give X,Y,Z with Z above 0 (the photo's longer side spans -1 to 1)."
        )
    return x, y, z


CameraKind = Literal["orthographic", "perspective", "collocated"]


def parse_camera(text: str) -> tuple[CameraKind, tuple[float, float, float] | None]:
    """Read a camera's kind, or the position of a perspective one.

    Raises:
        UserError: neither.
    """
    if text in get_args(CameraKind):
        return cast(CameraKind, text), None
    return "perspective", parse_point("--camera", text, "or orthographic, perspective or collocated")


def _choose(option: str, value: str, known: Sequence[str]) -> None:
    if value not in known:
        raise UserError(f"{option} {value!r} is unknown; choose one of {', '.join(known)}.")


def _require_device(name: str) -> None:
    import torch

    try:
        if torch.device(name).type not in ("cpu", "cuda", "mps", "xpu"):
            raise RuntimeError
        torch.zeros(1, device=name).item()
    except (RuntimeError, AssertionError, NotImplementedError, ImportError):
        raise UserError(f"--device {name!r} is not there on this machine; use --device cpu.") from None


@contextmanager
def _log(quiet: bool) -> Iterator[None]:
    # Engines announce in the log what takes long.
    log = logging.getLogger("refine")
    level = log.level
    log.setLevel(logging.ERROR if quiet else level)
    try:
        yield
    finally:
        log.setLevel(level)


@contextmanager
def _enough_memory() -> Iterator[None]:
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        text = str(error).lower()
        if isinstance(error, MemoryError) or "out of memory" in text or "can't allocate memory" in text:
            raise UserError(
                "There is not enough memory for this size; ask for a lower --resolution."
            ) from None
        raise


def run(arguments: Sequence[str]) -> int:
    """Run the command line and return its exit code; the sentence about an error goes to standard error."""
    arguments = list(arguments)
    command, name = app, "refine"
    if arguments and arguments[0] in SUBCOMMANDS:
        module, _, attribute = SUBCOMMANDS[arguments[0]].partition(":")
        command, name = getattr(import_module(module), attribute), f"refine {arguments.pop(0)}"
    try:
        code = command(arguments, prog_name=name, standalone_mode=False) or 0
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except Exception as error:
        if (sentence := _sentence(error, name)) is None:
            raise
        print(f"refine: {sentence}", file=sys.stderr)
        return USER_ERROR
    if code == INTERRUPTED:
        print("refine: interrupted; nothing was written.", file=sys.stderr)
    return int(code)


def _sentence(error: Exception, command: str) -> str | None:
    """The message of an error that is the user's to mend, on one line; None for a defect of this library."""
    if isinstance(error, UserError):
        return " ".join(str(error).split())
    if hasattr(error, "format_message"):  # typer's own, whichever click it is built on
        message = " ".join(error.format_message().split())
        return (
            f"{message.rstrip('.')}; see {command} --help."
            if message
            else "No photo is given; see refine --help."
        )
    checkpoints = sys.modules.get("nets.checkpoint")
    if checkpoints is not None and isinstance(error, checkpoints.CheckpointError):
        return " ".join(str(error).split()) + "."
    return None


def main() -> None:
    """Run the console script."""
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
