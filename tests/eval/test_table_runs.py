"""Whole tables from tiny networks: resumed, shared among processes, with gaps, and recomputed in numpy."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from eval import console, table_runs
from eval.cli import main
from eval.datasets import Protocol, novel_lights, strip_scenes
from eval.development import as_photo
from eval.ledger import Ledger
from eval.methods import choose, find_weights
from eval.table_runs import Bench, Trial, measure, together
from eval.yardsticks import Real, Synthetic
from nets.data.strips import write_strip
from refine.refiner import Refiner
from tests.eval.test_metrics import numpy_scores
from tests.eval_files import material, write_pbr, write_strips, write_surface

SIZE = 64
ROWS = ("Ours_syn", "Ours_syn+")


@pytest.fixture(autouse=True)
def surroundings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Keep caches out of the user's, and torch's threads as they were."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def strips(tmp_path: Path) -> Path:
    return write_strips(tmp_path / "tiles", 2)


@pytest.fixture
def run(tmp_path: Path, tiny: Path):
    def invoke(*arguments: str, rows: tuple[str, ...] = ROWS):
        inits = [part for row in rows for part in ("--init", f"{row}={tiny}")]
        base = [arguments[0], "--size", str(SIZE), "--out", str(tmp_path / "out"), *inits]
        return CliRunner().invoke(main, [*base, "--rows", ",".join(rows), *arguments[1:]])

    return invoke


def few(folder: Path) -> Synthetic:
    return Synthetic(folder, Protocol(size=SIZE, lights=2))


def rows_of(tiny: Path):
    return find_weights(choose(ROWS), dict.fromkeys(ROWS, str(tiny)))[0]


def test_figures_of_a_table_are_those_of_an_independent_script(
    run, tiny: Path, strips: Path, tmp_path: Path
) -> None:
    result = run("table1", "--set", str(strips), "--lights", "2")
    assert result.exit_code == 0, result.output
    with (tmp_path / "out" / "table1_tiles.csv").open(encoding="utf-8") as file:
        found = {row["row"]: row for row in csv.DictReader(file)}
    heads = {"N": "normal", "D": "diffuse", "R": "roughness", "S": "specular", "Ren": "rendering"}
    for row, iterations in (("Ours_syn", 0), ("Ours_syn+", None)):
        scores = []
        for index, scene in enumerate(strip_scenes(strips, Protocol(size=SIZE))):
            fit = Refiner(tiny, "paper", resolution=SIZE).fit(
                as_photo(scene), light=scene.photo_light, iters=iterations
            )
            lights = novel_lights(index).position[:2].double().numpy()
            scores.append(numpy_scores(fit.svbrdf, scene.truth, lights))
        for head, name in heads.items():
            expected = np.mean([score[name] for score in scores])
            assert float(found[row][head]) == pytest.approx(expected, abs=1e-4), (row, head)


def test_a_second_run_computes_what_is_missing_only(
    run, strips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = []
    attempt = Bench.attempt
    monkeypatch.setattr(Bench, "attempt", lambda self, trial: done.append(trial) or attempt(self, trial))
    first = run("table1", "--set", str(strips), "--lights", "2", "--scenes", "1")
    assert len(done) == 2
    ledger = tmp_path / "out" / "table1.jsonl"
    lines = ledger.read_text(encoding="utf-8").splitlines(keepends=True)
    again = run("table1", "--set", str(strips), "--lights", "2", "--scenes", "1")
    assert len(done) == 2
    assert again.stdout == first.stdout

    ledger.write_text(lines[0] + lines[1][:90], encoding="utf-8")  # killed while it wrote
    mended = run("table1", "--set", str(strips), "--lights", "2", "--scenes", "1")
    assert [trial.row for trial in done[2:]] == [json.loads(lines[1])["key"]["row"]]
    assert mended.exit_code == 0
    assert len(ledger.read_text(encoding="utf-8").splitlines()) == 3

    for change in (["--seed", "1"], ["--lights", "3"], ["--estimate-light"], ["--no-flips"]):
        before = len(done)
        run("table1", "--set", str(strips), "--lights", "2", "--scenes", "1", *change, rows=ROWS[:1])
        assert len(done) == before + 1, change


def test_everything_a_score_depends_on_is_in_its_key(strips: Path, tiny: Path) -> None:
    key, other = few(strips).key(0), few(strips).key(1)
    assert key["scene"] == "scene_0"
    write_strip(strips / "scene_0.png", material(7))
    assert few(strips).key(0) != key
    assert few(strips).key(1) == other
    write_strip(strips / "another.png", material(0))
    assert few(strips).key(2)["scene"] == "scene_1"
    assert few(strips).key(2) != other  # lights are those of the place in the set


def test_workers_change_nothing(strips: Path, tiny: Path, tmp_path: Path) -> None:
    torch.set_num_threads(1)
    yardstick, rows = few(strips), rows_of(tiny)
    alone = measure(yardstick, rows, [0, 1], Ledger(tmp_path / "one.jsonl"), 1)
    told: list[str] = []
    shared = measure(yardstick, rows, [0, 1], Ledger(tmp_path / "two.jsonl"), 2, told.append)
    assert list(shared.results) == list(alone.results)
    assert len(told) == 4
    for place, result in alone.results.items():
        assert result | {"seconds": 0} == shared.results[place] | {"seconds": 0}
    again = measure(yardstick, rows, [0, 1], Ledger(tmp_path / "two.jsonl"), 2)
    assert again == shared


def test_gaps_are_named_and_the_rest_is_done(run, strips: Path, tmp_path: Path, tiny: Path) -> None:
    (strips / "scene_1.png").write_bytes(b"no picture")
    result = run(
        "table1", "--set", str(strips), "--set", str(tmp_path / "nowhere"), "--lights", "2",
        "--init", "Des18=nothing", rows=("Ours_syn",),
    )  # fmt: skip
    assert result.exit_code == console.INCOMPLETE
    assert "skipped scene_1" in result.stderr
    assert "nowhere is not a folder" in result.stderr
    plain = json.loads((tmp_path / "out" / "table1_tiles.json").read_text())
    assert [(row["row"], row["scenes"]) for row in plain["rows"]] == [("Ours_syn", 1)]
    empty = json.loads((tmp_path / "out" / "table1_nowhere.json").read_text())
    assert "no test set" in empty["rows"][0]["gap"]

    result = run(
        "table1", "--set", str(strips), "--lights", "2", "--rows", "Des18", "--init", "Des18=nothing",
        rows=("Ours_syn",),
    )  # fmt: skip
    assert result.exit_code == console.INCOMPLETE
    assert "| Des18 | gap | - (0.065) |" in result.stdout
    assert "Des18: no weights: nothing" in result.stderr


def test_a_row_that_gives_nonsense_is_named(strips: Path, tiny: Path, tmp_path: Path, monkeypatch) -> None:
    def nonsense(self, scene, refined, lpips):
        if refined.recipe.iterations:
            raise ValueError("the estimate holds NaN or infinity")
        return {"seconds": 1.0}

    monkeypatch.setattr(Synthetic, "score", nonsense)
    found = measure(few(strips), rows_of(tiny), [0], Ledger(tmp_path / "one.jsonl"), 1)
    assert found.skipped == {"Ours_syn+ on scene_0": "the estimate holds NaN or infinity"}
    assert list(found.results) == [("Ours_syn", "scene_0")]


def test_the_built_in_set_and_pbr_folders(run, tmp_path: Path) -> None:
    write_pbr(tmp_path / "pbr" / "brick")
    result = run(
        "table1", "--set", "procedural-132", "--set", str(tmp_path / "pbr"), "--lights", "1", "--scenes", "1",
        rows=ROWS[:1],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    for part in (
        "procedural-132, 1 scenes",
        "held out",
        "64 px",
        "1 novel lights",
        "seed 0",
        "commit",
        "narrow",
    ):
        assert part in result.stdout
    lines = (tmp_path / "out" / "table1.jsonl").read_text().splitlines()
    assert [json.loads(line)["key"]["scene"] for line in lines] == ["knit_fabric_00", "brick"]


def test_table_2(run, tmp_path: Path) -> None:
    for seed, (name, calibration) in enumerate((("wall", "calib.json"), ("floor", "calib_fitted.json"))):
        write_surface(tmp_path / "photos" / name, material(seed, 48), calibration)
    result = run("table2", "--set", str(tmp_path / "photos"))
    assert result.exit_code == 0, result.output
    plain = json.loads((tmp_path / "out" / "table2_photos.json").read_text())
    lines = [json.loads(line) for line in (tmp_path / "out" / "table2.jsonl").read_text().splitlines()]
    wall = {e["key"]["row"]: e["result"] for e in lines if e["key"]["scene"] == "wall"}
    for row in plain["rows"]:
        assert row["scenes"] == 2
        assert row["means"]["LPIPS"] == pytest.approx(wall[row["row"]]["lpips"])  # the floor's are uncertain
        assert row["means"]["LPIPS"] != row["means"]["LPIPS, all scenes"]
        assert row["paper"].keys() == {"LPIPS", "RMSE"}
    assert wall["Ours_syn"]["rendering"] != wall["Ours_syn+"]["rendering"]


def test_lights_and_exposure_are_in_the_key_of_real_scenes(tmp_path: Path) -> None:
    folder = write_surface(tmp_path / "photos" / "wall", material(3, 48), "calib.json").parent
    keys = [Real(folder).key(0), Real(folder, match_exposure=True).key(0), Real(folder, seed=1).key(0)]
    (folder / "wall" / "calib.json").write_text("{}", encoding="utf-8")
    keys.append(Real(folder).key(0))
    assert len({json.dumps(key, sort_keys=True) for key in keys}) == len(keys)


def test_mistakes_are_one_sentence_and_exit_2(run, strips: Path, tmp_path: Path) -> None:
    for arguments in (
        ("table1", "--rows", "Nobody"),
        ("table1", "--init", "Ours_syn"),
        ("table1", "--set", str(strips), "--set", f"{strips}/"),
        ("table2", "--set", str(strips), "--lights", str(tmp_path / "none.json")),
    ):
        result = run(*arguments)
        assert result.exit_code == console.BAD_USAGE, arguments
        assert result.stderr.startswith("refine-eval: ")
        assert len(result.stderr.splitlines()) == 1


def test_quick_takes_eight_and_three(run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    counts = []
    monkeypatch.setattr(
        table_runs, "_attempts", lambda yardstick, rows, trials, workers: counts.append(trials) or []
    )
    run("table1", "--quick", rows=ROWS[:1])
    for number in range(5):
        write_surface(tmp_path / "photos" / f"wall_{number}", material(3, 48), "calib.json")
    run("table2", "--quick", "--set", str(tmp_path / "photos"), rows=ROWS[:1])
    run("table2", "--quick", "--scenes", "2", "--set", str(tmp_path / "photos"), rows=ROWS[:1])
    assert [len(trials) for trials in counts] == [8, 3, 2]


@pytest.mark.parametrize("names", [("Gao19", "Ours_syn", "Gao19+"), ("Des19", "Gao19", "Ours_syn+")])
def test_rows_that_begin_with_one_search_are_asked_together(names: tuple[str, ...], tiny: Path) -> None:
    """Others alone, so that a table is shared out as finely as it can be, and nothing twice."""
    inits = {"Ours_syn": str(tiny), "Ours_syn+": str(tiny)}
    rows = find_weights(choose(names), inits)[0]
    trials = [Trial(row.method.name, index) for index in (4, 7) for row in rows]
    parts = together(rows, trials)
    assert sorted(trials, key=str) == sorted((trial for part in parts for trial in part), key=str)
    latent = [name for name in names if name.startswith("Gao19")]
    for index in (4, 7):
        assert [Trial(name, index) for name in latent] in parts
    assert all(len(part) == 1 for part in parts if not part[0].row.startswith("Gao19"))
