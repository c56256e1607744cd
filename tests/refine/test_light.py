"""The flash is found to within 5 % where the material is known, from 8-bit files, whatever the material."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from torch import Tensor

from nets.checkpoint import load_model
from nets.color import linear_to_srgb
from nets.data.pool_format import from_planes
from nets.data.procedural import generate
from nets.ensemble import FlipAverage
from nets.render import Camera, PointLight, render
from nets.svbrdf import SVBRDF
from refine import Refined, Refiner
from refine.light import LightFit, check_falloff, starting_light
from refine.stages import RECIPES, Recipe
from tests.e2e.pictures import save_picture

SIZE = 256
ALLOWED = 0.05
WRONG_BY = 0.15
"""Distances as shares of the light's distance from the centre of the surface."""

Model = Callable[[Tensor], tuple[SVBRDF, PointLight]]
Position = tuple[float, float, float]
FallOff = Literal["none", "inverse_square"]

PLAIN = {
    "plain gloss": SVBRDF.constant(SIZE, SIZE, diffuse=0.3, roughness=0.3, specular=0.05),
    "plain satin": SVBRDF.constant(SIZE, SIZE, diffuse=0.4, roughness=0.5, specular=0.04),
    "plain matte": SVBRDF.constant(SIZE, SIZE, diffuse=0.5, roughness=0.8, specular=0.04),
    "plain metal": SVBRDF.constant(SIZE, SIZE, diffuse=0.02, roughness=0.4, specular=0.7),
}
TEXTURED = ("leather", "glazed_tile", "slate", "wood_planks", "scratched_metal", "hammered_metal")
POSITIONS: tuple[Position, ...] = ((0.0, 0.0, 1.5), (0.2, -0.1, 2.0), (-0.3, 0.2, 3.0), (0.8, -0.6, 2.5))
TOWARDS: tuple[Position, ...] = ((1, 1, 1), (-1, 1, -1), (1, -1, -1), (-1, 0.2, 1))
"""Where the guess lies from the truth: nearer and farther, left and right."""


@cache
def material(name: str) -> SVBRDF:
    if name in PLAIN:
        return PLAIN[name]
    return from_planes(generate(name, SIZE, 3)).validate()


def beside(position: Position, towards: Position, share: float = WRONG_BY) -> PointLight:
    """Return a light that is wrong by a share of its distance."""
    step = share * math.dist(position, (0, 0, 0)) / math.dist(towards, (0, 0, 0))
    x, y, z = (value + step * direction for value, direction in zip(position, towards, strict=True))
    return PointLight.at((x, y, z))


def saved(folder: Path, svbrdf: SVBRDF, light: PointLight, camera: Camera | None = None) -> Path:
    """Write the 8-bit photo of a material."""
    encoded = linear_to_srgb(render(svbrdf, light, camera).clamp(max=1.0))
    return save_picture(folder / "photo.png", encoded[0].permute(1, 2, 0).numpy())


def knows(svbrdf: SVBRDF, guess: PointLight) -> Model:
    return lambda photo: (svbrdf, guess)


def error(found: PointLight, truth: PointLight) -> float:
    distance = torch.linalg.vector_norm(found.position - truth.position)
    return float(distance / torch.linalg.vector_norm(truth.position))


CASES = [
    pytest.param(name, (number + shift) % len(POSITIONS), id=f"{name}-{(number + shift) % len(POSITIONS)}")
    for number, name in enumerate([*PLAIN, *TEXTURED])
    for shift in (0, 2)
]
"""Every material under two lights, every light on five materials."""


@pytest.mark.parametrize(("name", "case"), CASES)
def test_a_known_material_gives_the_light_away(name: str, case: int, tmp_path: Path) -> None:
    truth, guess = PointLight.at(POSITIONS[case]), beside(POSITIONS[case], TOWARDS[case])
    assert error(guess, truth) == pytest.approx(WRONG_BY, abs=1e-5)
    photo = saved(tmp_path, material(name), truth)
    refined = Refiner(knows(material(name), guess)).fit(photo, iters=1)
    assert error(refined.light, truth) < ALLOWED


@pytest.mark.parametrize(("name", "case"), [("slate", 1), ("leather", 2), ("glazed_tile", 3)])
def test_the_shipped_light_head_and_the_fit_find_the_flash(name: str, case: int, tmp_path: Path) -> None:
    truth, network = PointLight.at(POSITIONS[case]), FlipAverage(load_model("default"))
    photo = saved(tmp_path, material(name), truth)
    refined = Refiner(lambda seen: (material(name), network.predict(seen)[1])).fit(photo, iters=1)
    assert error(refined.light, truth) < ALLOWED


@pytest.mark.parametrize(
    "camera", [Camera("orthographic"), Camera("collocated"), Camera(position=(0.3, 0, 3))]
)
def test_from_every_camera(camera: Camera, tmp_path: Path) -> None:
    truth = PointLight.at((0.3, 0.2, 2.0))
    photo = saved(tmp_path, material("leather"), truth, camera)
    model = knows(material("leather"), beside((0.3, 0.2, 2.0), (1, -1, 1)))
    assert error(Refiner(model, camera=camera).fit(photo, iters=1).light, truth) < ALLOWED


def test_falloff_and_intensity_are_the_guess_s(tmp_path: Path) -> None:
    truth = PointLight.at((0.2, -0.3, 1.8), (1.2, 1.0, 0.8), "inverse_square")
    guess = PointLight.at((0.4, -0.1, 2.0), (1.2, 1.0, 0.8), "inverse_square")
    photo = saved(tmp_path, material("plain satin"), truth)
    found = Refiner(knows(material("plain satin"), guess)).fit(photo, iters=1).light
    assert error(found, truth) < ALLOWED < error(guess, truth)
    assert found.falloff == "inverse_square"
    assert torch.equal(found.intensity, guess.intensity)
    assert found.position.dtype == torch.float32


@pytest.mark.parametrize("truly", ["none", "inverse_square"])
@pytest.mark.parametrize("guessed", ["none", "inverse_square"])
@pytest.mark.parametrize("name", ["plain satin", "leather", "hammered_metal"])
def test_the_falloff_that_explains_the_photo_is_kept(
    name: str, guessed: FallOff, truly: FallOff, tmp_path: Path
) -> None:
    truth = replace(PointLight.at((0.1, -0.2, 1.6)), falloff=truly)
    guess = replace(beside((0.1, -0.2, 1.6), (1, -1, 1)), falloff=guessed)
    photo = saved(tmp_path, material(name), truth)
    found = Refiner(knows(material(name), guess)).fit(photo, iters=1, falloff="auto").light
    assert found.falloff == truly
    assert error(found, truth) < ALLOWED


@pytest.mark.parametrize("falloff", ["none", "inverse_square"])
@pytest.mark.parametrize("iters", [0, 1])
def test_a_falloff_can_be_said(falloff: FallOff, iters: int, tmp_path: Path) -> None:
    refined, _ = fitted(tmp_path, iters=iters, falloff=falloff)
    assert refined.light.falloff == falloff


def test_an_unknown_falloff_is_refused() -> None:
    for known in (None, "auto", "none", "inverse_square"):
        check_falloff(known)
    with pytest.raises(ValueError, match="'linear'; the known ones are none, inverse_square, auto"):
        check_falloff("linear")


def fitted(tmp_path: Path, **more: object) -> tuple[Refined, PointLight]:
    guess = beside((0.2, -0.1, 2.0), (1, 1, 1))
    photo = saved(tmp_path, PLAIN["plain satin"], PointLight.at((0.2, -0.1, 2.0)))
    recipe = more.pop("recipe", "paper")
    assert isinstance(recipe, str | Recipe)
    return Refiner(knows(PLAIN["plain satin"], guess), recipe).fit(photo, **more), guess  # type: ignore[arg-type]


def test_a_given_light_stays_as_given(tmp_path: Path) -> None:
    given = PointLight.at((0.5, 0.5, 1.7), 0.9, "inverse_square")
    refined, _ = fitted(tmp_path, light=given, iters=1)
    assert refined.light is given
    assert torch.equal(given.position, torch.tensor([[0.5, 0.5, 1.7]]))
    assert "light" not in refined.seconds


def test_without_a_light_fit_or_iterations_the_guess_stays(tmp_path: Path) -> None:
    bare = Recipe("bare", light_fit=None, stages=RECIPES["paper"].stages)
    for more in ({"iters": 0}, {"iters": 2, "recipe": bare}):
        refined, guess = fitted(tmp_path, **more)
        assert torch.equal(refined.light.position, guess.position)
        assert "light" not in refined.seconds


def test_a_photo_of_nothing_leaves_the_light_near_its_guess() -> None:
    guess = PointLight.at((0.3, -0.2, 2.0))
    model = knows(SVBRDF.constant(SIZE, SIZE), guess)
    for value in (0, 255):
        black_or_white = np.full((64, 64, 3), value, dtype=np.uint8)
        found = Refiner(model).fit(black_or_white, iters=1).light
        assert bool(torch.isfinite(found.position).all())
        assert float(found.position[0, 2]) > 0.0


def test_the_fit_is_the_same_twice(tmp_path: Path) -> None:
    first, second = (fitted(tmp_path, iters=1)[0] for _ in range(2))
    assert torch.equal(first.light.position, second.light.position)


@pytest.mark.parametrize("height", [0.9, 2.0, 6.0])
def test_the_fit_starts_at_the_cameras_height(height: float) -> None:
    direction = torch.tensor([0.3, -0.2, 1.0])
    guess = PointLight((direction * height)[None], torch.full((1, 3), 0.7), "inverse_square")
    found = starting_light(guess, Camera(position=(0.5, 0.0, 3.0)))
    torch.testing.assert_close(found.position[0], direction * 3.0)
    assert (found.intensity is guess.intensity, found.falloff) == (True, "inverse_square")
    for kind in ("orthographic", "collocated"):
        assert starting_light(guess, Camera(kind)) is guess  # type: ignore[arg-type]


@pytest.mark.parametrize("at_camera", [True, False])
def test_without_evaluations_the_light_stays_where_it_starts(at_camera: bool, tmp_path: Path) -> None:
    fit = LightFit(flash_at_camera=at_camera, evaluations=0)
    still = Recipe("still", light_fit=fit, stages=RECIPES["paper"].stages)
    for falloff in (None, "auto"):
        refined, guess = fitted(tmp_path, iters=1, recipe=still, falloff=falloff)
        start = starting_light(guess, Camera()) if at_camera else guess
        assert torch.equal(refined.light.position, start.position)


@pytest.mark.parametrize("name", ["hammered_metal", "leather", "slate"])
def test_a_material_that_explains_little_does_not_move_the_flash(name: str, tmp_path: Path) -> None:
    truth = PointLight.at((0.0, 0.0, 2.14))
    photo = saved(tmp_path, material(name), truth)
    flat = material(name)
    up = torch.tensor([0.0, 0.0, 1.0])[:, None, None].expand_as(flat.normal)
    wrong = replace(flat, normal=up, roughness=flat.roughness * 0.6)
    found = Refiner(knows(wrong, PointLight.at((0.1, -0.1, 3.1)))).fit(photo, iters=1).light
    assert error(found, truth) < 0.1
