"""`refine-train`: what it is asked, what it draws, and tiny trainings from end to end."""

from __future__ import annotations

import json
import math
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from typer.testing import CliRunner

from nets.architectures import kind_of
from nets.checkpoint import load_model, load_network, read_record
from nets.data.augment import Augmentation
from nets.data.materials import PoolMaterials
from nets.data.pairs import PhotoPairs
from nets.data.photography import FlashPhotography
from nets.data.pool import MaterialPool
from nets.generator import GeneratorConfig
from nets.render import render
from nets.svbrdf import MAPS
from refine import Refiner, train
from refine.train import STATE, batch_source
from refine.training_watch import SHEET_MATERIALS
from tests.helpers import assert_close, seeded
from tests.training_files import (
    GENERATOR,
    STAGES,
    entry,
    write_pairs,
    write_plan,
    write_pool,
    write_strips,
)

Command = Callable[..., tuple[int, str]]
SHARES = {"procedural": 0.5, "pbr": 0.3, "infinigen": 0.2}


@pytest.fixture(autouse=True)
def _threads() -> Iterator[None]:
    """Give torch its threads back: the command sets them."""
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def pool(tmp_path_factory: pytest.TempPathFactory) -> Path:
    entries = [entry(f"brick_{seed}", "procedural", "brick", seed) for seed in range(20)]
    entries += [entry(f"infinigen__{seed}", "pbr", "infinigen", seed) for seed in range(20, 40)]
    return write_pool(tmp_path_factory.mktemp("pool") / "pool", entries)


@pytest.fixture(scope="module")
def strips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_strips(tmp_path_factory.mktemp("strips"), 4)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pairs(tmp_path_factory.mktemp("pairs"))


@pytest.fixture
def command(pool: Path, tmp_path: Path) -> Command:
    """Return the command line; it gives the exit code and what was said."""

    def run(*arguments: str | Path, data: Path = pool, out: str = "run") -> tuple[int, str]:
        asked = ["--data", data, "--out", tmp_path / out, "--accelerator", "cpu", *arguments]
        done = CliRunner().invoke(train.app, list(map(str, asked)))
        if done.exception is not None and not isinstance(done.exception, SystemExit):
            raise done.exception
        return done.exit_code, done.stderr

    return run


def lines_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def weights_of(folder: Path) -> dict[str, torch.Tensor]:
    return load_network(folder / "weights.safetensors").state_dict()


def flat(value: Any, name: str = "") -> dict[str, Any]:
    """Return every leaf of a state by its path."""
    if isinstance(value, list | tuple):
        value = dict(enumerate(value))
    if not isinstance(value, dict):
        return {name: value}
    return {k: v for key, item in value.items() for k, v in flat(item, f"{name}.{key}").items()}


def assert_same_training(first: Path, second: Path) -> None:
    """Compare shipped weights and full states, but for the seconds they took."""
    ours, theirs = weights_of(first), weights_of(second)
    assert all(torch.equal(theirs[name], value) for name, value in ours.items())
    states = [flat(torch.load(folder / STATE, weights_only=True)) for folder in (first, second)]
    assert states[0].keys() == states[1].keys()
    for name in states[0].keys() - {".seconds"}:
        a, b = (state[name] for state in states)
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b, name


# Batches


def test_a_batch_is_photos_of_the_materials_that_are_its_truth(pool: Path, pairs: Path) -> None:
    plain = FlashPhotography(exposure_share=0.0, falloff_share=0.0, noise_range=(0.0, 0.0))
    materials = PoolMaterials(MaterialPool(pool), SHARES)
    batch = batch_source(materials, Augmentation(), plain)(3, 16, seeded(1))
    assert batch.photo.shape == (3, 3, 16, 16)
    assert batch.truth.validate().size == (16, 16)
    assert batch.light.position.shape == (3, 3)
    assert float(batch.light.position[:, 2].min()) > 0.0
    rendered = render(batch.truth, batch.light, plain.camera).clamp(0.0, 1.0)
    assert_close(batch.photo ** (1 / 2.2), rendered ** (1 / 2.2), atol=0.5 / 255 + 1e-3, rtol=0.0)
    assert batch.pairs is None
    both = batch_source(materials, Augmentation(), plain, PhotoPairs(pairs, crop=16), 2)(3, 16, seeded(1))
    assert torch.equal(both.photo, batch.photo)
    assert both.pairs is not None
    assert both.pairs.a.shape == both.pairs.b.shape == (2, 3, 16, 16)


def test_the_same_generator_gives_the_same_batch(pool: Path, pairs: Path) -> None:
    source = batch_source(PoolMaterials(MaterialPool(pool)), pairs=PhotoPairs(pairs, crop=16), pair_count=2)
    first, again, other = (source(2, 16, seeded(seed)) for seed in (1, 1, 2))
    assert torch.equal(first.photo, again.photo)
    assert torch.equal(first.truth.channels(), again.truth.channels())
    assert torch.equal(first.light.position, again.light.position)
    assert first.pairs is not None
    assert again.pairs is not None
    assert torch.equal(first.pairs.a, again.pairs.a)
    assert torch.equal(first.pairs.b, again.pairs.b)
    assert not torch.equal(first.photo, other.photo)


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        (("procedural", "maker", "infinigen"), {"procedural": 0.5, "maker": 0.3, "infinigen": 0.2}),
        (("procedural", "infinigen"), {"procedural": 5 / 7, "infinigen": 2 / 7}),  # no other scans
        (("procedural", "maker"), {"procedural": 5 / 8, "maker": 3 / 8}),
        (("maker",), {"maker": 1.0}),
    ],
)
def test_shares_of_what_the_pool_lacks_are_left_out(
    kinds: tuple[str, ...], expected: dict[str, float], tmp_path: Path
) -> None:
    entries = [
        entry(f"{kind}__{seed}", "procedural" if kind == "procedural" else "pbr", kind, seed)
        for seed, kind in enumerate(kinds)
    ]
    draws, counted = 400, Counter[str]()

    class Watched(MaterialPool):
        """Counts what a large batch would hold."""

        def sample(self, *arguments: Any) -> torch.Tensor:
            drawn = super().sample(draws, *arguments[1:])
            for position, kind in enumerate(kinds):
                counted[kind] += int((drawn == self[position]).all(dim=3).all(dim=2).all(dim=1).sum())
            return drawn[: arguments[0]]

    opened = Watched(write_pool(tmp_path / "pool", entries, size=8))
    batch_source(PoolMaterials(opened, SHARES), Augmentation.none())(1, 8, seeded(0))
    assert sum(counted.values()) == draws
    found = {kind: count / draws for kind, count in counted.items()}
    assert found == pytest.approx(expected, abs=0.08)


# The command


def test_all_stages_from_pool_to_material(command: Command, pairs: Path, tmp_path: Path) -> None:
    plan = write_plan(
        tmp_path / "plan.yaml",
        STAGES["l1"],
        {**STAGES["syn"], "phases": [{"iterations": 2, "crop": 16, "batch": 1, "shards": 2}]},
        STAGES["hyb"],
        shares=SHARES,
        augmentation={"specular": 0.4},
        precision="bf16-mixed",
    )
    said = command("--config", plan, "--pairs", pairs, "--seed", "3", "--data-note", "bricks, Apache-2.0")
    assert said == (0, "")
    for name in ("l1", "syn", "hyb"):
        folder = tmp_path / "run" / name
        assert sorted(path.name for path in folder.iterdir()) == [
            "log.jsonl", "samples.png", STATE, "tensorboard", "weights.safetensors",
        ]  # fmt: skip
        assert any((folder / "tensorboard").iterdir())
        sheet = oiio.ImageBuf(str(folder / "samples.png")).spec()
        assert (sheet.width, sheet.height) == (6 * 16, 2 * SHEET_MATERIALS * 16)

    record = read_record(tmp_path / "run" / "syn" / "weights.safetensors")
    assert record.architecture == GeneratorConfig(**GENERATOR)
    assert record.data == ["bricks, Apache-2.0"]
    training = record.training
    assert (training["iterations"], training["samples"], training["processes"]) == (2, 4, 1)
    assert training["stage"] == "syn"
    assert training["config"]["phases"] == [{"iterations": 2, "crop": 16, "batch": 1, "shards": 2}]
    assert training["config"]["seed"] == 3
    assert training["shares"] == SHARES
    assert training["augmentation"]["specular"] == 0.4
    assert training["objective"]["maps"]["l1"] == 10.0
    assert training["photography"]["centred_share"] == FlashPhotography().centred_share
    assert training["precision"] == "bf16-mixed"
    json.dumps(training, allow_nan=False)

    validation = lines_of(tmp_path / "run" / "hyb")[-1]["validation"]
    judged = {*MAPS, "rendering", "real"}
    assert {f"{name} accuracy" for name in judged} <= set(validation)
    assert {"loss", "light", *judged} <= set(validation)
    assert all(math.isfinite(value) for value in validation.values())
    assert all(0.0 <= validation[f"{name} accuracy"] <= 1.0 for name in judged)

    network = load_model(tmp_path / "run" / "hyb" / "weights.safetensors")
    refined = Refiner(network).fit(torch.rand(3, 16, 16, generator=seeded(0)) * 0.5, iters=2)
    refined.svbrdf.validate()


def test_a_training_on_strips_names_the_bad_ones(command: Command, strips: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(strips, tmp_path / "strips")
    whole = (folder / "000.png").read_bytes()
    (folder / "broken.png").write_bytes(whole[:-30])
    plan = write_plan(tmp_path / "plan.yaml", STAGES["syn"])
    code, said = command("--config", plan, data=folder)
    assert code == 0
    assert said == f"refine-train: skipped: {folder / 'broken.png'} is truncated\n"
    assert read_record(tmp_path / "run" / "syn" / "weights.safetensors").training["iterations"] == 4


def test_a_stage_starts_from_the_networks_of_the_one_before(command: Command, tmp_path: Path) -> None:
    phases = [{"iterations": 1, "crop": 16, "batch": 1}]
    still = {
        **STAGES["syn"],
        "phases": phases,
        "trainer": {"learning_rate": 1e-12, "final_learning_rate": 0.0},
    }
    plan = write_plan(tmp_path / "plan.yaml", STAGES["l1"], still)
    assert command("--config", plan) == (0, "")
    first, second = (torch.load(tmp_path / "run" / n / STATE, weights_only=True) for n in ("l1", "syn"))
    assert second["iteration"] == 1
    for name, value in first["network"].items():
        assert_close(second["network"][name], value, atol=1e-6)

    # The same, one stage after the other, and from a state of elsewhere.
    assert command("--config", plan, "--stage", "l1", out="apart") == (0, "")
    assert command("--config", plan, "--stage", "syn", out="apart") == (0, "")
    assert_same_training(tmp_path / "run" / "syn", tmp_path / "apart" / "syn")
    start = ("--start", tmp_path / "apart" / "l1" / STATE)
    assert command("--config", plan, "--stage", "syn", *start, out="elsewhere") == (0, "")
    assert_same_training(tmp_path / "run" / "syn", tmp_path / "elsewhere" / "syn")

    # From a checkpoint alone, whose float16 weights are all there is of it.
    weights = tmp_path / "apart" / "l1" / "weights.safetensors"
    assert command("--config", plan, "--stage", "syn", "--start", weights, out="alone") == (0, "")
    alone = torch.load(tmp_path / "alone" / "syn" / STATE, weights_only=True)["network"]
    for name, value in load_network(weights).state_dict().items():
        assert_close(alone[name], value, atol=1e-6)
    # Behind it in the same run, with a part that is new.
    larger = {"kind": "generator", **GENERATOR, "revision_channels": 2}
    revise = {**still, "name": "revise", "network": larger, "parts": ["revision"]}
    both = write_plan(tmp_path / "both.yaml", STAGES["l1"], revise)
    assert command("--config", both, out="both") == (0, "")
    found = torch.load(tmp_path / "both" / "revise" / STATE, weights_only=True)["network"]
    assert any(name.startswith("revision.") for name in found)
    for name, value in first["network"].items():
        assert_close(found[name], value, atol=1e-6)
    other = write_plan(tmp_path / "other.yaml", STAGES["l1"], generator={**GENERATOR, "width": 3})
    code, said = command("--config", other, "--start", weights, out="other")
    assert (code, "is another network than the plan's" in said) == (2, True)


def test_resuming_goes_on_where_it_stopped(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stages = ({**STAGES["l1"], "phases": [{"iterations": 2, "crop": 8, "batch": 1}]}, STAGES["syn"])
    plan = ("--config", write_plan(tmp_path / "plan.yaml", *stages), "--save-every", "3")
    assert command(*plan, out="whole")[0] == 0

    step, steps = train.Trainer.step, []

    def interrupted(self: train.Trainer) -> dict[str, float]:
        steps.append((self.config.iterations, self.iteration))
        if len(steps) == 6:
            raise KeyboardInterrupt
        return step(self)

    monkeypatch.setattr(train.Trainer, "step", interrupted)
    assert command(*plan, out="parts")[0] != 0
    assert read_record(tmp_path / "parts" / "syn" / "weights.safetensors").training["iterations"] == 3
    assert command(*plan, "--resume", out="parts")[0] == 0
    assert steps == [(2, 0), (2, 1), (4, 0), (4, 1), (4, 2), (4, 3), (4, 3)]
    for name in ("l1", "syn"):
        assert_same_training(tmp_path / "whole" / name, tmp_path / "parts" / name)


def test_steps_stop_a_training_as_if_interrupted(command: Command, tmp_path: Path) -> None:
    plan = ("--config", write_plan(tmp_path / "plan.yaml", STAGES["l1"], STAGES["syn"]))
    assert command(*plan, out="whole") == (0, "")
    assert command(*plan, "--steps", "3", out="parts") == (0, "")
    assert not (tmp_path / "parts" / "syn").exists()
    for count in (3, 1):
        assert command(*plan, "--steps", str(count), "--resume", out="parts") == (0, "")
    done = {name: torch.load(tmp_path / "parts" / name / STATE, weights_only=True) for name in ("l1", "syn")}
    assert [done[name]["iteration"] for name in ("l1", "syn")] == [4, 3]
    assert command(*plan, "--resume", out="parts") == (0, "")
    assert_same_training(tmp_path / "whole" / "syn", tmp_path / "parts" / "syn")


def test_the_baselines_train_each_from_its_own_start_and_resume(command: Command, tmp_path: Path) -> None:
    names = ("des18", "des19", "gao19")
    plan = ("--config", write_plan(tmp_path / "plan.yaml", *(STAGES[name] for name in names)))
    assert command(*plan, out="whole") == (0, "")
    assert command(*plan, "--stage", "gao19", out="alone") == (0, "")
    assert_same_training(tmp_path / "whole" / "gao19", tmp_path / "alone" / "gao19")
    assert command(*plan, "--steps", "10", out="parts") == (0, "")
    assert command(*plan, "--resume", out="parts") == (0, "")
    for name in names:
        assert_same_training(tmp_path / "whole" / name, tmp_path / "parts" / name)
        record = read_record(tmp_path / "whole" / name / "weights.safetensors")
        assert kind_of(record.architecture) == STAGES[name]["network"]["kind"]
        sheet = oiio.ImageBuf(str(tmp_path / "whole" / name / "samples.png")).spec()
        assert sheet.width == 6 * STAGES[name]["phases"][0]["crop"]
    assert set(lines_of(tmp_path / "whole" / "gao19")[-1]["validation"]) == {"loss", "rendering", *MAPS}


def test_the_log_has_a_line_of_json_now_and_then(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "LOG_EVERY", 2)
    plan = write_plan(tmp_path / "plan.yaml", STAGES["syn"])
    assert command("--config", plan, "--save-every", "3")[0] == 0
    lines = lines_of(tmp_path / "run" / "syn")
    assert [(line["iteration"], "validation" in line) for line in lines] == [
        (2, False), (3, True), (4, False), (4, True),
    ]  # fmt: skip
    assert {"loss", "critics", *MAPS, "rendering", "light", "rendering accuracy"} <= set(lines[0])
    assert lines[0]["samples_per_second"] > 0.0


def test_held_out_figures_are_the_same_at_every_call(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures, validate = [], train.Watch.validate

    def twice(self: train.Watch, trainer: train.Trainer) -> dict[str, float]:
        figures.extend([validate(self, trainer), validate(self, trainer)])
        return figures[-1]

    monkeypatch.setattr(train.Watch, "validate", twice)
    plan = write_plan(tmp_path / "plan.yaml", STAGES["syn"])
    assert command("--config", plan, "--save-every", "2") == (0, "")
    assert figures[0] == figures[1] != figures[2] == figures[3]


def test_a_disk_that_fills_up_leaves_the_last_state(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = ("--config", write_plan(tmp_path / "plan.yaml", STAGES["l1"]), "--save-every", "2")
    save, saves = torch.save, []

    def full(state: Any, path: Path) -> None:
        saves.append(path)
        if len(saves) == 2:
            path.write_bytes(b"half a state")
            raise RuntimeError("PytorchStreamWriter failed writing file data/7: file write failed")
        save(state, path)

    monkeypatch.setattr(torch, "save", full)
    code, said = command(*plan)
    assert code == 2
    assert said.startswith("refine-train: ")
    assert "state.pt cannot be written (PytorchStreamWriter failed" in said
    assert said.count("\n") == 1
    assert torch.load(tmp_path / "run" / "l1" / STATE, weights_only=True)["iteration"] == 2
    assert command(*plan, "--resume") == (0, "")
    monkeypatch.undo()
    assert command(*plan, out="whole") == (0, "")
    assert_same_training(tmp_path / "run" / "l1", tmp_path / "whole" / "l1")


# Mistakes

VGG_STAGE = {**STAGES["syn"], "objective": {"kind": "synthetic"}}
WIDE = {"width": 3, "levels": 3, "deep_multiplier": 2}


@pytest.mark.parametrize(
    ("stages", "arguments", "hint"),
    [
        (["syn"], ("--stage", "soup"), "--stage soup is not in the plan; it has syn"),
        (["hyb"], (), "a stage trains on real pairs; give their folder with --pairs"),
        (["hyb"], ("--pairs", "absent"), "absent is not a folder"),
        (["syn"], ("--start", "absent.pt"), "--start absent.pt is not a file"),
        (["l1", "syn"], ("--stage", "syn"), "stage syn starts from the networks of l1, but there is no"),
        (
            ["syn"],
            ("--devices", "2"),
            "stage syn has phases of 1 shards, which do not divide among 2 processes",
        ),
        (["syn"], ("--accelerator", "soup"), "cannot train on 1 soup devices: "),
        (["vgg"], ("--vgg", "absent.safetensors"), "run `python -m losses.fetch_weights vgg`"),
    ],
)
def test_mistakes_end_in_one_sentence(
    stages: list[str], arguments: tuple[str, ...], hint: str, command: Command, tmp_path: Path
) -> None:
    known = {**STAGES, "vgg": VGG_STAGE}
    plan = write_plan(tmp_path / "plan.yaml", *(known[name] for name in stages))
    code, said = command("--config", plan, *arguments)
    assert code == 2
    assert said.startswith("refine-train: ")
    assert hint in said
    assert said.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_plans_and_data_that_are_none_are_named(command: Command, tmp_path: Path) -> None:
    plan = write_plan(tmp_path / "plan.yaml", STAGES["l1"])
    (tmp_path / "index.json").write_text("{}")
    for arguments, data, hint in (
        (("--config", tmp_path / "no.yaml"), tmp_path, "no.yaml cannot be read"),
        (("--config", plan), tmp_path / "absent", "absent is not a folder"),
        (("--config", plan), tmp_path, "is not a complete material pool"),
    ):
        code, said = command(*arguments, data=data)
        assert (code, said.count("\n")) == (2, 1)
        assert hint in said
        assert not (tmp_path / "run").exists()


def test_without_vgg_the_command_that_fetches_it_is_named(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("XDG_CACHE_HOME", "TORCH_HOME", "HOME"):
        monkeypatch.setenv(variable, str(tmp_path / "empty"))
    monkeypatch.delenv("REFINE_VGG16", raising=False)
    code, said = command("--config", write_plan(tmp_path / "plan.yaml", VGG_STAGE))
    assert code == 2
    assert "run `python -m losses.fetch_weights vgg` once" in said
    assert said.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_no_training_is_overwritten_or_continued_as_another(command: Command, tmp_path: Path) -> None:
    plan = write_plan(tmp_path / "plan.yaml", STAGES["l1"])
    assert command("--config", plan) == (0, "")
    before = (tmp_path / "run" / "l1" / STATE).read_bytes()
    code, said = command("--config", plan)
    assert (code, said.count("\n")) == (2, 1)
    assert "holds a training already; go on with --resume or give another --out" in said
    write_plan(plan, STAGES["l1"], generator=WIDE)
    code, said = command("--config", plan, "--resume")
    assert (code, said.count("\n")) == (2, 1)
    assert "is the state of another network or objective" in said
    (tmp_path / "run" / "l1" / STATE).write_bytes(before[:1000])
    code, said = command("--config", plan, "--resume")
    assert (code, said.count("\n")) == (2, 1)
    assert "is not the state of a training" in said
    (tmp_path / "run" / "l1" / STATE).write_bytes(before)
    write_plan(plan, STAGES["l1"])
    assert command("--config", plan, "--resume") == (0, "")


def test_the_sheet_shows_truth_above_estimate(command: Command, tmp_path: Path) -> None:
    plan = write_plan(tmp_path / "plan.yaml", STAGES["l1"])
    assert command("--config", plan, "--steps", "1") == (0, "")
    sheet = oiio.ImageBuf(str(tmp_path / "run" / "l1" / "samples.png")).get_pixels(oiio.FLOAT)
    rows = sheet.reshape(2 * SHEET_MATERIALS, 16, 6, 16, 3).transpose(0, 2, 1, 3, 4)
    for truth, estimate in zip(rows[0::2], rows[1::2], strict=True):
        assert np.array_equal(truth[0], estimate[0])  # the photo
        assert all(np.abs(truth[n] - estimate[n]).mean() > 0.01 for n in range(1, 6))
    photos = [row[0] for row in rows[0::2]]
    assert not np.array_equal(photos[0], photos[1])
