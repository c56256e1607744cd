"""`refine-train`: what it is asked, what it draws from a pool, and a tiny training from end to end."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from typer.testing import CliRunner

from nets.checkpoint import load_model, read_record
from nets.data import pool as pool_module
from nets.data.augment import Augmentation
from nets.data.photography import FlashPhotography
from nets.data.pool import Entry, MaterialPool, build_pool
from nets.generator import GeneratorConfig
from nets.render import render
from nets.trainer import Phase
from refine import Refiner, train
from refine.train import AUGMENTATION, POOL_SHARES, batch_source, parse_phases
from tests.helpers import assert_close, random_svbrdf, seeded

TINY = ("--width", "2", "--levels", "5", "--deep-multiplier", "2")


@pytest.fixture(autouse=True)
def _threads() -> Iterator[None]:
    """Give torch its threads back: the command sets them."""
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def write_pool(folder: Path, *entries: Entry) -> Path:
    """Store random materials under the given names and kinds."""

    def make(entry: Entry, size: int) -> torch.Tensor:
        return pool_module.encode(random_svbrdf(1, size, size, seed=entry.seed))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool_module, "make", make)
        patch.setattr(pool_module, "plan", lambda *arguments, **more: list(entries))
        build_pool(folder, size=40, procedural=len(entries), workers=0)
    return folder


def entry(name: str, kind: str, collection: str, seed: int) -> Entry:
    return Entry(name, kind, collection, "whole", seed, "Apache-2.0")


@pytest.fixture(scope="module")
def pool(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pool(
        tmp_path_factory.mktemp("pool") / "pool",
        *(entry(f"brick_{seed}", "procedural", "brick", seed) for seed in range(5)),
        *(entry(f"infinigen__{seed}", "pbr", "infinigen", seed) for seed in range(5, 8)),
    )


@pytest.fixture
def command(pool: Path) -> Callable[..., tuple[int, str]]:
    """Return the command line; it gives the exit code and what was said."""

    def run(*arguments: str | Path, pool: Path = pool) -> tuple[int, str]:
        done = CliRunner().invoke(train.app, ["--pool", str(pool), *TINY, *map(str, arguments)])
        if done.exception is not None and not isinstance(done.exception, SystemExit):
            raise done.exception
        return done.exit_code, done.stderr

    return run


# Phases


def test_phases_are_iterations_crop_and_batch() -> None:
    assert parse_phases("4000:128:8,2000:256:4") == (Phase(4000, 128, 8), Phase(2000, 256, 4))
    assert parse_phases("1:32:1") == (Phase(1, crop=32, batch=1),)
    assert len(parse_phases(train.DEFAULT_PHASES)) == 2


@pytest.mark.parametrize(
    "text", ["", "4000", "1:2", "1:2:3:4", "1:2:x", "1:2:3,", "0:128:8", "5:-128:8", "5:128:0", "1.5:2:3"]
)
def test_other_phases_are_refused_with_an_example(text: str) -> None:
    with pytest.raises(ValueError, match="give for example") as caught:
        parse_phases(text)
    assert repr(text) in str(caught.value)
    assert train.DEFAULT_PHASES in str(caught.value)


# Batches


def test_a_batch_is_photos_of_the_materials_that_are_its_truth(pool: Path) -> None:
    plain = FlashPhotography(exposure_share=0.0, falloff_share=0.0, noise_range=(0.0, 0.0))
    batch = batch_source(MaterialPool(pool), AUGMENTATION, plain, POOL_SHARES)(3, 32, seeded(1))
    assert batch.photo.shape == (3, 3, 32, 32)
    assert batch.truth.validate().size == (32, 32)
    assert batch.light.position.shape == (3, 3)
    assert float(batch.light.position[:, 2].min()) > 0.0
    rendered = render(batch.truth, batch.light, plain.camera).clamp(0.0, 1.0)
    assert_close(batch.photo ** (1 / 2.2), rendered ** (1 / 2.2), atol=0.5 / 255 + 1e-3, rtol=0.0)


def test_the_same_generator_gives_the_same_batch(pool: Path) -> None:
    source = batch_source(MaterialPool(pool))
    first, again, other = (source(2, 32, seeded(seed)) for seed in (1, 1, 2))
    assert torch.equal(first.photo, again.photo)
    assert torch.equal(first.truth.channels(), again.truth.channels())
    assert torch.equal(first.light.position, again.light.position)
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

    source = batch_source(
        Watched(write_pool(tmp_path / "pool", *entries)), Augmentation.none(), shares=POOL_SHARES
    )
    source(1, 32, seeded(0))
    assert sum(counted.values()) == draws
    found = {kind: count / draws for kind, count in counted.items()}
    assert found == pytest.approx(expected, abs=0.08)


# The command


def test_a_training_from_pool_to_material(command: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    out = tmp_path / "run"
    arguments = ("--out", out, "--seed", "3", "--save-every", "2", "--data-note", "bricks, Apache-2.0")
    assert command(*arguments, "--phases", "4:32:2,2:64:1", "--learning-rate", "0.001") == (0, "")
    assert sorted(path.name for path in out.iterdir()) == ["state.pt", "weights.safetensors"]

    record = read_record(out / "weights.safetensors")
    assert record.architecture == GeneratorConfig(2, 5, 2)
    assert record.data == ["bricks, Apache-2.0"]
    training = record.training
    assert (training["iterations"], training["samples"], training["processes"]) == (6, 10, 1)
    assert training["config"]["phases"][1] == {"iterations": 2, "crop": 64, "batch": 1}
    assert training["config"]["learning_rate"] == 0.001
    assert training["config"]["seed"] == 3
    assert training["shares"] == POOL_SHARES
    assert training["augmentation"]["specular"] == AUGMENTATION.specular
    assert training["objective"]["map_weight"] == 1.0
    assert training["photography"]["centred_share"] == FlashPhotography().centred_share
    json.dumps(training, allow_nan=False)

    network = load_model(out / "weights.safetensors")
    refined = Refiner(network).fit(torch.rand(3, 32, 32, generator=seeded(0)) * 0.5, iters=2)
    refined.svbrdf.validate()


def test_resuming_goes_on_where_it_stopped(
    command: Callable[..., tuple[int, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    phases = ("--phases", "6:32:2")
    assert command("--out", whole, *phases, "--save-every", "3")[0] == 0

    step, steps = train.Trainer.step, []

    def interrupted(self: train.Trainer) -> dict[str, float]:
        steps.append(self.iteration)
        if len(steps) == 5:
            raise KeyboardInterrupt
        return step(self)

    monkeypatch.setattr(train.Trainer, "step", interrupted)
    assert command("--out", parts, *phases, "--save-every", "3")[0] != 0
    assert read_record(parts / "weights.safetensors").training["iterations"] == 3
    assert command("--out", parts, *phases, "--save-every", "3", "--resume")[0] == 0
    assert steps == [0, 1, 2, 3, 4, 3, 4, 5]  # the fifth was lost, the first three were kept
    first, second = (load_model(folder / "weights.safetensors") for folder in (whole, parts))
    for name, value in first.state_dict().items():
        assert torch.equal(second.state_dict()[name], value), name
    assert read_record(parts / "weights.safetensors").training["iterations"] == 6


def test_the_log_has_a_line_of_json_now_and_then(
    command: Callable[..., tuple[int, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "LOG_EVERY", 2)
    assert command("--out", tmp_path / "run", "--phases", "5:32:1")[0] == 0
    lines = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in lines] == [2, 4]
    assert {"loss", "normal", "diffuse", "roughness", "specular", "rendering", "light"} <= set(lines[0])
    assert lines[0]["samples_per_second"] > 0.0


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (("--phases", "soup"), "'soup' is not iterations:crop:batch"),
        (("--phases", "6:0:2"), "'6:0:2' is not iterations:crop:batch"),
        (("--phases", "6:40:2"), "multiples of 32"),
        (("--width", "0"), "not a generator"),
        (("--levels", "40"), "not a generator"),
    ],
)
def test_mistakes_end_in_one_sentence(
    arguments: tuple[str, ...], hint: str, command: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    code, said = command("--out", tmp_path / "run", *arguments)
    assert code == 2
    assert said.startswith("refine-train: ")
    assert hint in said
    assert said.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_a_pool_that_is_none_is_named(command: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    code, said = command("--out", tmp_path / "run", "--phases", "2:32:1", pool=tmp_path / "absent")
    assert code == 2
    assert said.count("\n") == 1
    assert "absent is not a complete material pool" in said
    assert not (tmp_path / "run").exists()
