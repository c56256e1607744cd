"""Real photos without ground truth: does refinement explain each one, with legal maps?

For every photo: RMSE of the re-rendering before and after (gamma-encoded, unsaturated pixels), and whether
the maps are legal. No ground truth is needed, so this says nothing of how right the maps are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from nets.render import render
from refine.errors import UserError
from refine.fidelity import rerendering_rmse
from refine.refiner import Refiner

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr"})

HALF = 0.5
"""A refinement passes if it leaves at most this share of the initialization's error."""


@dataclass(frozen=True)
class PhotoScore:
    """How one photo went.

    Attributes:
        name: folder and file.
        initialization: RMSE of the network's material re-rendered under the light used.
        refined: RMSE of the refined one.
        legal: no NaN, normals unit length, all maps in range.
        light: position used.
        seconds: of the whole fit.
    """

    name: str
    initialization: float
    refined: float
    legal: bool
    light: tuple[float, float, float]
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether the maps are legal and the error was halved at least."""
        return self.legal and self.refined <= HALF * self.initialization


def find_photos(folders: Sequence[Path]) -> list[Path]:
    """Return all photos below the folders, sorted; a file stands for itself."""
    found = [file for folder in folders for file in (folder.rglob("*") if folder.is_dir() else [folder])]
    return sorted(file for file in found if file.suffix.lower() in SUFFIXES)


def score_photos(
    refiner: Refiner,
    photos: Sequence[Path],
    iters: int | None = None,
    skip: Callable[[Path, str], None] | None = None,
) -> Iterator[PhotoScore]:
    """Refine photos one by one; one that cannot be read is reported to `skip` and left out."""
    for path in photos:
        try:
            refined = refiner.fit(path, iters=iters)
        except UserError as error:
            if skip is not None:
                skip(path, str(error))
            continue
        with torch.no_grad():
            before = rerendering_rmse(render(refined.initial, refined.light, refined.camera), refined.capture)
        after = rerendering_rmse(refined.render(), refined.capture)
        try:
            refined.svbrdf.validate()
            legal = True
        except ValueError:
            legal = False
        x, y, z = (float(value) for value in refined.light.position[0])
        yield PhotoScore(
            f"{path.parent.name}/{path.name}",
            before or 0.0,
            after or 0.0,
            legal,
            (x, y, z),
            sum(refined.seconds.values()),
        )


def photos_markdown(scores: Sequence[PhotoScore]) -> str:
    """Return the summary and one line for every photo, worst first."""
    passed = sum(score.passed for score in scores)
    mean = [
        sum(getattr(s, key) for s in scores) / len(scores) for key in ("initialization", "refined", "seconds")
    ]
    lines = [
        f"{passed} of {len(scores)} photos pass (legal maps, error at most half of the initialization's); "
        f"mean RMSE {mean[0]:.4f} -> {mean[1]:.4f}, {mean[2]:.1f} s a photo.",
        "",
        "| photo | initialization | refined | ratio | legal | light |",
        "|---|---:|---:|---:|---|---|",
    ]
    for score in sorted(scores, key=lambda s: -s.refined / max(s.initialization, 1e-9)):
        light = ", ".join(f"{value:.2f}" for value in score.light)
        ratio = score.refined / max(score.initialization, 1e-9)
        lines.append(
            f"| {score.name} | {score.initialization:.4f} | {score.refined:.4f} | {ratio:.2f} "
            f"| {'yes' if score.legal else 'NO'} | {light} |"
        )
    return "\n".join(lines) + "\n"
