"""`refine-eval figures`: the figures of the paper's evaluation. Options and files; no numerics."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer

from eval.console import INCOMPLETE, mistakes, progress, tell
from eval.datasets import SIZE
from eval.datasets import Protocol as Settings
from eval.figures.answers import Answers
from eval.figures.catalogue import COMPARED, FIGURES, QUICK, Counts, Studio, as_json, obstacle, page
from eval.figures.sheet import require_format, write
from eval.held_out import NAME as BUILT_IN
from eval.methods import choose, find_weights, note_of_quick, parse_inits
from eval.options import Flips, Inits, MatchExposure, ProtocolSeed, SceneLightsFile, Size, Threads
from eval.real_scenes import read_scene_lights
from eval.report import origin, provenance
from eval.yardsticks import Real, Synthetic
from refine.files import write_text_atomically


def figures(
    test_set: Annotated[
        str, typer.Option("--set", help=f"{BUILT_IN}, a folder of strips, or one of PBR folders.")
    ] = BUILT_IN,
    real_set: Annotated[
        Path | None, typer.Option(help="Holds a folder of photos per surface; for Fig. 8 and 9.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the figures.")] = Path("figures"),
    only: Annotated[
        str | None, typer.Option(help=f"Some of {', '.join(map(str, FIGURES))}, comma-separated.")
    ] = None,
    rows: Annotated[str | None, typer.Option(help="Rows of Fig. 4, 5 and 8, comma-separated.")] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer scenes in Fig. 12 and 13; fewer steps.")
    ] = False,
    format: Annotated[str, typer.Option(help="png, jpg, pdf, svg.")] = "png",
    init: Inits = None,
    size: Size = SIZE,
    seed: ProtocolSeed = 0,
    lights: SceneLightsFile = None,
    match_exposure: MatchExposure = False,
    flips: Flips = True,
    threads: Threads = 0,
) -> None:
    """The paper's figures 4 to 13: comparisons, ablations, lights, failures.

    Example: refine-eval figures --quick --only 12,13
    """
    if threads:
        torch.set_num_threads(threads)
    with mistakes():
        chosen = _numbers(only)
        require_format(format)
        compared = list(dict.fromkeys(rows.split(","))) if rows else list(COMPARED)
        choose(compared)
        found, gaps = find_weights(choose(None), parse_inits(init or []), quick=quick)
        synthetic = Synthetic(Synthetic.named(test_set), Settings(size=size, seed=seed), flips=flips)
        synthetic.scenes()
        real = None
        if real_set is not None:
            known = {} if lights is None else read_scene_lights(lights)
            real = Real(real_set, size, seed, match_exposure, known, flips)
            real.scenes()

    about = provenance()
    studio = Studio(
        Answers(synthetic, found),
        None if real is None else Answers(real, found),
        compared,
        QUICK if quick else Counts(),
    )
    studio.skipped |= {name: reason for name, reason in gaps.items() if name in compared}
    caption = (
        f"The paper's figures on {synthetic.name}{'' if real is None else f' and {real.name}'}. "
        f"{synthetic.caption()} {'' if real is None else real.caption() + ' '}"
        f"{note_of_quick(found)}"
        f"Our networks are narrow ones that were trained for hours on two CPU cores; {origin(about)}."
    )
    made = []
    with mistakes(), progress(sum(len(FIGURES[number].parts) for number in chosen)) as advance:
        for number in chosen:
            figure = FIGURES[number]
            reason = obstacle(figure, studio)
            if reason is not None:
                studio.skipped[f"Figure {number}"] = reason
                continue
            files = []
            for name, make in figure.parts.items():
                path = out / f"fig{number:02}_{name}.{format}"
                write(make(studio), path)
                files.append(path)
                advance(f"Figure {number}")
            made.append((figure, files))
        write_text_atomically(out / "figures.md", page(made, caption, studio.skipped))
        write_text_atomically(out / "figures.json", as_json(studio, caption))
    for name, reason in studio.skipped.items():
        tell(f"skipped {name}: {reason}")
    if studio.skipped:
        raise typer.Exit(INCOMPLETE)


def _numbers(only: str | None) -> list[int]:
    if only is None:
        return list(FIGURES)
    unknown = [text for text in only.split(",") if text.strip() not in map(str, FIGURES)]
    if unknown:
        raise ValueError(f"there is no figure {unknown[0]}; there are {', '.join(map(str, FIGURES))}")
    return [int(text) for text in only.split(",")]
