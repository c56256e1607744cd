"""`refine video FOLDER`: the material under a light that moves, as a file that plays in a loop."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import typer

from refine.arguments import choose
from refine.errors import UserError
from refine.video.paths import PATHS, light_positions

MOST_FRAMES = 10_000
"""Of one video; more is taken for a mistake."""

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="rich")


def _option(metavar: str, help: str) -> Any:
    return typer.Option(metavar=metavar, help=help, show_default=False)


@app.command(
    epilog="[bold]refine video slate --to slate.gif --path sweep --size 256[/bold] "
    "sweeps the light from left to right and back."
)
def video(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Of a result", show_default=False)],
    to: Annotated[
        Path | None, _option("FILE", "Ends in .mp4, .gif or .webp (FOLDER/<photo>_relit.mp4)")
    ] = None,
    path: Annotated[str, _option("NAME", "Of the light: (circle), sweep, figure-eight")] = "circle",
    seconds: Annotated[float, _option("N", "For one round (6)")] = 6.0,
    fps: Annotated[int, _option("N", "Frames per second (25)")] = 25,
    size: Annotated[int, _option("PIXELS", "Longer side, at most the maps' (512); 0 keeps theirs")] = 512,
    radius: Annotated[
        float, _option("N", "How far the light gets from the middle (1); the longer side is 2")
    ] = 1.0,
    height: Annotated[float, _option("N", "How high it is above the surface (1)")] = 1.0,
    falloff: Annotated[str | None, _option("NAME", "none, inverse_square (the result's)")] = None,
    exposure: Annotated[float, _option("STOPS", "1 is twice as bright (0)")] = 0.0,
    name: Annotated[str | None, _option("NAME", "Which of several results")] = None,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print nothing but errors", show_default=False)
    ] = False,
) -> None:
    """Film a material under a light that moves.

    FOLDER is what refine wrote. Defaults are in parentheses. The light ends
    where it began, so the video can be played in a loop.
    """
    choose("--path", path, tuple(PATHS))
    if falloff is not None:
        choose("--falloff", falloff, ("none", "inverse_square"))
    for option, number, low, high in (
        ("seconds", seconds, 0.01, 600.0),
        ("fps", fps, 1, 120),
        ("size", size, 0, 2**15),
        ("radius", radius, 0.0, 1e3),
        ("height", height, 0.01, 1e3),
        ("exposure", exposure, -20.0, 20.0),
    ):
        if not (math.isfinite(number) and low <= number <= high):
            raise UserError(f"--{option} {number} is out of range; give {low:g} to {high:g}.")
    count = max(1, round(seconds * fps))
    if count > MOST_FRAMES:
        raise UserError(f"These are {count} frames, more than {MOST_FRAMES}; give fewer --seconds or --fps.")

    from rich.console import Console
    from rich.progress import track

    from refine.video.encoding import find_writer, write_video
    from refine.video.frames import read_scene, relit_frames

    if to is not None:
        find_writer(to)
    stem, scene = read_scene(folder, name, size, cast(Literal["none", "inverse_square"] | None, falloff))
    to = to or folder / f"{stem}_relit.mp4"
    frames = track(
        relit_frames(scene, light_positions(path, count, radius, height), exposure),
        description="",
        total=count,
        console=Console(stderr=True),
        transient=True,
        disable=quiet or not sys.stderr.isatty(),
    )
    write_video(to, frames, count, fps)
    if not quiet:
        print(f"wrote {to}: {count} frames, {to.stat().st_size / 1e6:.1f} MB", file=sys.stderr)
