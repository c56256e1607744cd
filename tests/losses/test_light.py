"""The light encoder's objective: closed forms, gradients, and that training moves nothing else."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn

from losses.light import LightObjective, angle_between
from nets.generator import Generator, GeneratorConfig
from nets.light_head import at_height, light_to_output
from nets.render import render
from nets.trainer import Trainer
from nets.training import Phase, TrainerConfig, TrainingBatch
from tests.helpers import gradcheck, random_light, random_svbrdf, seeded

TINY = GeneratorConfig(width=2, levels=4, deep_multiplier=2, light_channels=4)


def batch_of(size: int = 32, count: int = 2, seed: int = 0) -> TrainingBatch:
    truth, light = random_svbrdf(count, size, size, seed=seed), random_light(count, seed=seed)
    return TrainingBatch(render(truth, light).clamp(0.0, 1.0), truth, light)


@pytest.mark.parametrize("degrees", [1e-3, 5.0, 90.0, 140.0])
def test_the_angle_between_vectors_is_that_of_the_turn(degrees: float) -> None:
    turn = math.radians(degrees)
    a = torch.tensor([[0.0, 0.0, 3.0]], dtype=torch.float64)
    b = 0.5 * torch.tensor([[math.sin(turn), 0.0, math.cos(turn)]], dtype=torch.float64)
    assert float(angle_between(a, b)) == pytest.approx(turn, rel=1e-9)
    assert float(angle_between(b, a)) == pytest.approx(turn, rel=1e-9)


def test_gradients_of_the_angle() -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(2, 4, 3, generator=generator, dtype=torch.float64)
    gradcheck(lambda x: angle_between(x, b), a)


@pytest.mark.parametrize("weight", [0.0, 0.7])
def test_the_objective_is_the_sum_of_its_terms_and_zero_at_the_truth(weight: float) -> None:
    batch = batch_of()

    class Says(Generator):
        def __init__(self, position: Tensor) -> None:
            super().__init__(TINY)
            self.position = position

        def estimate_light(self, photo: Tensor) -> Tensor:
            return light_to_output(self.position)

    right = LightObjective(weight)(Says(batch.light.position), nn.ModuleDict(), batch, seeded(0))
    assert float(right.generator) == pytest.approx(0.0, abs=2e-3)  # float32 near an angle of zero
    wrong = batch.light.position * torch.tensor([-1.5, 0.5, 2.0])
    found = LightObjective(weight)(Says(wrong), nn.ModuleDict(), batch, seeded(0))
    # Twice as high, the true lights have their highlights where they had them.
    z = batch.light.position[:, 2:]
    shown = torch.cat([batch.light.position[:, :2] * (2.14 + 2.0 * z) / (2.14 + z), 2.0 * z], dim=1)
    cosine = nn.functional.cosine_similarity(wrong, shown)
    expected = float(cosine.acos().mean() + weight * math.log(2.0))
    assert float(found.generator) == pytest.approx(expected, rel=1e-5)
    assert found.critics is None


def test_a_light_behind_the_same_highlight_is_only_wrong_by_its_height() -> None:
    batch = batch_of()
    network = Generator(TINY)
    z = batch.light.position[:, 2]
    network.estimate_light = lambda photo: light_to_output(at_height(batch.light.position, 1.5 * z))  # type: ignore[method-assign]
    found = LightObjective()(network, nn.ModuleDict(), batch, seeded(0)).terms
    assert float(found["direction"]) == pytest.approx(0.0, abs=2e-3)
    assert float(found["height"]) == pytest.approx(math.log(1.5), rel=1e-5)


def test_200_iterations_of_the_light_lower_its_error_and_leave_the_maps_alone() -> None:
    torch.manual_seed(0)
    network = Generator(TINY)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    config = TrainerConfig((Phase(200, 32, 4),), learning_rate=3e-3, warmup=1)

    def source(count: int, crop: int, generator: torch.Generator) -> TrainingBatch:
        return batch_of(crop, count, int(torch.randint(4, (1,), generator=generator)))

    trainer = Trainer(network, source, LightObjective(), config, parts=("light_head",))
    losses = [trainer.step()["loss"] for _ in range(config.iterations)]
    assert sum(losses[-10:]) < 0.7 * sum(losses[:10])
    for name, value in network.state_dict().items():
        assert torch.equal(value, before[name]) != name.startswith("light_head."), name


def test_a_part_that_is_not_there_is_named() -> None:
    config = TrainerConfig((Phase(1, 32, 1),))
    with pytest.raises(ValueError, match=r"the network has no light_hat; it has encoder, .*light_head"):
        Trainer(Generator(TINY), lambda *_: batch_of(), LightObjective(), config, parts=("light_hat",))
