"""Real scenes, made up: photos of known materials by a flash of known power."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from eval import cli, console
from eval.development import Estimate
from eval.real import (
    RealResults,
    RealScore,
    evaluate_real,
    exposure,
    real_estimator,
    real_markdown,
    score_estimate,
)
from eval.real_scenes import CAMERA, RealScene, list_real_scenes, read_real_scene, read_real_scenes
from nets.data.images import DataError
from nets.render import PointLight
from nets.svbrdf import SVBRDF
from refine.refiner import Refiner
from tests.eval_files import PLACES, WIDTH, FakeModel, flash_photo, grey, material, write_surface

SIZE = 48


@pytest.fixture
def surface() -> SVBRDF:
    return material(3, SIZE)


@pytest.fixture
def scene(tmp_path: Path, surface: SVBRDF) -> RealScene:
    return read_real_scene(write_surface(tmp_path / "wall", surface, "calib.json"), SIZE)


def test_the_photo_of_the_most_central_light_is_given(scene: RealScene, surface: SVBRDF) -> None:
    assert Path(scene.photo.source).name == "01.png"
    assert scene.light.position[0].tolist() == pytest.approx([x / (WIDTH / 2.0) for x in PLACES[1]])
    assert scene.held_out_lights.position[:, 2].tolist() == pytest.approx([14 / 6, 17 / 6, 15 / 6])
    expected = torch.cat([flash_photo(surface, PLACES[number], 60.0) for number in (0, 2, 3)])
    torch.testing.assert_close(scene.held_out, expected, atol=0.012, rtol=0.0)


def test_the_true_material_explains_every_photo_whatever_the_flash(tmp_path: Path, surface: SVBRDF) -> None:
    # Radiance falls with the squared distance in cm: only so do the intensities of the other lights fit.
    for power in (30.0, 90.0):
        folder = write_surface(tmp_path / str(power), surface, "calib.json", power)
        found = read_real_scene(folder, SIZE)
        factor, rmse, lpips = score_estimate(surface, found)
        assert factor == pytest.approx(power / (13.0**2 + 0.5**2 + 0.6**2), rel=0.01)
        assert rmse < 0.01
        assert lpips != lpips
    # A flash of one brightness everywhere does not.
    same = torch.ones_like(found.held_out_lights.intensity)
    wrong = replace(found, held_out_lights=replace(found.held_out_lights, intensity=same))
    assert score_estimate(surface, wrong)[1] > 3.0 * rmse
    assert score_estimate(material(4, SIZE), found)[1] > 5.0 * rmse


def test_exposure_follows_the_bulk_and_not_what_is_saturated(scene: RealScene, surface: SVBRDF) -> None:
    true = exposure(surface, scene)
    linear = scene.photo.linear.clone()
    linear[..., : SIZE // 3, :] *= 5.0  # a highlight that the estimate lacks
    assert exposure(surface, replace(scene, photo=replace(scene.photo, linear=linear))) < 1.4 * true
    clipped = torch.ones_like(scene.photo.unsaturated)
    clipped[..., : SIZE // 3, :] = False
    masked = replace(scene.photo, linear=linear, unsaturated=clipped)
    assert exposure(surface, replace(scene, photo=masked)) == pytest.approx(true, rel=0.01)
    blind = replace(scene.photo, unsaturated=torch.zeros_like(clipped))
    assert exposure(surface, replace(scene, photo=blind)) == 1.0
    black = SVBRDF.constant(SIZE, SIZE, diffuse=0.0, specular=0.0, roughness=1.0)
    assert torch.isfinite(torch.tensor(exposure(black, scene)))


def test_brightness_of_an_estimate_is_forgiven_and_its_colour_is_not(
    scene: RealScene, surface: SVBRDF
) -> None:
    def with_diffuse(red: float, green: float, blue: float) -> SVBRDF:
        factor = torch.tensor([red, green, blue])[:, None, None]
        black = torch.zeros_like(surface.specular)
        return SVBRDF(surface.normal, surface.diffuse * factor, surface.roughness, black)

    base = score_estimate(with_diffuse(1.0, 1.0, 1.0), scene)[1]
    assert score_estimate(with_diffuse(0.5, 0.5, 0.5), scene)[1] == pytest.approx(base, rel=0.1)
    assert score_estimate(with_diffuse(1.0, 0.3, 0.3), scene)[1] > 1.5 * base


@pytest.mark.parametrize(
    ("calibration", "said", "expected"),
    [
        ("calib.json", {}, "measured"),
        ("calib_fitted.json", {"reliability": "ok"}, "estimated"),
        ("calib_fitted.json", {"reliability": "uncertain"}, "uncertain"),
        ("calib_fitted.json", {}, "uncertain"),
    ],
)
def test_how_well_lights_are_known(
    tmp_path: Path, surface: SVBRDF, calibration: str, said: dict[str, str], expected: str
) -> None:
    folder = write_surface(tmp_path / "wall", surface, calibration, **said)
    assert read_real_scene(folder, SIZE).lights_are == expected


def test_what_cannot_be_scored_is_named(tmp_path: Path, surface: SVBRDF) -> None:
    unknown = write_surface(tmp_path / "scenes" / "unknown", surface, "calib.json")
    (unknown / "calib.json").unlink()
    damaged = write_surface(tmp_path / "scenes" / "damaged", surface, "calib.json")
    (damaged / "02.png").write_bytes(b"no picture")
    mixed = write_surface(tmp_path / "scenes" / "mixed", surface, "calib.json")
    narrow = material(1, SIZE).map(lambda tensor: tensor[..., :40])
    (write_surface(tmp_path / "narrow", narrow, "calib.json") / "00.png").replace(mixed / "00.png")
    write_surface(tmp_path / "scenes" / "wall", surface, "calib.json")
    skipped: dict[str, str] = {}
    read = list(read_real_scenes(tmp_path / "scenes", SIZE, None, skipped))
    assert [one.name for one in read] == ["wall"]
    assert "where its lights were" in skipped["unknown"]
    assert "02.png" in skipped["damaged"]
    assert "several sizes" in skipped["mixed"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="holds no folders"):
        list_real_scenes(tmp_path / "empty")


def test_one_photo_leaves_nothing_to_compare(tmp_path: Path, surface: SVBRDF) -> None:
    folder = write_surface(tmp_path / "wall", surface, "calib.json")
    for number in (1, 2, 3):
        (folder / f"{number:02}.png").unlink()
    facts = {"im_size": WIDTH, "camera_pos": PLACES[:1]}
    (folder / "calib.json").write_text(json.dumps(facts), encoding="utf-8")
    with pytest.raises(DataError, match="one photo"):
        read_real_scene(folder, SIZE)


class Spy(Refiner):
    """Remembers what it was given."""

    def fit(self, img, *, light=None, **options):
        self.given = (img, light)
        return super().fit(img, light=light, **options)


def test_refinement_is_given_photo_and_light(scene: RealScene) -> None:
    refiner = Spy(FakeModel(), "paper", camera=CAMERA, resolution=SIZE)
    found = real_estimator({"grey": refiner}, 60)(scene)
    assert list(found) == ["grey, initialization", "grey, paper, 60 iterations"]
    assert not torch.equal(*(estimate.svbrdf.diffuse for estimate in found.values()))
    photo, light = refiner.given
    assert photo is scene.photo
    assert torch.equal(light.position, scene.light.position)
    assert (light.falloff, light.intensity.tolist()) == ("inverse_square", [[1.0, 1.0, 1.0]])
    assert list(real_estimator({"grey": refiner}, 0)(scene)) == ["grey, initialization"]


def test_refinement_under_a_light_as_bright_as_needed_leaves_brightness_alone(
    scene: RealScene, surface: SVBRDF
) -> None:
    def brighter(photo: torch.Tensor) -> tuple[SVBRDF, PointLight]:
        whole = surface.map(lambda tensor: torch.nn.functional.interpolate(tensor, size=photo.shape[-2:]))
        return whole, PointLight.at((0.0, 0.0, 2.0))

    refiner = Spy(brighter, "paper", camera=CAMERA, resolution=SIZE)
    first, refined = real_estimator({"true": refiner}, 40, match_exposure=True)(scene).values()
    assert refiner.given[1].intensity[0, 0] == pytest.approx(exposure(first.svbrdf, scene))
    darkened = real_estimator({"true": refiner}, 40)(scene)["true, paper, 40 iterations"]
    change, drop = (
        float((first.svbrdf.diffuse - other.svbrdf.diffuse).mean()) for other in (refined, darkened)
    )
    assert abs(change) < 0.2 * drop


def test_uncertain_lights_stand_apart() -> None:
    score = RealScore("a", "x", "measured", "00.jpg", 2.0, 1.0, 0.1, 0.3, 1.0)
    scored = [
        score,
        replace(score, scene="y", lights_are="estimated", rendering=0.3),
        replace(score, scene="z", lights_are="uncertain", rendering=0.5),
    ]
    rows = {row["scenes"]: row for row in RealResults(scored).rows()}
    assert {name: row["count"] for name, row in rows.items()} == {
        "lights known": 2,
        "lights uncertain": 1,
        "all": 3,
    }
    assert rows["lights known"]["rendering"] == pytest.approx(0.2)
    assert rows["all"]["rendering"] == pytest.approx(0.3)
    assert [row["scenes"] for row in RealResults(scored[:1]).rows()] == ["lights known", "all"]


def test_evaluation_prefers_the_truth(tmp_path: Path, surface: SVBRDF) -> None:
    write_surface(tmp_path / "wall", surface, "calib.json")

    def methods(scene: RealScene) -> dict[str, Estimate]:
        return {"truth": Estimate(surface, 0.5), "grey": Estimate(grey(scene.photo.linear), 0.1)}

    results = evaluate_real(methods, tmp_path, SIZE)
    truth, plain = results.scored
    assert truth.rendering < 0.2 * plain.rendering
    assert truth.angle == pytest.approx(3.44, abs=0.01)  # atan(hypot(0.5, 0.6) / 13)
    assert "| wall | measured | 01.png, 3 degrees | truth |" in real_markdown(results)


def run(*arguments: str):
    return CliRunner().invoke(cli.main, ["real", "--size", "64", *arguments])


def test_the_command_compares_checkpoints(tmp_path: Path, surface: SVBRDF, no_network: None) -> None:
    folder = tmp_path / "surfaces"
    write_surface(folder / "wall", surface, "calib.json")
    write_surface(folder / "floor", material(5, 70), "calib_fitted.json", reliability="uncertain")
    files = ["--json", str(tmp_path / "t.json"), "--markdown", str(tmp_path / "t.md")]
    chosen = ["--init", "one", "--init", "two", "--recipe", "paper", "--iters", "6"]
    result = run(str(folder), *chosen, *files)
    assert result.exit_code == 0, result.output
    table = (tmp_path / "t.md").read_text(encoding="utf-8")
    assert result.stdout == table
    for part in ("Photos of surfaces", "64 px", "one, two", "seed 0", "commit", "two, paper, 6 iterations"):
        assert part in table
    plain = json.loads((tmp_path / "t.json").read_text())
    assert len(plain["scenes"]) == 8
    assert {row["scenes"]: row["count"] for row in plain["rows"]} == {
        "lights known": 1,
        "lights uncertain": 1,
        "all": 2,
    }
    assert all(row["lpips"] > 0.0 for row in plain["rows"])


def test_mistakes_are_one_sentence_and_exit_2(tmp_path: Path, no_network: None) -> None:
    for arguments in ([str(tmp_path / "nowhere")], [str(tmp_path)], [str(tmp_path), "--recipe", "soup"]):
        result = run(*arguments)
        assert result.exit_code == console.BAD_USAGE
        assert result.stderr.count("\n") == 1
        assert result.stdout == ""


def test_a_scene_without_lights_is_named_and_exit_3(
    tmp_path: Path, surface: SVBRDF, no_network: None
) -> None:
    write_surface(tmp_path / "wall", surface, "calib.json")
    (write_surface(tmp_path / "floor", surface, "calib.json") / "calib.json").unlink()
    result = run(str(tmp_path))
    assert result.exit_code == console.INCOMPLETE
    assert "skipped floor" in result.stderr
    assert "- floor: " in result.stdout
