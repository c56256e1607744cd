"""The trainer: it learns, resumes to the last bit, follows its schedule, and saves all or nothing."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from nets.generator import Generator, GeneratorConfig, light_to_output, svbrdf_to_maps
from nets.render import render
from nets.trainer import Phase, Terms, Trainer, TrainerConfig, TrainingBatch
from tests.helpers import random_light, random_svbrdf

TINY = GeneratorConfig(width=4, levels=3, deep_multiplier=2)
CONFIG = TrainerConfig(
    phases=(Phase(20, crop=8, batch=2), Phase(12, crop=16, batch=3)),
    learning_rate=5e-3,
    warmup=5,
    low_precision=False,
    seed=4,
)


def fixed_source(batch: int, crop: int, generator: torch.Generator) -> TrainingBatch:
    truth = random_svbrdf(batch, crop, crop, seed=1)
    light = random_light(batch, seed=1)
    return TrainingBatch(render(truth, light), truth, light)


def random_source(batch: int, crop: int, generator: torch.Generator) -> TrainingBatch:
    seed = int(torch.randint(1000, (1,), generator=generator))
    truth, light = random_svbrdf(batch, crop, crop, seed=seed), random_light(batch, seed=seed)
    return TrainingBatch(render(truth, light), truth, light)


def objective(network: Generator, batch: TrainingBatch, generator: torch.Generator) -> tuple[Tensor, Terms]:
    maps, light = network(batch.network_input)
    jitter = 1.0 + 0.01 * torch.rand(1, generator=generator)
    terms = {
        "maps": (maps - svbrdf_to_maps(batch.truth)).abs().mean(),
        "light": (light - light_to_output(batch.light.position)).abs().mean(),
    }
    return (jitter * (terms["maps"] + terms["light"])).squeeze(), terms


def trainer(source=random_source, **changes: Any) -> Trainer:  # type: ignore[no-untyped-def]
    torch.manual_seed(0)
    return Trainer(Generator(TINY), source, objective, replace(CONFIG, **changes))


def flat_state(value: Any, name: str = "") -> dict[str, Any]:
    if isinstance(value, dict):
        return {k: v for key, item in value.items() for k, v in flat_state(item, f"{name}.{key}").items()}
    if isinstance(value, list | tuple):
        return flat_state(dict(enumerate(value)), name)
    return {name: value}


def state_of(run: Trainer) -> dict[str, Any]:
    return flat_state(
        {
            "network": run.network.state_dict(),
            "average": run.average.state_dict(),
            "optimizer": run.optimizer.state_dict(),
            "generator": run.generator.get_state(),
            "torch": torch.get_rng_state(),
            "counters": [run.iteration, run.samples, run.averages],
        }
    )


def assert_same_bits(found: dict[str, Any], expected: dict[str, Any]) -> None:
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        same = torch.equal(found[name], value) if isinstance(value, Tensor) else found[name] == value
        assert same, name


@pytest.mark.parametrize("low_precision", [False, True])
def test_the_loss_goes_down(low_precision: bool) -> None:
    run = trainer(fixed_source, low_precision=low_precision)
    losses = []
    while not run.done:
        losses.append(run.step()["loss"])
    assert len(losses) == CONFIG.iterations == 32
    assert sum(losses[-5:]) < 0.75 * sum(losses[:5])
    assert all(parameter.dtype == torch.float32 for parameter in run.network.parameters())


def test_resumed_equals_uninterrupted_to_the_last_bit(tmp_path: Path) -> None:
    whole = trainer()
    for _ in range(23):  # crosses the border of the phases
        whole.step()
    expected = state_of(whole)

    first = trainer()
    for _ in range(17):
        first.step()
    first.save(tmp_path / "state.pt")
    torch.manual_seed(123)
    second = Trainer(Generator(TINY), random_source, objective, CONFIG)
    second.resume(tmp_path / "state.pt")
    assert second.iteration == 17
    for _ in range(6):
        second.step()
    assert_same_bits(state_of(second), expected)


def test_saving_does_not_disturb_training(tmp_path: Path) -> None:
    quiet = trainer()
    for _ in range(4):
        quiet.step()
    expected = state_of(quiet)
    saving = trainer()
    for _ in range(4):
        saving.step()
        saving.save(tmp_path / "state.pt")
    assert_same_bits(state_of(saving), expected)


def test_a_failing_save_leaves_the_old_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, path = trainer(), tmp_path / "runs" / "state.pt"
    run.step()
    run.save(path)
    before = path.read_bytes()
    run.step()

    def fail(state: object, file: Path) -> None:
        file.write_bytes(b"half a file")
        raise OSError("disk full")

    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(OSError, match="disk full"):
        run.save(path)
    assert path.read_bytes() == before
    again = trainer()
    again.resume(path)
    assert again.iteration == 1


def test_the_seed_decides() -> None:
    states = []
    for seed in (4, 4, 5):
        run = trainer(seed=seed)
        run.step()
        states.append(torch.cat([parameter.detach().flatten() for parameter in run.network.parameters()]))
    assert torch.equal(states[0], states[1])
    assert not torch.equal(states[0], states[2])


def test_phases_follow_each_other() -> None:
    assert [CONFIG.phase_at(i).crop for i in (0, 19, 20, 31, 99)] == [8, 8, 16, 16, 16]
    crops: list[tuple[int, int]] = []

    def source(batch: int, crop: int, generator: torch.Generator) -> TrainingBatch:
        crops.append((batch, crop))
        return fixed_source(batch, crop, generator)

    run = trainer(source, phases=(Phase(2, 8, 1), Phase(1, 16, 3)))
    while not run.done:
        run.step()
    assert crops == [(1, 8), (1, 8), (3, 16)]
    assert run.samples == 5
    assert run.record()["iterations"] == 3
    assert run.record()["samples"] == 5
    assert run.record()["config"]["phases"][1] == {"iterations": 1, "crop": 16, "batch": 3}


def test_the_learning_rate_warms_up_and_decays() -> None:
    config = TrainerConfig((Phase(1000, 8, 1),), learning_rate=1e-2, final_learning_rate=1e-4, warmup=10)
    rates = [config.learning_rate_at(i) for i in range(1001)]
    assert rates[0] == pytest.approx(1e-3, rel=1e-4)
    assert rates[4] == pytest.approx(5e-3, rel=1e-3)
    assert max(rates) == pytest.approx(1e-2, rel=1e-3)
    assert rates[500] == pytest.approx((1e-2 + 1e-4) / 2)
    assert rates[1000] == pytest.approx(1e-4)
    assert all(a < b for a, b in pairwise(rates[:10]))
    assert all(a > b for a, b in pairwise(rates[10:]))
    run = trainer()
    run.step()
    assert run.optimizer.param_groups[0]["lr"] == CONFIG.learning_rate_at(0)
    assert run.optimizer.param_groups[0]["betas"] == (0.5, 0.999)


def test_the_average_follows_the_weights() -> None:
    run = trainer(ema_decay=0.0)
    run.step()
    for mean, value in zip(run.average.parameters(), run.network.parameters(), strict=True):
        assert torch.equal(mean, value)
        assert not mean.requires_grad
    slow = trainer(ema_decay=0.999)
    start = [parameter.detach().clone() for parameter in slow.network.parameters()]
    slow.step()
    # A young average is young: its first decay is 1 / 10.
    for mean, value, first in zip(slow.average.parameters(), slow.network.parameters(), start, strict=True):
        torch.testing.assert_close(mean, 0.1 * first + 0.9 * value.detach(), atol=1e-6, rtol=1e-5)
    assert not slow.average.training


def test_a_gradient_that_is_not_finite_is_not_followed() -> None:
    def poisoned(
        network: Generator, batch: TrainingBatch, generator: torch.Generator
    ) -> tuple[Tensor, Terms]:
        loss, terms = objective(network, batch, generator)
        return loss * float("nan"), terms

    run = trainer()
    run.objective = poisoned
    before = [parameter.detach().clone() for parameter in run.network.parameters()]
    run.step()
    assert all(torch.equal(a, b) for a, b in zip(before, run.network.parameters(), strict=True))
    assert all(bool(torch.isfinite(parameter).all()) for parameter in run.average.parameters())


def test_a_gradient_is_clipped() -> None:
    run = trainer(gradient_clip=1e-3)
    run.step()
    norms = [parameter.grad.norm() for parameter in run.network.parameters() if parameter.grad is not None]
    assert float(torch.stack(norms).norm()) <= 1e-3 * (1 + 1e-4)


def test_terms_are_reported_and_averaged() -> None:
    run = trainer(fixed_source)
    first = run.step()
    assert set(first) == {"loss", "maps", "light"}
    assert run.averages == pytest.approx(first)
    second = run.step()
    assert run.averages["maps"] == pytest.approx(0.98 * first["maps"] + 0.02 * second["maps"])
