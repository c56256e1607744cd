"""Recipes: data that scales to any number of iterations, becomes JSON, and is asked for by name."""

from __future__ import annotations

import json
from dataclasses import astuple, replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nets.svbrdf import CHANNELS, MAPS
from refine.light import LightFit
from refine.parametrization import Parameters
from refine.stages import (
    LARGEST_SPEEDUP,
    RECIPES,
    GlobalStage,
    LatentStage,
    PixelStage,
    PosteriorStage,
    Rates,
    Recipe,
    Stage,
    Widths,
    find_recipe,
)
from tests.helpers import random_svbrdf


def recipe_of(*iterations: int) -> Recipe:
    kinds = (GlobalStage, PixelStage)
    return Recipe("some", stages=tuple(kinds[index % 2](count) for index, count in enumerate(iterations)))


@given(
    iterations=st.lists(st.integers(0, 1000), min_size=1, max_size=5).filter(any), total=st.integers(0, 5000)
)
def test_scaling_keeps_the_total_the_shares_and_everything_else(iterations: list[int], total: int) -> None:
    recipe = recipe_of(*iterations)
    scaled = recipe.with_iterations(total)
    assert scaled.iterations == total
    for before, after in zip(recipe.stages, scaled.stages, strict=True):
        assert after.iterations >= 0
        assert abs(after.iterations - before.iterations * total / recipe.iterations) <= 1.0
        assert replace(after, iterations=before.iterations, rates=before.rates) == before
        pace = min(LARGEST_SPEEDUP, recipe.iterations / max(1, total))
        assert astuple(after.rates) == pytest.approx([rate * pace for rate in astuple(before.rates)])
    assert (scaled.name, scaled.light_fit) == (recipe.name, recipe.light_fit)


@pytest.mark.parametrize("total", [0, 1, 2, 3, 7, 99, 500, 501, 1237])
@pytest.mark.parametrize("name", sorted(RECIPES))
def test_every_recipe_takes_any_number_of_iterations(name: str, total: int) -> None:
    assert RECIPES[name].with_iterations(total).iterations == total


def test_its_own_number_changes_nothing() -> None:
    assert recipe_of(3, 0, 8).with_iterations(11) == recipe_of(3, 0, 8)
    assert all(recipe.with_iterations(recipe.iterations) == recipe for recipe in RECIPES.values())


@pytest.mark.parametrize(("total", "expected"), [(500, (494, 6)), (26, (20, 6)), (8, (4, 4)), (1, (1, 0))])
def test_a_solver_that_has_converged_keeps_its_steps(total: int, expected: tuple[int, int]) -> None:
    recipe = Recipe("some", stages=(GlobalStage(40), PosteriorStage(6)))
    stages = recipe.with_iterations(total).stages
    assert tuple(stage.iterations for stage in stages) == expected
    assert stages[1] == PosteriorStage(expected[1])
    alone = Recipe("alone", stages=(PosteriorStage(6),)).with_iterations(total)
    assert alone.stages == (PosteriorStage(total),)


@pytest.mark.parametrize("total", [-1, -500])
def test_negative_iterations_are_refused(total: int) -> None:
    with pytest.raises(ValueError, match=f"0 or more, got {total}"):
        recipe_of(3).with_iterations(total)


def rebuilt(stage: dict[str, Any]) -> Stage:
    """Read a stage back from plain data."""
    kind: Any = {kind().name: kind for kind in (GlobalStage, LatentStage, PixelStage, PosteriorStage)}[
        stage["stage"]
    ]
    parts = {"rates": Rates, "widths": Widths}
    fields = {name: parts[name](**value) if name in parts else value for name, value in stage.items()}
    del fields["stage"]
    found: Stage = kind(**fields)
    return found


@pytest.mark.parametrize("recipe", [*RECIPES.values(), Recipe("bare", light_fit=None)], ids=lambda r: r.name)
def test_a_recipe_is_json(recipe: Recipe) -> None:
    data = recipe.as_dict()
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    assert data["name"] == recipe.name
    assert [stage["stage"] for stage in data["stages"]] == [stage.name for stage in recipe.stages]
    assert tuple(rebuilt(stage) for stage in data["stages"]) == recipe.stages
    assert data["light_fit"] == (None if recipe.light_fit is None else vars(recipe.light_fit))
    assert recipe.light_fit is None or LightFit(**data["light_fit"]) == recipe.light_fit


def test_the_paper_refines_globally_roughness_and_specular_then_everything_per_pixel() -> None:
    first, second = RECIPES["paper"].stages
    assert isinstance(first, GlobalStage)
    assert isinstance(second, PixelStage)
    assert set(first.rates.moving()) == {"roughness", "specular"}
    assert set(second.rates.moving()) == set(MAPS)


def test_recipes_are_found_by_the_name_they_carry() -> None:
    for name, recipe in RECIPES.items():
        assert find_recipe(name) is recipe
        assert recipe.name == name


def test_an_unknown_recipe_names_the_known() -> None:
    with pytest.raises(ValueError, match="'soup'") as caught:
        find_recipe("soup")
    assert all(name in str(caught.value) for name in RECIPES)


def test_only_rates_above_zero_move() -> None:
    assert Rates().moving() == {}
    assert Rates(normal=0.5, specular=1e-9).moving() == {"normal": 0.5, "specular": 1e-9}
    assert list(Rates(1.0, 2.0, 3.0, 4.0).moving().items()) == list(
        zip(MAPS, (1.0, 2.0, 3.0, 4.0), strict=True)
    )


@pytest.mark.parametrize(("stage", "size"), [(GlobalStage, (1, 1)), (PixelStage, (5, 7))])
def test_offsets_start_at_zero_and_fit_the_parameters(
    stage: type[GlobalStage | PixelStage], size: tuple[int, int]
) -> None:
    offsets = stage(3, Rates(normal=1.0, roughness=1.0, specular=1.0)).offsets(5, 7)
    assert list(offsets) == ["normal", "roughness", "specular"]
    for name, offset in offsets.items():
        assert offset.shape == (1, CHANNELS[name] - (name == "normal"), *size)
        assert not offset.any()
    parameters = Parameters.from_svbrdf(random_svbrdf(1, 5, 7))
    assert parameters.shifted(offsets).roughness.equal(parameters.roughness)
