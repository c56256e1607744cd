"""Several photos of one surface: one material to start from, and a light for each photo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from nets.ensemble import Predictor
from nets.render import PointLight
from nets.svbrdf import MAPS, SVBRDF
from refine.bands import render_in_bands
from refine.calibration import SelfCalibration, calibrate
from refine.capture import Capture
from refine.initialization import Predict, initialize
from refine.light import FALLOFFS, FalloffChoice
from refine.parametrization import Parameters


def initialize_together(
    model: Predict | Predictor, captures: Sequence[Capture], visible: Sequence[Bool[Tensor, "1 1 h w"]]
) -> SVBRDF:
    """Let the model guess from every photo, and take the median of each parameter.

    Args:
        model: as in `refine.initialization.initialize`.
        captures: the photos; what one does not show the model sees as in the first.
        visible: where each photo shows the surface.

    Returns:
        A legal material: what most photos say, so that no photo's highlight stays in it.
    """
    guesses = []
    for capture, seen in zip(captures, visible, strict=True):
        whole = torch.where(seen, capture.photo, captures[0].photo)
        guesses.append(Parameters.from_svbrdf(initialize(model, whole, capture.light, capture.camera)[0]))
    medians = (torch.stack([getattr(guess, name) for guess in guesses]).quantile(0.5, dim=0) for name in MAPS)
    return Parameters(*medians).svbrdf()


def find_lights(
    initial: SVBRDF,
    captures: Sequence[Capture],
    falloff: FalloffChoice,
    known: PointLight | None,
    settings: SelfCalibration,
) -> list[PointLight]:
    """Find every photo's light, or only how brightly it shone if its place is known.

    Args:
        initial: material to start from.
        captures: the photos.
        falloff: `auto` tries all and keeps what explains the photos best; None is a real flash's.
        known: lights whose positions and falloff are kept, as a batch.
        settings: see `SelfCalibration`.

    Returns:
        One light per photo, on the material's device.
    """
    names = FALLOFFS if falloff == "auto" else (falloff or "inverse_square",)
    if known is not None:
        names = (known.falloff,)
    found = [calibrate(initial, captures, name, settings, known=known) for name in names]
    lights = min(found, key=lambda calibrated: calibrated.cost).lights.to(initial.normal.device)
    return [
        replace(lights, position=lights.position[n : n + 1], intensity=lights.intensity[n : n + 1])
        for n in range(len(captures))
    ]


def complete(capture: Capture, visible: Bool[Tensor, "1 1 h w"], initial: SVBRDF) -> Capture:
    """Continue a photo where it does not show the surface by what the initial material looks like there.

    Engines know no missing pixels. So continued, a photo has nothing to say against the initialization.
    """
    if bool(visible.all()) or capture.light is None:
        return capture
    rendering = render_in_bands(initial, capture.light, capture.camera).clamp(max=1.0)
    return replace(capture, photo=torch.where(visible, capture.photo, rendering))
