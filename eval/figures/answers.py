"""What rows answer to scenes, computed once however many figures show it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from eval.methods import Row
from eval.yardsticks import Yardstick
from nets.data.images import DataError
from refine.refiner import Refined, Refiner

Told = Callable[[str], None]
"""Called with what has just been computed."""


@dataclass
class Answers:
    """A test set, the rows whose weights are there, and their answers as they are asked for.

    Attributes:
        yardstick: test set and protocol.
        rows: those that can answer.
        told: called with the name of every new answer.
    """

    yardstick: Yardstick
    rows: Sequence[Row]
    told: Told = lambda _: None
    _refiners: dict[str, Refiner] = field(default_factory=dict, repr=False)
    _found: dict[tuple[str, int], Refined] = field(default_factory=dict, repr=False)
    _scenes: dict[int, Any] = field(default_factory=dict, repr=False)

    def scene(self, index: int) -> Any:
        """Return a scene of the test set.

        Raises:
            DataError: it cannot be read.
        """
        if index not in self._scenes:
            self._scenes[index] = self.yardstick.read(index)
        return self._scenes[index]

    def readable(self, indices: Sequence[int], skipped: dict[str, str]) -> list[int]:
        """Return the scenes that can be read; the others' names and reasons go to `skipped`."""
        found = []
        for index in indices:
            try:
                self.scene(index)
                found.append(index)
            except DataError as error:
                skipped[self.yardstick.scenes()[index]] = str(error)
        return found

    def refiner(self, name: str) -> Refiner:
        """Return a row's network and recipe, loaded once.

        Raises:
            KeyError: the row cannot answer.
        """
        if name not in self._refiners:
            row = next((row for row in self.rows if row.method.name == name), None)
            if row is None:
                raise KeyError(name)
            yardstick = self.yardstick
            self._refiners[name] = row.refiner(
                yardstick.camera, yardstick.size, yardstick.seed, flips=yardstick.flips
            )
        return self._refiners[name]

    def of(self, name: str, index: int) -> Refined | None:
        """Return a row's answer to a scene; None if its weights are not there.

        Raises:
            DataError: the scene cannot be read.
        """
        row = next((row for row in self.rows if row.method.name == name), None)
        if row is None:
            return None
        if (name, index) not in self._found:
            scene = self.scene(index)
            refine = row.method.recipe is not None
            self._found[name, index] = self.yardstick.answer(scene, self.refiner(name), refine=refine)
            self.told(f"{name}, {scene.name}")
        return self._found[name, index]
