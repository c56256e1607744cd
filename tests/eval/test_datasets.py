"""Test sets and the development table on small sets written by the test."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from eval import cli, development
from eval.datasets import (
    INPUT_LIGHT,
    Protocol,
    Scene,
    list_scenes,
    novel_lights,
    pbr_scenes,
    spread,
    strip_scenes,
    to_square,
)
from eval.development import STRIPS, STRIPS_MEAN, Estimate, evaluate, evaluate_predictor, markdown
from nets.data.images import DataError
from nets.render import PointLight, render
from refine.refiner import Refiner
from tests.eval_files import FakeModel, grey, material

SMALL = Protocol(size=64, lights=3)


def test_a_scene_is_a_legal_material_and_the_photo_of_it(data: Path) -> None:
    scenes = list(strip_scenes(data / STRIPS[0].folder, SMALL))
    assert [scene.name for scene in scenes] == ["scene_0", "scene_1", "scene_2"]
    scene = scenes[0]
    scene.truth.validate()
    assert scene.truth.size == (64, 64)
    assert scene.lights.position.shape == (3, 3)
    expected = render(scene.truth, PointLight.at(INPUT_LIGHT)).clamp(max=1.0)
    torch.testing.assert_close(scene.photo, expected)
    assert scene.photo_light is not None
    assert scene.photo_light.position.tolist() == [pytest.approx([0.0, 0.0, 2.14])]
    # 8-bit storage and the area average of a smooth material cost little.
    torch.testing.assert_close(
        scene.truth.diffuse, to_square(material(0).diffuse, 64), atol=0.5 / 255 + 1e-4, rtol=0
    )


def test_the_stored_photo_is_an_option_and_linear(data: Path) -> None:
    scene = next(iter(strip_scenes(data / STRIPS[0].folder, Protocol(size=64, stored_input=True))))
    assert float(scene.photo.mean()) == pytest.approx(0.5, abs=2e-3)
    assert scene.photo_light is None
    without = next(iter(strip_scenes(data / STRIPS[1].folder, Protocol(size=64, stored_input=True))))
    assert without.photo_light is not None


def test_every_method_and_subset_sees_the_same_lights(data: Path) -> None:
    folder = data / STRIPS[0].folder
    every = {s.name: s.lights.position for s in strip_scenes(folder, Protocol(size=64))}
    subset = list(strip_scenes(folder, SMALL, count=1))
    assert [s.name for s in subset] == ["scene_1"]
    assert torch.equal(subset[0].lights.position, every["scene_1"][:3])
    assert not torch.equal(every["scene_0"], every["scene_1"])
    assert not torch.equal(novel_lights(0, seed=1).position, novel_lights(0, seed=0).position)


def test_novel_lights_are_the_yardsticks() -> None:
    position = torch.cat([novel_lights(index).position for index in range(50)])
    assert position.shape == (1000, 3)
    distance = torch.linalg.vector_norm(position, dim=1)
    assert float(distance.min()) == pytest.approx(1.5, abs=1e-5)
    assert float(distance.max()) == pytest.approx(8.0, abs=1e-4)
    assert float((position[:, 2] / distance).min()) > np.cos(np.radians(45.0)) - 1e-5


def test_pbr_folders_are_scenes(data: Path) -> None:
    scenes = list(pbr_scenes(data / "materials" / "dev", SMALL))
    assert [scene.name for scene in scenes] == ["brick", "wood"]
    scenes[0].truth.validate()
    assert float(scenes[0].truth.diffuse.mean()) == pytest.approx(0.503, abs=2e-3)  # sRGB 188 decoded


def test_to_square_crops_the_centre_and_averages_areas() -> None:
    image = torch.arange(12.0).reshape(1, 1, 1, 12).expand(1, 1, 6, 12)
    assert to_square(image, 2)[0, 0, 0].tolist() == pytest.approx([4.0, 7.0])


@pytest.mark.parametrize(
    ("total", "count", "expected"), [(9, 3, [1, 4, 7]), (3, None, [0, 1, 2]), (2, 5, [0, 1])]
)
def test_spread(total: int, count: int | None, expected: list[int]) -> None:
    assert spread(total, count) == expected


def test_an_unreadable_scene_raises_or_is_named_and_skipped(data: Path) -> None:
    folder = data / STRIPS[0].folder
    (folder / "scene_1.png").write_text("not an image")
    with pytest.raises(DataError, match=r"scene_1\.png"):
        list(strip_scenes(folder, SMALL))
    skipped = {}
    names = [s.name for s in strip_scenes(folder, SMALL, skip=lambda name, e: skipped.update({name: str(e)}))]
    assert names == ["scene_0", "scene_2"]
    assert list(skipped) == ["scene_1"]


def test_a_missing_or_empty_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere is not a folder"):
        list_scenes(tmp_path / "nowhere", "strips")
    with pytest.raises(DataError, match="holds no folders of maps"):
        list_scenes(tmp_path, "pbr")


def test_evaluate_predictor_averages_the_two_folders(data: Path) -> None:
    found = evaluate_predictor(grey, data, scenes=2, lights=2, size=64, lpips=False)
    assert set(found) == {"des18_dev", "des19_dev", "mean"}
    both = (found["des18_dev"]["rendering"] + found["des19_dev"]["rendering"]) / 2
    assert found["mean"]["rendering"] == pytest.approx(both)
    assert found["mean"]["rendering"] > 0.05
    assert np.isnan(found["mean"]["lpips"])
    assert evaluate_predictor(grey, data, scenes=1, lights=1, size=64)["mean"]["lpips"] > 0.05


def test_a_perfect_method_scores_zero_and_a_constant_does_not(data: Path) -> None:
    def methods(scene: Scene) -> dict[str, Estimate]:
        return {"truth": Estimate(scene.truth, 1.0), "grey": Estimate(grey(scene.photo), 3.0)}

    results = evaluate(methods, data, protocol=SMALL)
    rows = {(row["method"], row["set"]): row for row in results.rows()}
    assert rows["truth", STRIPS_MEAN]["rendering"] == 0.0
    assert rows["truth", STRIPS_MEAN]["scenes"] == 6
    assert rows["grey", "materials_dev"]["scenes"] == 2
    assert rows["grey", "des19_dev"]["seconds"] == 3.0
    assert rows["grey", "des19_dev"]["roughness"] > 0.05


@pytest.fixture
def run(no_network: None):
    def invoke(*arguments: str):
        return CliRunner().invoke(cli.main, ["development", "--size", "64", "--lights", "2", *arguments])

    return invoke


def test_the_command_prints_and_writes_the_table(data: Path, tmp_path: Path, run) -> None:
    files = ["--json", str(tmp_path / "t.json"), "--markdown", str(tmp_path / "t.md")]
    result = run("--data", str(data), "--recipe", "paper", "--iters", "6", "--scenes", "1", *files)
    assert result.exit_code == 0, result.output
    table = (tmp_path / "t.md").read_text(encoding="utf-8")
    assert table in result.stdout
    for part in (
        "des18_dev, des19_dev, materials_dev",
        "64 px",
        "2 novel lights",
        "seed 0",
        "commit",
        STRIPS_MEAN,
    ):
        assert part in table
    plain = json.loads((tmp_path / "t.json").read_text())
    assert {row["method"] for row in plain["rows"]} == {"initialization", "paper, 6 iterations"}
    by_method = {row["method"]: row for row in plain["rows"] if row["set"] == STRIPS_MEAN}
    assert by_method["paper, 6 iterations"]["rendering"] != by_method["initialization"]["rendering"]
    assert len(plain["scenes"]) == 6


def test_the_known_light_is_passed_unless_withheld(data: Path) -> None:
    seen = []

    class Spy(Refiner):
        def fit(self, img, *, light=None, **options):
            seen.append(light)
            return super().fit(img, light=light, **options)

    scene = next(iter(strip_scenes(data / STRIPS[0].folder, SMALL)))
    for withheld in (False, True):
        development.refinement_estimator(Spy(FakeModel()), 0, estimate_light=withheld)(scene)
    assert seen[0].position.tolist() == [pytest.approx(list(INPUT_LIGHT))]
    assert seen[1] is None


def test_clamped_pixels_are_given_as_saturated(data: Path) -> None:
    scene = next(iter(strip_scenes(data / STRIPS[0].folder, SMALL)))
    scene.photo[..., 0, 0] = torch.tensor([1.0, 0.5, 0.5])
    photo = development.as_photo(scene)
    assert not bool(photo.unsaturated[0, 0, 0, 0])
    assert bool(photo.unsaturated[0, 0, 1, 1]) == bool((scene.photo[..., 1, 1] < 1.0).all())


def test_missing_data_is_one_sentence_and_exit_2(tmp_path: Path, run) -> None:
    result = run("--data", str(tmp_path))
    assert result.exit_code == 2
    assert result.stderr.strip().endswith("strips/des18_dev is not a folder")
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""


def test_an_unknown_recipe_is_one_sentence_and_exit_2(data: Path, run) -> None:
    result = run("--data", str(data), "--recipe", "soup")
    assert result.exit_code == 2
    assert "soup" in result.stderr


def test_an_unreadable_scene_is_named_and_exit_3(data: Path, run) -> None:
    (data / STRIPS[1].folder / "scene_2.png").write_bytes(b"")
    result = run("--data", str(data))
    assert result.exit_code == 3
    assert "skipped des19_dev/scene_2" in result.stderr
    assert "des19_dev/scene_2" in result.stdout
    assert "| des19_dev | 2 |" in result.stdout


def test_markdown_leaves_a_gap_for_a_set_without_scenes(data: Path) -> None:
    for path in (data / STRIPS[0].folder).iterdir():
        path.write_bytes(b"")
    results = evaluate(lambda s: {"grey": Estimate(grey(s.photo), 0.0)}, data, STRIPS, SMALL)
    assert "| grey | des18_dev | 0 | - |" in markdown(results)
    assert STRIPS_MEAN not in markdown(results)
