"""`Refiner.fit`: every kind of picture in, any callable as the model, and a better material out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nets.checkpoint import Record, save_model
from nets.color import linear_to_srgb
from nets.generator import Generator, GeneratorConfig
from nets.render import Camera, PointLight, render
from nets.svbrdf import MAPS, SVBRDF
from refine import Refined, Refiner
from refine.errors import UserError
from refine.fidelity import rerendering_rmse
from refine.initialization import initialize
from refine.maps import read_maps
from refine.run import run_stages
from refine.stages import RECIPES, GlobalStage, PixelStage, PosteriorStage, Rates, Recipe, Widths
from tests.e2e.pictures import LIGHT, flash_photo, save_picture
from tests.helpers import assert_close, seeded

FLASH = PointLight.at(LIGHT)
WRONG = {"diffuse": 0.12, "roughness": 0.7, "specular": 0.2}
"""A flat material that is nothing like that of `flash_photo`."""


def wrong(photo: Tensor) -> tuple[SVBRDF, PointLight]:
    return SVBRDF.constant(*photo.shape[-2:], **WRONG), FLASH


def noisy(photo: Tensor) -> tuple[SVBRDF, PointLight]:
    """A model that draws random numbers."""
    svbrdf, light = wrong(photo)
    return replace(svbrdf, diffuse=torch.rand_like(svbrdf.diffuse)), light


def picture(height: int = 32, width: int = 48) -> np.ndarray:
    """Return an encoded photo whose values 8 bits hold exactly."""
    return np.rint(flash_photo(height, width) * 255.0).astype(np.uint8)


def require_legal(refined: Refined) -> None:
    refined.svbrdf.validate()
    refined.initial.validate()
    assert bool(torch.isfinite(refined.render()).all())
    assert all(np.isfinite(curve).all() for curve in refined.losses.values())


def difference(first: Refined, second: Refined) -> float:
    return float((first.svbrdf.channels() - second.svbrdf.channels()).abs().max())


# What is taken


def test_one_picture_in_every_form_gives_one_material(tmp_path: Path) -> None:
    eight = picture()
    floats = eight.astype(np.float32) / 255.0
    linear = Refiner(wrong).fit(eight, light=FLASH, iters=0).capture.photo[0]
    forms: dict[str, tuple[Any, dict[str, Any]]] = {
        "path": (save_picture(tmp_path / "a.png", floats), {}),
        "text": (str(save_picture(tmp_path / "b.png", floats, "uint16")), {}),
        "uint16": (eight.astype(np.uint16) * 257, {}),
        "float32": (floats, {}),
        "float64": (eight / 255.0, {}),
        "float tensor": (torch.from_numpy(floats).permute(2, 0, 1), {}),
        "batched tensor": (torch.from_numpy(floats).permute(2, 0, 1)[None], {}),
        "uint8 tensor": (torch.from_numpy(eight).permute(2, 0, 1), {}),
        "linear tensor": (linear, {"color_space": "linear"}),
        "with alpha": (np.concatenate([eight, np.full_like(eight[..., :1], 255)], axis=2), {}),
    }
    expected = Refiner(wrong).fit(eight, light=FLASH, iters=30)
    for name, (form, more) in forms.items():
        found = Refiner(wrong).fit(form, light=FLASH, iters=30, **more)
        assert found.svbrdf.size == (32, 48), name
        assert difference(found, expected) < 1e-3, name
    other = Refiner(wrong).fit(eight // 2, light=FLASH, iters=30)
    assert difference(other, expected) > 1e-2


@pytest.mark.parametrize("bad", [np.zeros((32, 32, 7)), np.zeros((32, 32, 3), dtype=np.int64), np.zeros(9)])
def test_arrays_that_are_no_pictures_are_refused(bad: np.ndarray) -> None:
    with pytest.raises(UserError, match="array"):
        Refiner(wrong).fit(bad)


@pytest.mark.parametrize(("height", "width"), [(16, 70), (61, 33), (32, 32)])
def test_every_pixel_is_kept(height: int, width: int) -> None:
    for resolution in (None, 256):
        refined = Refiner(wrong, resolution=resolution).fit(picture(height, width), light=FLASH, iters=2)
        assert refined.svbrdf.size == refined.initial.size == (height, width)
        assert refined.render().shape == refined.capture.photo.shape == (1, 3, height, width)
        require_legal(refined)


@pytest.mark.parametrize(
    ("resolution", "size"), [(None, (300, 400)), (256, (192, 256)), (100, (75, 100)), (1000, (300, 400))]
)
def test_resolution_is_the_longer_side(resolution: int | None, size: tuple[int, int]) -> None:
    refined = Refiner(wrong, resolution=resolution).fit(picture(300, 400), light=FLASH, iters=1)
    assert refined.svbrdf.size == size
    assert any("shrunk" in note for note in refined.notes) == (size != (300, 400))


# Models, lights and cameras


def test_any_callable_is_a_model() -> None:
    class Network:
        def predict(self, photo: Tensor) -> tuple[SVBRDF, PointLight]:
            return wrong(photo)

    class Called:
        def __call__(self, photo: Tensor) -> tuple[SVBRDF, PointLight]:
            return wrong(photo)

    results = [Refiner(m).fit(picture(), iters=3) for m in (wrong, lambda p: wrong(p), Network(), Called())]
    assert all(difference(result, results[0]) == 0.0 for result in results)


def test_a_checkpoint_is_a_model(tmp_path: Path) -> None:
    shape = GeneratorConfig(width=2, levels=5, deep_multiplier=2)
    network = Generator(shape)
    save_model(tmp_path / "net.safetensors", network, Record(shape))
    network.half().float()  # as stored
    for name in (tmp_path / "net.safetensors", str(tmp_path / "net.safetensors")):
        found = Refiner(name, flips=False).fit(picture(), iters=0)
        expected = Refiner(network).fit(picture(), iters=0)
        assert_close(found.svbrdf.channels(), expected.svbrdf.channels())
        assert_close(found.light.position, expected.light.position)


@pytest.mark.usefixtures("unchecked")
def test_wrong_models_end_in_a_clear_error() -> None:
    def small(photo: Tensor) -> Any:
        return SVBRDF.constant(100, 100), FLASH

    def nan(photo: Tensor) -> Any:
        svbrdf, light = wrong(photo)
        return replace(svbrdf, roughness=svbrdf.roughness * float("nan")), light

    def bare(photo: Tensor) -> Any:
        return photo

    for model, hint in ((small, "100, 100"), (nan, "roughness holds NaN"), (bare, "expected an SVBRDF")):
        with pytest.raises(ValueError, match=f"the model returned .*{hint}"):
            Refiner(model).fit(picture(), iters=2)


@pytest.mark.parametrize("camera", [None, Camera("orthographic"), Camera("collocated")])
def test_render_is_the_renderer(camera: Camera | None) -> None:
    refined = Refiner(wrong, camera=camera).fit(picture(), light=FLASH, iters=2)
    novel, elsewhere = PointLight.at((0.5, 0.4, 1.2), 0.7), Camera(position=(0.3, 0.0, 3.0))
    seen_from = camera or Camera()
    assert refined.camera == seen_from
    assert torch.equal(refined.render(novel), render(refined.svbrdf, novel, seen_from))
    assert torch.equal(refined.render(), render(refined.svbrdf, FLASH, seen_from))
    assert torch.equal(refined.render(novel, elsewhere), render(refined.svbrdf, novel, elsewhere))
    assert not torch.equal(refined.render(novel), refined.render())


# Iterations


def test_no_iterations_return_the_initialization_bit_for_bit() -> None:
    told: list[object] = []
    refined = Refiner(wrong).fit(picture(), iters=0, progress=lambda *news: told.append(news))
    expected, _ = initialize(wrong, refined.capture.photo)
    for name in MAPS:
        assert torch.equal(getattr(refined.svbrdf, name), getattr(expected, name))
        assert torch.equal(getattr(refined.initial, name), getattr(expected, name))
    assert refined.light is FLASH
    assert list(refined.losses) == ["initialization"]
    assert told == []


@pytest.mark.parametrize("iters", [-1, -300])
def test_negative_iterations_are_refused(iters: int) -> None:
    with pytest.raises(ValueError, match=f"0 or more, got {iters}"):
        Refiner(wrong).fit(picture(), iters=iters)


def test_an_unknown_recipe_is_refused() -> None:
    with pytest.raises(ValueError, match="paper"):
        Refiner(wrong, "soup")


def test_progress_and_losses_tell_of_every_iteration() -> None:
    told: list[tuple[str, int, int, float]] = []
    refined = Refiner(wrong, "paper").fit(
        picture(), light=FLASH, iters=10, progress=lambda *news: told.append(news)
    )
    assert [iteration for _, iteration, _, _ in told] == list(range(1, 11))
    assert {total for _, _, total, _ in told} == {10}
    stages = RECIPES["paper"].with_iterations(10).stages
    assert [name for name, *_ in told] == [stage.name for stage in stages for _ in range(stage.iterations)]
    assert {name for name, *_ in told} == {"global", "per-pixel"}
    curves = refined.losses["global"][:-1] + refined.losses["per-pixel"][:-1]
    assert [loss for *_, loss in told] == curves
    assert refined.losses["initialization"] == [pytest.approx(curves[0], rel=1e-4)]
    assert refined.losses["per-pixel"][0] == pytest.approx(min(refined.losses["global"]), rel=1e-4)
    assert set(refined.seconds) == {"initialization", "global", "per-pixel"}
    assert all(seconds >= 0.0 for seconds in refined.seconds.values())
    assert refined.recipe == RECIPES["paper"].with_iterations(10)


def test_a_stage_that_comes_twice_keeps_both_histories() -> None:
    stages = (PixelStage(3, Rates(diffuse=0.1)), GlobalStage(2), PixelStage(4, Rates(normal=0.1)))
    refined = Refiner(wrong, Recipe("twice", stages=stages)).fit(picture(), light=FLASH)
    lengths = {name: len(curve) for name, curve in refined.losses.items()}
    assert lengths == {"initialization": 1, "per-pixel": 4, "global": 3, "per-pixel 2": 5}
    assert set(refined.seconds) == {"initialization", "per-pixel", "global", "per-pixel 2"}


def test_a_stage_that_moves_nothing_is_passed_over() -> None:
    still = (GlobalStage(2, Rates()), PixelStage(3, Rates()), PosteriorStage(2, Widths()))
    refined = Refiner(wrong, Recipe("still", stages=still)).fit(picture(), light=FLASH)
    assert set(refined.losses) == {"initialization"}
    for name in MAPS:
        assert_close(getattr(refined.svbrdf, name), getattr(refined.initial, name), atol=3e-3)


def test_same_seed_same_maps_and_another_seed_others() -> None:
    first, again, other = (Refiner(noisy, seed=seed).fit(picture(), iters=4) for seed in (3, 3, 4))
    assert difference(first, again) == 0.0
    assert torch.equal(first.light.position, again.light.position)
    assert difference(first, other) > 0.01


# How good it is


def test_a_wrong_material_is_refined_to_less_than_half_the_error() -> None:
    photo = flash_photo(48, 64)
    refined = Refiner(wrong).fit(photo, light=FLASH)
    before = rerendering_rmse(render(refined.initial, refined.light, refined.camera), refined.capture)
    after = rerendering_rmse(refined.render(), refined.capture)
    assert before is not None
    assert after is not None
    assert before > 0.05
    assert after <= 0.5 * before
    require_legal(refined)


def test_saturated_pixels_do_not_darken_the_material() -> None:
    """Where the photo is clipped, a brighter rendering is no error: its pixels stay as they were."""
    clipped = np.full((24, 24, 3), 100, dtype=np.uint8)
    clipped[8:16, 8:16] = 255

    def bright(photo: Tensor) -> tuple[SVBRDF, PointLight]:
        return SVBRDF.constant(*photo.shape[-2:], diffuse=0.9), PointLight.at((0.0, 0.0, 2.0), 2.0)

    recipe = Recipe("pixels", light_fit=None, stages=(PixelStage(60),))
    refined = Refiner(bright, recipe).fit(clipped)
    assert int((~refined.capture.unsaturated).sum()) == 64
    change = (refined.svbrdf.diffuse - refined.initial.diffuse)[0]
    assert float(change[:, 8:16, 8:16].abs().max()) < 1e-5
    assert float(change[:, :8].max()) < -0.005


def test_light_above_one_counts_as_saturated() -> None:
    """A float photo is not clipped as stored, but it is when it becomes a capture."""
    photo = torch.full((3, 24, 24), 0.2)
    photo[:, :6] = 5.0
    capture = Refiner(wrong).fit(photo, iters=0, color_space="linear").capture
    assert float(capture.photo.max()) == 1.0
    assert not capture.unsaturated[:, :, :6].any()
    assert capture.unsaturated[:, :, 6:].all()


def one_bright_pixel() -> np.ndarray:
    pixels = np.zeros((24, 32, 3), dtype=np.uint8)
    pixels[5, 7] = 255
    return pixels


EXTREMES = {
    "black": np.zeros((24, 32, 3), dtype=np.uint8),
    "white": np.full((24, 32, 3), 255, dtype=np.uint8),
    "one saturated pixel": one_bright_pixel(),
    "one colour channel": np.dstack([np.full((24, 32), 255), np.zeros((24, 32, 2))]).astype(np.uint8),
    "checkers": np.indices((24, 32, 3))[:2].sum(axis=0).astype(np.uint8) % 2 * 255,
    "noise": (torch.rand(24, 32, 3, generator=seeded(0)) * 255).byte().numpy(),
}


def extreme(photo: Tensor) -> tuple[SVBRDF, PointLight]:
    """Every value at an end of its range, and normals at the horizon."""
    svbrdf = SVBRDF.constant(*photo.shape[-2:], diffuse=0.0, roughness=1e-3, specular=1.0)
    svbrdf.normal[..., ::2] = torch.tensor([1.0, 0.0, 0.0])[:, None, None]
    return svbrdf, PointLight.at((3.0, 0.0, 0.2))


@pytest.mark.parametrize("model", [wrong, extreme])
@pytest.mark.parametrize("photo", EXTREMES.values(), ids=EXTREMES)
def test_extreme_photos_give_legal_materials(photo: np.ndarray, model: Any) -> None:
    refined = Refiner(model).fit(photo, iters=12)
    require_legal(refined)
    assert bool(torch.isfinite(refined.light.position).all())


# What comes out


def test_save_writes_the_files_of_the_contract(tmp_path: Path) -> None:
    kinds = ("normal", "diffuse", "specular", "roughness", "rendering")
    path = save_picture(tmp_path / "my wall.v2.png", flash_photo(20, 30))
    refined = Refiner(wrong).fit(path, light=FLASH, iters=2)
    written = refined.save(tmp_path / "deep" / "out")
    assert {p.name for p in (tmp_path / "deep" / "out").iterdir()} == {f"my wall.v2_{k}.png" for k in kinds}
    assert written == {kind: tmp_path / "deep" / "out" / f"my wall.v2_{kind}.png" for kind in kinds}
    again = read_maps(tmp_path / "deep" / "out", "my wall.v2")
    assert_close(again.channels(), refined.svbrdf.channels(), atol=1e-4)


def test_save_of_an_array_is_called_material_or_as_asked(tmp_path: Path) -> None:
    refined = Refiner(wrong).fit(picture(), light=FLASH, iters=1)
    assert refined.save(tmp_path / "a")["normal"].name == "material_normal.png"
    assert refined.save(tmp_path / "b", "oak", normal_convention="directx")["normal"].name == "oak_normal.png"
    flipped = read_maps(tmp_path / "b", "oak").normal * torch.tensor([1.0, -1.0, 1.0])[:, None, None]
    assert_close(flipped, read_maps(tmp_path / "a", "material").normal, atol=1e-4)


def test_the_result_holds_no_graph_and_the_input_is_untouched() -> None:
    photo = torch.from_numpy(flash_photo(24, 24)).permute(2, 0, 1).contiguous()
    before = photo.clone()
    refined = Refiner(wrong).fit(photo, iters=3)
    assert torch.equal(photo, before)
    assert not any(getattr(refined.svbrdf, name).requires_grad for name in MAPS)
    assert refined.capture.light is refined.light


def test_stages_start_where_the_last_one_ended() -> None:
    refined = Refiner(wrong, "paper").fit(flash_photo(24, 24), light=FLASH, iters=20)
    seconds: dict[str, float] = {}
    again, losses = run_stages(refined.svbrdf, refined.capture, refined.recipe, seconds)
    assert losses["initialization"][0] == pytest.approx(min(refined.losses["per-pixel"]), rel=1e-3)
    assert min(losses["per-pixel"]) < min(refined.losses["per-pixel"])
    again.validate()


def test_stages_ask_for_the_light() -> None:
    refined = Refiner(wrong).fit(flash_photo(24, 24), light=FLASH, iters=0)
    with pytest.raises(ValueError, match="light"):
        run_stages(refined.initial, replace(refined.capture, light=None), refined.recipe, {})


def test_photos_are_linearised_once() -> None:
    refined = Refiner(wrong).fit(picture(), light=FLASH, iters=0)
    assert_close(
        linear_to_srgb(refined.capture.photo)[0].permute(1, 2, 0), torch.from_numpy(picture() / 255.0).float()
    )
