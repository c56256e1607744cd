"""What a long stage found, kept for the next recipe that begins alike: Gao19+ is Gao19 and 200 steps more."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from nets.svbrdf import MAPS
from refine.capture import Capture
from refine.parametrization import Parameters
from refine.stages import Stage


@dataclass(frozen=True)
class Outcome:
    """Where a stage ended.

    Attributes:
        parameters: the best it saw.
        history: the loss before every step and after the last.
        seconds: it took.
    """

    parameters: Parameters
    history: list[float]
    seconds: float


class StageMemory:
    """The last stage that ended: what it was asked, to the last bit, and what it found.

    It lives no longer than its process, and does not see that a checkpoint on disk was replaced.
    """

    def __init__(self) -> None:
        """Begin with nothing known."""
        self._last: tuple[str, Outcome] | None = None

    def outcome(
        self,
        stage: Stage,
        start: Parameters,
        photos: Sequence[Capture],
        engine: str,
        run: Callable[[], Outcome],
    ) -> Outcome:
        """Return what this very stage finds from this very start; it runs unless it was the last that did."""
        asked = _digest(stage, start, photos, engine)
        if self._last is None or self._last[0] != asked:
            self._last = asked, run()
        return self._last[1]


def _digest(stage: Stage, start: Parameters, photos: Sequence[Capture], engine: str) -> str:
    digest = hashlib.sha256(f"{stage} {engine}".encode())

    def add(tensor: Tensor) -> None:
        array = tensor.detach().cpu().contiguous().numpy()
        digest.update(f"{array.dtype} {array.shape}".encode() + array.tobytes())

    for name in MAPS:
        add(getattr(start, name))
    for photo in photos:
        digest.update(f"{photo.camera} {photo.light and photo.light.falloff}".encode())
        for tensor in (photo.photo, photo.unsaturated):
            add(tensor)
        if photo.light is not None:
            add(photo.light.position)
            add(photo.light.intensity)
    return digest.hexdigest()
