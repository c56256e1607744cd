"""The trainer: it learns, resumes to the last bit, follows its schedule, and saves all or nothing."""

from __future__ import annotations

import resource
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from nets.architectures import continues
from nets.generator import Generator, GeneratorConfig, svbrdf_to_maps
from nets.light_head import light_to_output
from nets.render import render
from nets.trainer import Trainer, stream_seed
from nets.training import (
    CPU,
    Alone,
    BatchSource,
    Losses,
    Objective,
    Phase,
    Team,
    TrainerConfig,
    TrainingBatch,
)
from tests.helpers import random_light, random_svbrdf, seeded

TINY = GeneratorConfig(width=4, levels=3, deep_multiplier=2)
CONFIG = TrainerConfig(
    phases=(Phase(20, crop=8, batch=2), Phase(12, crop=16, batch=3)),
    learning_rate=5e-3,
    warmup=5,
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


def objective(
    network: Generator, critics: nn.ModuleDict, batch: TrainingBatch, generator: torch.Generator
) -> Losses:
    maps, light = network(batch.network_input)
    jitter = 1.0 + 0.01 * torch.rand(1, generator=generator)
    terms = {
        "maps": (maps - svbrdf_to_maps(batch.truth)).abs().mean(),
        "light": (light - light_to_output(batch.light.position)).abs().mean(),
    }
    return Losses((jitter * (terms["maps"] + terms["light"])).squeeze(), terms)


def game(
    network: Generator, critics: nn.ModuleDict, batch: TrainingBatch, generator: torch.Generator
) -> Losses:
    """Two players on one graph: a critic tells truth from estimate, the generator is right and fools it."""
    dtype = next(network.parameters()).dtype
    maps, light = network(batch.network_input.to(dtype))
    truth = svbrdf_to_maps(batch.truth).to(dtype)
    real, fake = critics["maps"](torch.cat([truth, maps])).chunk(2)
    terms = {"maps": (maps - truth).abs().mean(), "light": light.abs().mean()}
    return Losses(
        terms["maps"] + terms["light"] + 0.1 * (fake - 1.0).square().mean(),
        terms,
        (real - 1.0).square().mean() + fake.square().mean(),
    )


def a_critic() -> nn.ModuleDict:
    layers = (nn.Conv2d(10, 6, 3, padding=1), nn.LeakyReLU(0.2), nn.Conv2d(6, 1, 3, padding=1))
    return nn.ModuleDict({"maps": nn.Sequential(*layers)})


def trainer(
    source: BatchSource = random_source,
    team: Team | None = None,
    network: GeneratorConfig = TINY,
    parts: tuple[str, ...] = (),
    **changes: Any,
) -> Trainer:
    torch.manual_seed(0)
    config = replace(CONFIG, **changes)
    return Trainer(Generator(network), source, objective, config, team=team or Alone(), parts=parts)


def player(source: BatchSource = random_source, team: Team | None = None, **changes: Any) -> Trainer:
    """Return a trainer of two players."""
    torch.manual_seed(0)
    config = replace(CONFIG, **changes)
    return Trainer(Generator(TINY), source, game, config, a_critic(), team or Alone())


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
            "critics": run.critics.state_dict(),
            "critic_optimizer": run.critic_optimizer and run.critic_optimizer.state_dict(),
            "torch": torch.get_rng_state(),
            "counters": [run.iteration, run.samples, run.averages],
        }
    )


def assert_same_bits(found: dict[str, Any], expected: dict[str, Any]) -> None:
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        same = torch.equal(found[name], value) if isinstance(value, Tensor) else found[name] == value
        assert same, name


def parameters_of(run: Trainer) -> Tensor:
    players = [*run.network.parameters(), *run.critics.parameters()]
    return torch.cat([parameter.detach().flatten() for parameter in players])


@pytest.mark.parametrize("low_precision", [False, True])
def test_the_loss_goes_down(low_precision: bool) -> None:
    run = trainer(fixed_source, Alone(low_precision=low_precision))
    losses = []
    while not run.done:
        losses.append(run.step()["loss"])
    assert len(losses) == CONFIG.iterations == 32
    assert sum(losses[-5:]) < 0.75 * sum(losses[:5])
    assert all(parameter.dtype == torch.float32 for parameter in run.network.parameters())


def test_low_precision_is_that_of_the_team() -> None:
    seen = []

    def watched(network: Generator, *others: Any) -> Losses:
        seen.append(network.encoder[0](torch.zeros(1, 3, 8, 8)).dtype)
        return objective(network, *others)

    for low_precision in (False, True):
        run = trainer(team=Alone(low_precision=low_precision))
        run.objective = watched
        run.step()
    assert seen == [torch.float32, torch.bfloat16]


# Two players


def test_each_player_follows_its_own_loss_only() -> None:
    config = replace(CONFIG, gradient_clip=1e9)
    torch.manual_seed(0)
    run = Trainer(Generator(TINY).double(), random_source, game, config, a_critic().double())
    dropout = stream_seed(CONFIG.seed, 0, 0)
    batch = random_source(2, 8, seeded(dropout))
    run.network.train()
    torch.manual_seed(dropout)
    losses = game(run.network, run.critics, batch, seeded(0))
    expected = torch.autograd.grad(losses.generator, list(run.network.parameters()), retain_graph=True)
    assert losses.critics is not None
    # What the critic would get from a detached estimate, which is how textbooks write it.
    torch.manual_seed(dropout)
    with torch.no_grad():
        maps, _ = run.network(batch.network_input.double())
    judged = run.critics["maps"](torch.cat([svbrdf_to_maps(batch.truth).double(), maps]))
    real, fake = judged.chunk(2)
    detached = (real - 1.0).square().mean() + fake.square().mean()
    expected_critic = torch.autograd.grad(detached, list(run.critics.parameters()))

    run.step()
    for players, gradients in ((run.network, expected), (run.critics, expected_critic)):
        for parameter, gradient in zip(players.parameters(), gradients, strict=True):
            torch.testing.assert_close(parameter.grad, gradient, rtol=1e-9, atol=1e-12)
            assert float(gradient.abs().max()) > 0.0


def test_both_players_move_and_each_at_its_rate() -> None:
    run = player(critic_factor=0.5)
    network, critics = ([p.detach().clone() for p in m.parameters()] for m in (run.network, run.critics))
    values = run.step()
    assert set(values) == {"loss", "critics", "maps", "light"}
    assert run.critic_optimizer is not None
    assert run.optimizer.param_groups[0]["lr"] == CONFIG.learning_rate_at(0)
    assert run.critic_optimizer.param_groups[0]["lr"] == 0.5 * CONFIG.learning_rate_at(0)
    for before, players in ((network, run.network), (critics, run.critics)):
        assert not any(torch.equal(a, b) for a, b in zip(before, players.parameters(), strict=True))
    still = player(critic_factor=0.0)
    critics = [p.detach().clone() for p in still.critics.parameters()]
    still.step()
    assert all(torch.equal(a, b) for a, b in zip(critics, still.critics.parameters(), strict=True))


def test_a_player_whose_gradient_is_not_finite_waits_for_the_other() -> None:
    def poisoned(*arguments: Any) -> Losses:
        losses = game(*arguments)
        assert losses.critics is not None
        return replace(losses, critics=losses.critics * float("nan"))

    run = player()
    run.objective = poisoned
    network, critics = ([p.detach().clone() for p in m.parameters()] for m in (run.network, run.critics))
    run.step()
    assert all(torch.equal(a, b) for a, b in zip(critics, run.critics.parameters(), strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(network, run.network.parameters(), strict=True))
    assert bool(torch.isfinite(parameters_of(run)).all())


# Resuming


@pytest.mark.parametrize("kind", [trainer, player])
def test_resumed_equals_uninterrupted_to_the_last_bit(kind: Callable[..., Trainer], tmp_path: Path) -> None:
    phases = (Phase(2, crop=8, batch=2), Phase(3, crop=16, batch=1, shards=2))
    whole = kind(phases=phases)
    while not whole.done:
        whole.step()
        whole.save(tmp_path / f"{whole.iteration}.pt")
    expected = state_of(whole)

    for saved in (1, 2, 3, 5):  # within a phase, on the border, after it, at the end
        second = kind(phases=phases)
        with torch.no_grad():
            for parameter in [*second.network.parameters(), *second.critics.parameters()]:
                parameter.normal_()  # nothing of what it was may shine through
        torch.manual_seed(123)
        second.resume(tmp_path / f"{saved}.pt")
        assert second.iteration == saved
        while not second.done:
            second.step()
        found = state_of(second)
        if saved == 5:
            del found[".torch"]  # nothing was drawn
        assert_same_bits(found, {name: expected[name] for name in found})
        assert len(found) >= len(expected) - 1


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
    with pytest.raises(OSError, match=r"state\.pt cannot be written \(disk full\)"):
        run.save(path)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["state.pt"]
    again = trainer()
    again.resume(path)
    assert again.iteration == 1


def test_a_disk_that_is_really_full_leaves_the_old_state(tmp_path: Path) -> None:
    run, path = trainer(), tmp_path / "state.pt"
    run.save(path)
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, hard))
    try:
        with pytest.raises(OSError, match=r"state\.pt cannot be written"):
            run.save(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["state.pt"]


def test_damaged_states_are_refused_in_one_sentence(tmp_path: Path) -> None:
    run = trainer()
    run.save(tmp_path / "state.pt")
    whole = (tmp_path / "state.pt").read_bytes()
    half, noise, other = (tmp_path / f"{name}.pt" for name in ("half", "noise", "other"))
    half.write_bytes(whole[: len(whole) // 2])
    noise.write_bytes(bytes(range(256)) * 10)
    torch.save([1, 2], other)
    for path in (half, noise, other, tmp_path / "absent.pt"):
        for read in (run.resume, run.adopt):
            with pytest.raises(ValueError, match="is not the state of a training") as caught:
                read(path)
            assert "\n" not in str(caught.value)
            assert str(path) in str(caught.value)


def test_states_of_other_networks_are_refused_in_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "state.pt"
    wider = Trainer(Generator(replace(TINY, width=5)), random_source, objective, CONFIG)
    wider.save(path)
    for read in (trainer().resume, trainer().adopt):
        with pytest.raises(ValueError, match=r"is the state of another network.*size mismatch") as caught:
            read(path)
        assert "\n" not in str(caught.value)
    trainer().save(path)
    with pytest.raises(ValueError, match="another network or objective"):
        player().resume(path)  # has no critics
    player().save(path)
    with pytest.raises(ValueError, match="another network or objective"):
        trainer().resume(path)  # has critics nobody asks for


def test_parts_that_a_network_lacks_as_a_whole_begin_anew() -> None:
    plain, larger = trainer(), trainer(network=replace(TINY, revision_channels=2))
    new = {k: v.clone() for k, v in larger.network.state_dict().items() if k.startswith("revision.")}
    assert new
    weights = plain.network.state_dict()
    larger.take_weights(weights, plain.average.state_dict())
    for network in (larger.network, larger.average):
        assert_same_bits(network.state_dict(), {**weights, **new})
    del weights["encoder.0.weight"]
    with pytest.raises(RuntimeError, match=r"encoder\.0\.weight"):
        trainer().take_weights(weights, weights)


def test_a_network_may_start_from_one_that_revises_less() -> None:
    never, once, twice = (
        replace(TINY, revision_channels=channels, revision_passes=passes)
        for channels, passes in ((0, 1), (2, 1), (2, 2))
    )
    for later, earlier in ((once, never), (twice, never), (twice, once), (twice, twice)):
        assert continues(later, earlier)
    wider = replace(twice, width=twice.width + 1)
    for later, earlier in ((never, once), (once, twice), (wider, once)):
        assert not continues(later, earlier)


def test_only_the_named_parts_are_trained_and_only_they_drop_out() -> None:
    run = trainer(parts=("light_head",))
    before = {name: value.clone() for name, value in run.network.state_dict().items()}
    run.step()
    moved = {name for name, value in run.network.state_dict().items() if not torch.equal(value, before[name])}
    assert moved
    assert all(name.startswith("light_head.") for name in moved)
    assert {name for name, module in run.network.named_children() if module.training} == {"light_head"}


def test_a_stage_adopts_networks_and_starts_anew(tmp_path: Path) -> None:
    first = player()
    for _ in range(3):
        first.step()
    first.save(tmp_path / "state.pt")
    second = player(seed=9)
    second.critics["more"] = nn.Conv2d(3, 1, 1)
    new = [p.detach().clone() for p in second.critics["more"].parameters()]
    second.adopt(tmp_path / "state.pt")
    for name in ("network", "average"):
        ours, theirs = (getattr(run, name).state_dict() for run in (second, first))
        assert_same_bits(flat_state(ours), flat_state(theirs))
    assert_same_bits(second.critics["maps"].state_dict(), first.critics["maps"].state_dict())
    assert all(torch.equal(a, b) for a, b in zip(new, second.critics["more"].parameters(), strict=True))
    assert (second.iteration, second.samples, second.averages) == (0, 0, {})
    assert not second.optimizer.state_dict()["state"]

    plain = trainer()
    plain.save(tmp_path / "plain.pt")
    third = player()
    third.adopt(tmp_path / "plain.pt")  # the critics of the first adversarial stage are new
    assert_same_bits(third.network.state_dict(), plain.network.state_dict())
    old = torch.load(tmp_path / "plain.pt", weights_only=True)
    del old["critics"], old["critic_optimizer"]  # as states were before there were critics
    torch.save(old, tmp_path / "old.pt")
    fourth = player()
    fourth.adopt(tmp_path / "old.pt")
    assert_same_bits(fourth.network.state_dict(), plain.network.state_dict())
    with pytest.raises(ValueError, match="another network or objective"):
        fourth.resume(tmp_path / "old.pt")


# Shards and teams


@dataclass
class Table:
    """Where the members of a team in one process meet."""

    world: int
    parts: dict[int, Tensor] = field(default_factory=dict)
    barrier: threading.Barrier = field(init=False)

    def __post_init__(self) -> None:
        self.barrier = threading.Barrier(self.world, timeout=60)


@dataclass(frozen=True)
class Member(Alone):
    """One of several: means are taken over what all put on the table."""

    table: Table = field(default_factory=lambda: Table(1))

    def mean(self, tensor: Tensor) -> Tensor:
        self.table.parts[self.rank] = tensor.clone()
        self.table.barrier.wait()
        total = torch.stack([self.table.parts[rank] for rank in range(self.world)]).sum(dim=0) / self.world
        self.table.barrier.wait()
        return total


SHARDED = (Phase(2, crop=8, batch=2, shards=2), Phase(1, crop=16, batch=1, shards=4))


def no_dropout(run: Trainer) -> Trainer:
    """Threads of one process share torch's global stream, which dropout draws from."""
    for module in run.network.modules():
        if isinstance(module, nn.Dropout):
            module.p = 0.0
    return run


def test_two_processes_do_what_one_does_with_the_same_shards() -> None:
    one = no_dropout(player(phases=SHARDED))
    logged = []
    while not one.done:
        logged.append(one.step())

    table = Table(2)
    team = [
        no_dropout(player(phases=SHARDED, team=Member(rank=rank, world=2, table=table))) for rank in (0, 1)
    ]
    said: dict[int, list[dict[str, float]]] = {0: [], 1: []}

    def work(run: Trainer) -> None:
        while not run.done:
            said[run.team.rank].append(run.step())

    threads = [threading.Thread(target=work, args=(run,), daemon=True) for run in team]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=120)

    assert said[0] == said[1]
    assert len(logged) == len(said[0]) == 3
    for found, expected in zip(said[0], logged, strict=True):
        assert found == pytest.approx(expected, rel=1e-5)
    assert torch.equal(parameters_of(team[0]), parameters_of(team[1]))
    torch.testing.assert_close(parameters_of(team[0]), parameters_of(one), rtol=1e-4, atol=1e-6)
    assert one.samples == team[0].samples == 2 * 4 + 4


def test_the_gradient_of_a_step_is_the_mean_of_those_of_its_shards() -> None:
    gradients = []
    for shard in range(2):
        alone = no_dropout(player(phases=(Phase(1, 8, 2, shards=2),), gradient_clip=1e9))
        alone._accumulate(alone.config.phases[0], shard, 1.0)
        players = [*alone.network.parameters(), *alone.critics.parameters()]
        gradients.append([p.grad.clone() for p in players if p.grad is not None])
    both = no_dropout(player(phases=(Phase(1, 8, 2, shards=2),), gradient_clip=1e9))
    both.step()
    found = [p.grad for p in [*both.network.parameters(), *both.critics.parameters()]]
    assert len(found) == len(gradients[0]) == len(gradients[1])
    for mean, first, second in zip(found, *gradients, strict=True):
        assert mean is not None
        torch.testing.assert_close(mean, (first + second) / 2.0, rtol=1e-4, atol=1e-7)
    first, second = (torch.cat([part.flatten() for part in one]) for one in gradients)
    assert float((first - second).abs().mean()) > 0.1 * float(first.abs().mean())


def test_shards_draw_from_streams_of_their_own_wherever_they_are() -> None:
    drawn: list[int] = []

    def source(batch: int, crop: int, generator: torch.Generator) -> TrainingBatch:
        drawn.append(generator.initial_seed())
        return fixed_source(batch, crop, generator)

    phases = (Phase(2, 8, 1, shards=4),)
    one = trainer(source, phases=phases)
    while not one.done:
        one.step()
    whole, shared = list(drawn), []
    assert whole == [stream_seed(4, iteration, shard) for iteration in (0, 1) for shard in range(4)]
    assert len(set(whole)) == 8
    drawn.clear()
    for rank in (0, 1):

        class Half(Alone):
            def mean(self, tensor: Tensor) -> Tensor:
                return tensor

        member = trainer(source, Half(rank=rank, world=2), phases=phases)
        member.step()
        shared.append(list(drawn))
        drawn.clear()
    assert shared == [[whole[0], whole[2]], [whole[1], whole[3]]]


def test_dropout_is_drawn_per_shard() -> None:
    masks = []

    def source(batch: int, crop: int, generator: torch.Generator) -> TrainingBatch:
        masks.append(torch.rand(3))  # from torch's global stream, as dropout
        return fixed_source(batch, crop, generator)

    for _ in range(2):
        run = trainer(source, phases=(Phase(2, 8, 1, shards=2),))
        torch.manual_seed(len(masks))  # whatever was drawn before
        while not run.done:
            run.step()
    assert [torch.equal(a, b) for a, b in zip(masks[:4], masks[4:], strict=True)] == [True] * 4
    assert len({tuple(mask.tolist()) for mask in masks}) == 4


def test_shards_that_do_not_divide_are_refused() -> None:
    with pytest.raises(ValueError, match="3 shards do not divide among 2 processes; give a multiple of 2"):
        trainer(phases=(Phase(1, 8, 1, shards=2), Phase(1, 8, 1, shards=3)), team=Alone(world=2))


def test_streams_are_far_apart() -> None:
    seeds = {stream_seed(s, i, h) for s in range(5) for i in range(50) for h in range(4)}
    assert len(seeds) == 1000
    assert all(0 <= seed < 2**63 for seed in seeds)
    assert stream_seed(0, 0, 0) == stream_seed(0, 0, 0)


# Schedule


def test_the_seed_decides() -> None:
    states = []
    for seed in (4, 4, 5):
        run = trainer(seed=seed)
        run.step()
        states.append(parameters_of(run))
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
    assert run.record()["config"]["phases"][1] == {"iterations": 1, "crop": 16, "batch": 3, "shards": 1}


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


@pytest.mark.parametrize(
    ("changes", "hint"),
    [
        ({"phases": ()}, "at least one phase"),
        ({"learning_rate": 0.0}, r"learning_rate must be greater than 0, got 0\.0"),
        ({"learning_rate": float("nan")}, "learning_rate must be greater than 0, got nan"),
        ({"gradient_clip": -1.0}, "gradient_clip must be greater than 0"),
        ({"final_learning_rate": -1e-5}, "final_learning_rate must not be negative"),
        ({"warmup": -1}, "warmup must not be negative"),
        ({"critic_factor": -1.0}, "critic_factor must not be negative"),
        ({"beta1": 1.0}, r"beta1 must be from 0 to below 1, got 1\.0"),
        ({"ema_decay": 1.0}, "ema_decay must be from 0 to below 1"),
    ],
)
def test_settings_that_cannot_train_are_refused(changes: dict[str, Any], hint: str) -> None:
    with pytest.raises(ValueError, match=hint):
        replace(CONFIG, **changes)


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
    def poisoned(*arguments: Any) -> Losses:
        losses = objective(*arguments)
        return replace(losses, generator=losses.generator * float("nan"))

    run = trainer()
    run.objective = poisoned
    before = [parameter.detach().clone() for parameter in run.network.parameters()]
    run.step()
    assert all(torch.equal(a, b) for a, b in zip(before, run.network.parameters(), strict=True))
    assert all(bool(torch.isfinite(parameter).all()) for parameter in run.average.parameters())


@pytest.mark.parametrize("kind", [trainer, player])
def test_the_gradient_of_each_player_is_clipped(kind: Callable[..., Trainer]) -> None:
    run = kind(gradient_clip=1e-3)
    run.step()
    for players in (run.network, run.critics):
        norms = [parameter.grad.norm() for parameter in players.parameters() if parameter.grad is not None]
        if norms:
            assert float(torch.stack(norms).norm()) == pytest.approx(1e-3, rel=1e-3)
    assert bool(list(run.critics.parameters())) == (kind is player)


def test_terms_are_reported_and_averaged() -> None:
    run = trainer(fixed_source)
    first = run.step()
    assert set(first) == {"loss", "maps", "light"}
    assert run.averages == pytest.approx(first)
    second = run.step()
    assert run.averages["maps"] == pytest.approx(0.98 * first["maps"] + 0.02 * second["maps"])


def test_an_objective_and_a_team_of_one_have_the_types_they_are_asked_for() -> None:
    checked: tuple[Objective, Team] = (game, Alone())
    assert checked[1].device == CPU
