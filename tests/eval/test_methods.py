"""The registry of rows: whose figures, whose weights, and what is missing."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import pytest
import torch

from eval.datasets import CAMERA
from eval.methods import METHODS, QUICK_LATENT, choose, find_weights, note_of_quick, parse_inits
from nets import checkpoint
from nets.baselines.des19 import Des19, Des19Config
from nets.checkpoint import Record, save_model
from nets.ensemble import FlipAverage
from tests.eval_files import write_autoencoder, write_checkpoint


def test_rows_are_those_of_the_paper_in_its_order() -> None:
    table = ["Des18", "Des19", "Gao19", "Ours_syn", "Ours_hyb", "Gao19+", "Ours_syn+", "Ours_hyb+"]
    assert list(METHODS) == [*table, "Ours_l1", "Ours_no_render", "Ours_hyb default"]
    assert all(len(METHODS[name].table1) == 6 and len(METHODS[name].table2) == 2 for name in table)
    recipes = {name: method.recipe for name, method in METHODS.items() if method.recipe}
    latent = {"Gao19": "gao", "Gao19+": "gao+"}
    assert recipes == {**latent, "Ours_syn+": "paper", "Ours_hyb+": "paper", "Ours_hyb default": "default"}
    assert {METHODS[name].checkpoint for name in ("Des19", *latent)} == {"des19"}


def test_figures_of_the_paper() -> None:
    # The columns of Table 1 added up from the printed page, not from the code.
    sums = {"normal": 0.511, "diffuse": 0.5, "roughness": 0.993, "specular": 0.63, "rendering": 0.595}
    rows = list(METHODS.values())[:8]
    for score, total in {**sums, "lpips": 1.64}.items():
        assert sum(row.table1[score] for row in rows) == pytest.approx(total, abs=1e-9)
    assert sum(row.table2["lpips"] for row in rows) == pytest.approx(2.526, abs=1e-9)
    assert sum(row.table2["rendering"] for row in rows) == pytest.approx(1.09, abs=1e-9)
    assert METHODS["Ours_hyb+"].table2 == {"lpips": 0.256, "rendering": 0.119}
    assert METHODS["Ours_l1"].table1 == {"rendering": 0.073, "lpips": 0.236}


def test_rows_are_chosen_by_name_in_the_order_of_the_table() -> None:
    assert [method.name for method in choose(["Ours_l1", "Des18"])] == ["Des18", "Ours_l1"]
    assert [method.name for method in choose(None)] == list(METHODS)
    with pytest.raises(ValueError, match=r"no row is called 'Ours'; .*Ours_syn"):
        choose(["Ours"])


def test_inits() -> None:
    assert parse_inits(["Ours_syn=a=b.pth", "Gao19+=x"]) == {"Ours_syn": "a=b.pth", "Gao19+": "x"}
    for text in ("Ours_syn", "Ours_syn=", "Nobody=x"):
        with pytest.raises(ValueError, match=re.escape(text.partition("=")[0])):
            parse_inits([text])


def test_weights_are_found_or_missed_by_name(tmp_path: Path) -> None:
    tiny = write_checkpoint(tmp_path / "tiny.safetensors")
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(b"none")
    inits = {"Ours_syn": str(tiny), "Ours_syn+": str(tiny), "Ours_hyb": str(damaged), "Des18": "nowhere"}
    rows, gaps = find_weights(choose(list(inits)), inits)
    assert [row.method.name for row in rows] == ["Ours_syn", "Ours_syn+"]
    assert set(gaps) == {"Ours_hyb", "Des18"}
    assert "damaged.safetensors" in gaps["Ours_hyb"]
    assert "nowhere" in gaps["Des18"]

    plain, refined = (row.settings() for row in rows)
    assert plain["checkpoint"] == refined["checkpoint"]
    assert plain["recipe"] is None
    assert refined["recipe"].startswith("paper ")
    other = write_checkpoint(tmp_path / "tiny.safetensors", seed=1)
    (changed,), _ = find_weights(choose(["Ours_syn"]), {"Ours_syn": str(other)})
    assert changed.settings()["checkpoint"] != plain["checkpoint"]


def test_a_row_makes_its_refiner(tmp_path: Path) -> None:
    tiny = str(write_checkpoint(tmp_path / "tiny.safetensors"))
    (row,), _ = find_weights(choose(["Ours_hyb default"]), {"Ours_hyb default": tiny})
    refiner = row.refiner(CAMERA, 64, 3, flips=True)
    assert isinstance(refiner.model, FlipAverage)
    assert (refiner.recipe.name, refiner.resolution, refiner.seed) == ("default", 64, 3)
    assert not isinstance(row.refiner(CAMERA, 64, 3, flips=False).model, FlipAverage)
    assert refiner.fit(torch.rand(3, 64, 64), iters=0).svbrdf.size == (64, 64)


def test_gao19_is_a_search_from_des19_in_the_space_of_its_own_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint, "WEIGHTS", tmp_path)
    torch.manual_seed(0)
    des19 = Des19(Des19Config(width=2, levels=3, deep_multiplier=2))
    save_model(tmp_path / "des19.safetensors", des19, Record(des19.config))
    methods = choose(["Des19", "Gao19", "Gao19+"])
    rows, gaps = find_weights(methods)
    assert [row.method.name for row in rows] == ["Des19"]
    assert "gao19: no such checkpoint" in gaps["Gao19"]
    assert "gao19: no such checkpoint" in gaps["Gao19+"]

    settings = []
    for seed in (0, 1):
        write_autoencoder(tmp_path / "gao19.safetensors", seed)
        rows, gaps = find_weights(methods)
        assert not gaps
        settings.append([row.settings() for row in rows])
    assert settings[0][0] == settings[1][0]
    assert settings[0][1] != settings[1][1]
    assert not any(row.shortened for row in rows)

    quick, _ = find_weights(methods, quick=True)
    assert [row.shortened for row in quick] == [False, True, True]
    assert note_of_quick(quick) == f"Quick: Gao19, Gao19+ with {QUICK_LATENT} steps in latent space only. "
    assert note_of_quick(rows) == ""
    des19_file, gao19_file = (
        f"{file.name} {hashlib.sha256(file.read_bytes()).hexdigest()[:8]}"
        for file in (tmp_path / "des19.safetensors", tmp_path / "gao19.safetensors")
    )
    assert [row.sources() for row in rows[:2]] == [
        f"Des19 {des19_file}", f"Gao19 {des19_file} + {gao19_file}",
    ]  # fmt: skip
    assert quick[1].settings() != rows[1].settings()
    assert [[stage.iterations for stage in row.recipe.stages] for row in quick if row.recipe] == [
        [QUICK_LATENT], [QUICK_LATENT, 200],
    ]  # fmt: skip
    assert quick[1].refiner(CAMERA, 64, 0, flips=True).recipe == quick[1].recipe
