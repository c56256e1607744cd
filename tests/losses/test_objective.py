"""The L1 objective: its parts, their weights, and what it asks of the trainer's random stream."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from losses.objective import L1Objective
from nets.generator import Generator, GeneratorConfig, light_to_output, svbrdf_to_maps
from nets.render import render
from nets.svbrdf import MAPS
from nets.trainer import TrainingBatch
from tests.helpers import random_light, random_svbrdf, seeded

TINY = GeneratorConfig(width=2, levels=3, deep_multiplier=2)


class Oracle(Generator):
    """Knows the answer, plus a constant error in every output."""

    def __init__(self, batch: TrainingBatch, maps_error: float = 0.0, light_error: float = 0.0) -> None:
        super().__init__(TINY)
        self.answer = (
            svbrdf_to_maps(batch.truth) + maps_error,
            light_to_output(batch.light.position) + light_error,
        )

    def forward(self, photo: Tensor) -> tuple[Tensor, Tensor]:
        return self.answer


@pytest.fixture
def batch() -> TrainingBatch:
    truth, light = random_svbrdf(2, 16, 24), random_light(2)
    return TrainingBatch(render(truth, light), truth, light)


def test_the_answer_costs_nothing(batch: TrainingBatch) -> None:
    loss, terms = L1Objective()(Oracle(batch), batch, seeded(0))
    assert float(loss) == pytest.approx(0.0, abs=1e-5)
    assert set(terms) == {*MAPS, "rendering", "light"}


def test_the_light_term_is_of_standardised_positions(batch: TrainingBatch) -> None:
    loss, terms = L1Objective(light_weight=0.2)(Oracle(batch, light_error=0.5), batch, seeded(0))
    assert float(terms["light"]) == pytest.approx(0.5, rel=1e-5)
    assert float(loss) == pytest.approx(0.1, abs=1e-4)


@pytest.mark.parametrize("weights", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 2.0, 3.0)])
def test_the_loss_is_the_weighted_sum(batch: TrainingBatch, weights: tuple[float, float, float]) -> None:
    loss, terms = L1Objective(*weights)(Generator(TINY).eval(), batch, seeded(0))
    loss, terms = loss.detach(), {name: term.detach() for name, term in terms.items()}
    parts = (sum(float(terms[name]) for name in MAPS), float(terms["rendering"]), float(terms["light"]))
    assert float(loss) == pytest.approx(
        sum(w * part for w, part in zip(weights, parts, strict=True)), rel=1e-5
    )
    assert all(float(term) > 0.0 for term in terms.values())


def test_gradients_reach_every_parameter(batch: TrainingBatch) -> None:
    network = Generator(TINY)
    loss, _ = L1Objective()(network, batch, seeded(0))
    loss.backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert bool(torch.isfinite(parameter.grad).all()), name


@torch.no_grad()
def test_the_stream_decides(batch: TrainingBatch) -> None:
    network = Generator(TINY).eval()
    first, again, other = (float(L1Objective()(network, batch, seeded(seed))[0]) for seed in (1, 1, 2))
    assert first == again
    assert first != other


@pytest.mark.parametrize(("stride", "lights"), [(1, 1), (2, 3), (5, 2)])
def test_strides_and_lights_change_the_sample_and_not_the_scale(
    batch: TrainingBatch, stride: int, lights: int
) -> None:
    network = Generator(TINY).eval()
    objective = replace(L1Objective(), rendering_stride=stride, rendering_lights=lights)
    with torch.no_grad():
        _, terms = objective(network, batch, seeded(0))
        _, full = replace(L1Objective(), rendering_stride=1, rendering_lights=8)(network, batch, seeded(0))
    assert float(terms["rendering"]) == pytest.approx(float(full["rendering"]), rel=0.5)


def test_low_precision_outputs_are_compared_in_single(batch: TrainingBatch) -> None:
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss, terms = L1Objective()(Generator(TINY).eval(), batch, seeded(0))
    assert loss.dtype == torch.float32
    assert {term.dtype for term in terms.values()} == {torch.float32}
