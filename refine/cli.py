"""`refine PHOTO`: the command line, a rim around `Refiner`. It parses, shows progress and reports.

Heavy imports happen inside the command, after the arguments have been checked, so that help and typing
mistakes answer at once. Every mistake a user can make ends in one sentence on standard error and exit code 2.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from refine import __version__
from refine.arguments import (
    choose,
    parse_camera,
    parse_point,
    require_batch_sense,
    require_device,
    require_sense,
)
from refine.batch.plan import find_photos
from refine.console import progress_bar, summarise
from refine.errors import StoppedError, UserError
from refine.export.targets import parse_targets
from refine.limits import GIB, WORTH_SAYING
from refine.request import ESTIMATED, Request, enough_memory

USER_ERROR, INTERRUPTED = 2, 130

SUBCOMMANDS: dict[str, str] = {
    "completion": "refine.completion:app",
    "export": "refine.export.cli:app",
    "view": "refine.viewer.cli:app",
    "video": "refine.video.cli:app",
}
"""Commands besides the default one, as `name: "module:typer_app"`; imported only when asked for."""

QUICK_ITERATIONS = 50

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
    photos: Annotated[
        list[Path],
        typer.Argument(metavar="PHOTO", hidden=True, show_default=False),  # said in the text: a panel less
    ],
    light: Annotated[str, _surface("X,Y,Z", "Position of the flash (estimated)")] = ESTIMATED,
    falloff: Annotated[str | None, _surface("NAME", "(none), inverse_square, auto")] = None,
    camera: Annotated[str | None, _surface("NAME", "(perspective), orthographic, collocated, X,Y,Z")] = None,
    color_space: Annotated[str, _surface("NAME", "(auto) srgb linear gamma22 display-p3 adobe-rgb")] = "auto",
    resolution: Annotated[int, _surface("PIXELS", "Longer side (256); 0 keeps the photo's")] = 256,
    one_surface: Annotated[
        bool, _switch("--one-surface", help="The photos show one, in register", panel="The photo")
    ] = False,
    align: Annotated[
        bool, _switch("--align", help="Bring them into register first", panel="The photo")
    ] = False,
    lights: Annotated[Path | None, _surface("PATH", "Positions of their flashes (estimated)")] = None,
    init: Annotated[str, _refinement("NAME|FILE", "Network to start from (default)")] = "default",
    recipe: Annotated[str, _refinement("NAME", "Stages (default), fast, paper, gao, gao+")] = "default",
    iters: Annotated[int | None, _refinement("N", "Steps of all stages (the recipe's); 0 for none")] = None,
    quick: Annotated[
        bool,
        _switch("--quick", help=f"--iters {QUICK_ITERATIONS} --no-report", panel="Refinement"),
    ] = False,
    engine: Annotated[str, _refinement("NAME", "(auto), fused, compiled, reference; dask")] = "auto",
    seed: Annotated[int, _refinement("N", "Same seed, same bytes (0)")] = 0,
    out: Annotated[Path | None, _output("DIR", "Folder (./<photo>_material)")] = None,
    format: Annotated[str, _output("NAME", "(png), png8, tif, tif8, tif32, exr, exr32")] = "png",
    normals: Annotated[str, _output("NAME", "(opengl): green is up, directx: down")] = "opengl",
    uncertainty: Annotated[
        bool, _switch("--uncertainty", help="Say how well each pixel is known, too", panel="Output")
    ] = False,
    no_report: Annotated[bool, _switch("--no-report", help="No <photo>_report.png", panel="Output")] = False,
    export: Annotated[str | None, _output("NAME,NAME", "For other programs: see refine export")] = None,
    as_json: Annotated[bool, _switch("--json", help="Print the JSON record, too", panel="Output")] = False,
    quiet: Annotated[bool, _switch("--quiet", "-q", help="Print nothing but errors")] = False,
    device: Annotated[str, _option("NAME", "(cpu), cuda, cuda:1, mps", None)] = "cpu",
    threads: Annotated[int | None, _option("N", "CPU threads (one per core; 1 in batches)", None)] = None,
    max_memory: Annotated[
        float | None, _option("GIB", "Refuse what takes more memory (what is free)", None)
    ] = None,
    workers: Annotated[int | None, _option("N", "Of a batch: processes (one per core)", None)] = None,
    scheduler: Annotated[str | None, _option("ADDRESS", "Of a batch with --engine dask", None)] = None,
    version: Annotated[
        bool, _switch("--version", help="Print the version", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Turn flash photos of a flat surface into a relightable material.

    Every PHOTO (JPEG, PNG, TIFF, EXR; or those of a folder) becomes maps, JSON
    and a report. Defaults in (); --one-surface is collocated, inverse_square.
    Example: refine wall.jpg --export gltf, or refine photos/ --out materials
    Commands: refine export, view, video, completion; each has --help.
    """
    given, folders = photos, any(photo.is_dir() for photo in photos)
    batch = not one_surface and (folders or len(photos) > 1)
    require_batch_sense(given, batch=batch, out=out, engine=engine, scheduler=scheduler, workers=workers)
    if folders or batch:
        photos = find_photos(photos)
    require_sense(photos, one_surface=one_surface, light=light, align=align, lights=lights)
    camera = camera or ("collocated" if one_surface else "perspective")
    falloff = falloff or ("inverse_square" if one_surface else "none")
    if light != ESTIMATED:
        parse_point("--light", light, "or leave it out to have it estimated")
    parse_camera(camera)
    choose("--falloff", falloff, ("none", "inverse_square", "auto"))
    if falloff == "auto" and (light != ESTIMATED or lights is not None):
        raise UserError("--falloff auto needs a light to fit; leave out --light(s) or name the falloff.")
    choose("--normals", normals, ("opengl", "directx"))
    numbers = (("iters", iters, 0), ("resolution", resolution, 0), ("threads", threads, 1))
    for name, number, lowest in (*numbers, ("workers", workers, 1)):
        if number is not None and not lowest <= number < 2**31:
            raise UserError(f"--{name} {number} is out of range; give {lowest} or more.")
    if max_memory is not None and not max_memory > 0.0:
        raise UserError(f"--max-memory {max_memory} is out of range; give GiB above 0.")
    if not 0 <= seed < 2**63:
        raise UserError(f"--seed {seed} is out of range; give a number from 0 to 2^63 - 1.")
    if quick:
        iters = QUICK_ITERATIONS if iters is None else iters
        no_report = True
    if engine == "dask":
        engine = "auto"
    targets = parse_targets("--export", export) if export is not None else []

    import torch

    from refine.engine import ENGINES, obstacle
    from refine.export.cli import export_folder
    from refine.photo import ColorSpaceChoice
    from refine.refiner import Interrupted
    from refine.result import MAP_FORMATS, describe, describe_checkpoint, write_result
    from refine.stages import RECIPES

    choose("--color-space", color_space, get_args(ColorSpaceChoice))
    choose("--recipe", recipe, tuple(RECIPES))
    choose("--format", format, tuple(MAP_FORMATS))
    choose("--engine", engine, ("auto", *ENGINES))
    require_device(device)
    if engine != "auto" and (reason := obstacle(engine, torch.device(device).type)) is not None:
        raise UserError(f"--engine {engine} cannot be used: {reason}; leave --engine or --device out.")
    if threads is not None:
        torch.set_num_threads(threads)
    request = Request(
        init=init,
        recipe=recipe,
        iters=iters,
        engine=engine,
        resolution=resolution,
        light=light,
        one_surface=one_surface,
        align=align,
        lights=lights,
        falloff=falloff,
        camera=camera,
        color_space=color_space,
        normals=normals,
        format=format,
        device=device,
        seed=seed,
        threads=(threads or 1) if batch else torch.get_num_threads(),
        report=not no_report,
        uncertainty=uncertainty,
        thumbnail=batch,
        export=tuple(targets),
        max_memory=max_memory,
    )
    if batch:
        from refine.batch.run import refine_batch

        folder = out if out is not None else Path(f"{given[0].resolve().name}_materials")
        refine_batch(
            request, photos, folder, workers=workers, scheduler=scheduler, quiet=quiet, as_json=as_json
        )
        return
    reads = [request.read(path) for path in photos]
    output = request.output(out or Path(f"{photos[0].stem}_material"), photos[0].stem)
    for path in photos:
        output.require_writable(path)
    checkpoint = describe_checkpoint(init)
    refiner = request.refiner()
    flash = request.flash(photos)
    needed = request.require_memory(refiner, reads)
    if not quiet and needed >= WORTH_SAYING:
        print(f"refine: this takes about {needed / GIB:.1f} GiB of memory.", file=sys.stderr)
    with progress_bar(shown=not quiet and sys.stderr.isatty()) as progress, enough_memory(), _log(quiet):
        try:
            refined = request.fit(refiner, reads, flash, progress)
        except Interrupted as stop:
            refined = stop.refined
        record = describe(refined, output, settings=request.settings(), checkpoint=checkpoint, photo=reads[0])
        paths = write_result(refined, output, record)
    if as_json:
        json.dump({**record, "folder": str(output.folder)}, sys.stdout, indent=2)
        print()
    if not quiet:
        summarise(record, paths, estimated=flash is None)
    if refined.interrupted:
        raise StoppedError(f"interrupted; the best until then is in {output.folder}.")
    if targets:
        export_folder(output.folder, targets, name=output.stem, quiet=quiet)


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
        return int(getattr(error, "code", USER_ERROR))
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
