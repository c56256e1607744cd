"""Every ablation is a row, on the same start and told the light, but for those that must find it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from typer.testing import CliRunner

from eval import ablations
from eval.ablations import ABLATIONS, UNTOLD, ablation_estimator
from eval.cli import main
from eval.datasets import CAMERA, INPUT_LIGHT, Scene, novel_lights
from nets.render import PointLight, render
from nets.svbrdf import MAPS
from refine.refiner import Refiner
from refine.stages import RECIPES
from tests.eval_files import FakeModel, material


@pytest.fixture
def scene() -> Scene:
    truth = material(0, 32)
    light = PointLight.at(INPUT_LIGHT)
    return Scene("scene", truth, render(truth, light, CAMERA).clamp(max=1.0), light, novel_lights(0, 2))


def test_the_whole_recipe_is_among_its_ablations() -> None:
    assert ABLATIONS["default"] == RECIPES["default"]
    assert UNTOLD["light not told"] == RECIPES["default"]
    assert len(set(map(repr, ABLATIONS.values()))) == len(ABLATIONS)  # each takes something else away


def test_every_ablation_gives_a_material(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    for rows in (ABLATIONS, UNTOLD):
        for name, recipe in rows.items():
            monkeypatch.setitem(rows, name, recipe.with_iterations(4))
    found = ablation_estimator(Refiner(FakeModel(), camera=CAMERA))(scene)
    assert list(found) == ["initialization", *ABLATIONS, *UNTOLD]
    start = found["initialization"].svbrdf
    for name, estimate in found.items():
        estimate.svbrdf.validate()
        moved = any(not torch.equal(getattr(estimate.svbrdf, one), getattr(start, one)) for one in MAPS)
        assert moved == (name != "initialization"), name
    normal = found["normals not per pixel"].svbrdf.normal
    assert torch.equal(normal, start.normal)


def test_where_the_light_is_not_told_nobody_looks_it_up(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ablations, "ABLATIONS", {})
    for name, recipe in UNTOLD.items():
        monkeypatch.setitem(UNTOLD, name, recipe.with_iterations(4))
    estimate = ablation_estimator(Refiner(FakeModel(), camera=CAMERA))
    found = estimate(scene)
    elsewhere = estimate(replace(scene, photo_light=PointLight.at((0.9, 0.2, 1.7))))
    for name in UNTOLD:
        assert torch.equal(found[name].svbrdf.diffuse, elsewhere[name].svbrdf.diffuse)


def test_a_missing_data_folder_is_named() -> None:
    result = CliRunner().invoke(main, ["ablations", "--data", "absent"])
    assert result.exit_code == 2
    assert "absent" in result.stderr
