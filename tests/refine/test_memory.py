"""A latent stage that was run is not run again, and nothing else is taken for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from nets.render import Camera, PointLight, render
from nets.svbrdf import MAPS
from refine import run
from refine.capture import Capture
from refine.memory import Outcome, StageMemory
from refine.parametrization import Parameters
from refine.run import run_stages
from refine.stages import LatentStage, PixelStage, Recipe
from tests.helpers import random_svbrdf

FLASH = PointLight.at((0.1, -0.2, 2.0))
STAGE = LatentStage(3)
ASKED = (STAGE, Parameters.from_svbrdf(random_svbrdf(1, 6, 7)), "fused")
SHORT, LONG = Recipe("short", stages=(STAGE,)), Recipe("long", stages=(STAGE, PixelStage(4)))


def photo() -> Capture:
    taken = render(random_svbrdf(1, 6, 7, seed=3), FLASH).clamp(max=1.0)
    return Capture(taken, (taken < 1.0).all(dim=1, keepdim=True), light=FLASH)


@pytest.fixture
def descents(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Put a stand-in in the place of the search in latent space; return where each of its searches began."""
    begun: list[float] = []

    def descend(start: Parameters, photos, stage, engine, progress=None):
        begun.append(float(start.diffuse.mean()))
        return start.shifted({"diffuse": torch.full_like(start.diffuse, 0.1)}), [1.0, 0.5]

    monkeypatch.setattr(run, "descend_latent", descend)
    return begun


def test_a_longer_recipe_goes_on_where_a_shorter_one_ended(descents: list[float]) -> None:
    initial, memory = random_svbrdf(1, 6, 7), StageMemory()
    first: dict[str, float] = {}
    run_stages(initial, photo(), SHORT, first, memory=memory)
    then: dict[str, float] = {}
    found, losses = run_stages(initial, photo(), LONG, then, memory=memory)
    assert len(descents) == 1
    assert then["latent"] == first["latent"]  # it counts as if it had been run
    alone, alone_losses = run_stages(initial, photo(), LONG, {})
    assert len(descents) == 2
    assert losses == alone_losses
    assert all(torch.equal(getattr(found, name), getattr(alone, name)) for name in MAPS)


def test_what_is_kept_does_not_change_with_what_was_returned(descents: list[float]) -> None:
    memory = StageMemory()
    _, losses = run_stages(random_svbrdf(1, 6, 7), photo(), SHORT, {}, memory=memory)
    _, again = run_stages(random_svbrdf(1, 6, 7), photo(), SHORT, {}, memory=memory)
    again["latent"].append(0.0)
    _, third = run_stages(random_svbrdf(1, 6, 7), photo(), SHORT, {}, memory=memory)
    assert third["latent"] == losses["latent"]
    assert len(descents) == 1


@pytest.mark.parametrize(
    "changed",
    [
        lambda stage, start, shot, engine: (replace(stage, rate=1e-2), start, [shot], engine),
        lambda stage, start, shot, engine: (stage, _moved(start), [shot], engine),
        lambda stage, start, shot, engine: (stage, start, [shot, shot], engine),
        lambda stage, start, shot, engine: (stage, start, [shot], "reference"),
        lambda stage, start, shot, engine: (stage, start, [replace(shot, photo=shot.photo * 0.9)], engine),
        lambda stage, start, shot, engine: (
            stage,
            start,
            [replace(shot, unsaturated=~shot.unsaturated)],
            engine,
        ),
        lambda stage, start, shot, engine: (
            stage,
            start,
            [replace(shot, camera=Camera("collocated"))],
            engine,
        ),
        lambda stage, start, shot, engine: (
            stage,
            start,
            [replace(shot, light=replace(FLASH, falloff="inverse_square"))],
            engine,
        ),
        lambda stage, start, shot, engine: (
            stage,
            start,
            [replace(shot, light=replace(FLASH, position=FLASH.position + 1e-6))],
            engine,
        ),
        lambda stage, start, shot, engine: (stage, start, [replace(shot, light=None)], engine),
    ],
    ids=["stage", "start", "number", "engine", "photo", "clipped", "camera", "falloff", "position", "unlit"],
)
def test_another_question_has_no_answer_yet(changed: Callable[..., tuple]) -> None:
    stage, start, engine = ASKED
    memory = StageMemory()
    outcomes = [Outcome(start, [loss], 2.0) for loss in (3.0, 2.0, 1.0)]
    left = iter(outcomes)
    same = (stage, start, [photo()], engine)
    assert memory.outcome(*same, lambda: next(left)) is outcomes[0]
    assert memory.outcome(*same, lambda: next(left)) is outcomes[0]
    assert memory.outcome(*changed(stage, start, photo(), engine), lambda: next(left)) is outcomes[1]
    assert memory.outcome(*same, lambda: next(left)) is outcomes[2]  # only the last one is kept


def test_what_was_interrupted_is_not_known() -> None:
    stage, start, engine = ASKED
    memory = StageMemory()

    def interrupted() -> Outcome:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        memory.outcome(stage, start, [photo()], engine, interrupted)
    whole = Outcome(start, [1.0], 2.0)
    assert memory.outcome(stage, start, [photo()], engine, lambda: whole) is whole


def _moved(start: Parameters) -> Parameters:
    return start.shifted({"roughness": torch.full_like(start.roughness, 1e-6)})
