"""Options that several commands of `refine-eval` have in common, said once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Scenes = Annotated[int | None, typer.Option(min=1, help="Scenes per set, evenly spread; all.")]
Size = Annotated[int, typer.Option(min=64, help="Pixels of photo and maps.")]
NovelLights = Annotated[int, typer.Option(min=1, help="Novel lights per scene.")]
ProtocolSeed = Annotated[int, typer.Option(min=0, help="Of the novel lights and of refinement.")]
RefinementSeed = Annotated[int, typer.Option(min=0, help="Of refinement.")]
SceneLightsFile = Annotated[
    Path | None, typer.Option(help="Lights of the scenes, of python -m eval.scene_lights.")
]
MatchExposure = Annotated[
    bool, typer.Option(help="Refine under a light as bright as the initialization needs it, not 1.")
]
Flips = Annotated[bool, typer.Option(help="Average networks over four mirrored photos.")]
Threads = Annotated[int, typer.Option(min=0, help="CPU threads; 0 leaves torch's choice.")]
Inits = Annotated[
    list[str] | None,
    typer.Option("--init", help="ROW=CHECKPOINT: a row's weights, a shipped name or a file."),
]
