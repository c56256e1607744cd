"""Objectives: every term against its closed form, their weights, and what they ask of the random stream."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from losses.adversarial import accuracy, discriminator_loss, feature_matching, generator_loss
from losses.objective import HybridObjective, L1Objective, RealObjective, SyntheticObjective
from losses.presets import AS_CODED, BASELINES, KINDS, NARROW, PAPER, PRESETS, find_objective, override
from losses.reflectance import encoded_difference, log_l1, rendering_pair
from losses.score import GAIN_RANGE, Score, TermWeights, build_critics, exposure_gain, random_window
from losses.vgg import CK17, CONVOLUTIONS, VGGFeatures, perceptual_distance
from losses.with_vgg import give_vgg, needs_vgg, vgg_distance
from nets.architectures import NetworkConfig, build
from nets.baselines.autoencoder import AutoencoderConfig
from nets.baselines.des18 import Des18Config
from nets.baselines.des19 import Des19Config
from nets.color import gamma_encode, to_network_input
from nets.data.pairs import PairBatch
from nets.discriminator import Judgement
from nets.generator import Generator, GeneratorConfig, maps_to_svbrdf, svbrdf_to_maps
from nets.light_head import light_from_output, light_to_output
from nets.render import Camera, PointLight, render
from nets.svbrdf import CHANNELS, MAPS, SVBRDF
from nets.trainer import Trainer
from nets.training import BatchSource, Losses, Phase, TrainerConfig, TrainingBatch
from tests.helpers import assert_close, random_light, random_svbrdf, seeded

TINY = GeneratorConfig(width=2, levels=3, deep_multiplier=2)
WHITE = torch.ones(2, 3)


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


class Witness(Generator):
    """Knows what each photo it may be shown is of: the maps of one, the light of another."""

    def __init__(self, *known: tuple[Tensor, SVBRDF, Tensor]) -> None:
        super().__init__(TINY)
        self.known = known

    def forward(self, photo: Tensor) -> tuple[Tensor, Tensor]:
        for seen, material, position in self.known:
            if torch.equal(photo, to_network_input(seen)):
                return svbrdf_to_maps(material), light_to_output(position)
        raise AssertionError("a photo it does not know")

    def estimate_light(self, photo: Tensor) -> Tensor:
        return self.forward(photo)[1]


class Blind(nn.Module):
    """A critic that gives the truth 3/4 and the estimate 1/4, and finds 1/8 between their features."""

    def forward(self, candidate: Tensor, condition: Tensor) -> list[Judgement]:
        half = candidate.shape[0] // 2
        sides = torch.cat([torch.zeros(half, 1, 2, 2), torch.ones(half, 1, 2, 2)])
        return [Judgement((sides / 8.0,), 0.75 - 0.5 * sides)]


@pytest.fixture
def batch() -> TrainingBatch:
    truth, light = random_svbrdf(2, 16, 24), random_light(2)
    return TrainingBatch(render(truth, light), truth, light)


@pytest.fixture
def hybrid_batch(batch: TrainingBatch) -> TrainingBatch:
    surface = random_svbrdf(1, 16, 24, seed=7)
    a, b = (render(surface, random_light(1, seed=seed)).clamp(0.0, 1.0) for seed in (8, 9))
    return replace(batch, pairs=PairBatch(a, b))


def critics_of(objective: Any) -> nn.ModuleDict:
    torch.manual_seed(3)
    return build_critics(objective.judged, width=2, layers=1, scales=2)


def blind(objective: Any) -> nn.ModuleDict:
    return nn.ModuleDict({name: Blind() for name in objective.judged})


def difference(a: Tensor, b: Tensor) -> Tensor:
    """Stand in for VGG."""
    return (a - b).abs().mean()


def tiny_vgg() -> dict[str, Tensor]:
    """Random weights of a VGG-16 that is two channels wide."""
    generator, state, inputs = seeded(11), {}, 3
    for name in CONVOLUTIONS:
        state[f"{name}.weight"] = 0.4 * torch.randn(2, inputs, 3, 3, generator=generator)
        state[f"{name}.bias"] = 0.1 * torch.randn(2, generator=generator)
        inputs = 2
    return state


def numbers(terms: dict[str, Tensor]) -> dict[str, float]:
    return {name: float(term.detach()) for name, term in terms.items()}


# L1


def test_the_answer_costs_nothing(batch: TrainingBatch) -> None:
    losses = L1Objective()(Oracle(batch), nn.ModuleDict(), batch, seeded(0))
    assert float(losses.generator) == pytest.approx(0.0, abs=1e-5)
    assert set(losses.terms) == {*MAPS, "rendering", "light"}
    assert losses.critics is None
    assert L1Objective().judged == {}


def test_the_light_term_is_of_standardised_positions(batch: TrainingBatch) -> None:
    losses = L1Objective(light_weight=0.2)(Oracle(batch, light_error=0.5), nn.ModuleDict(), batch, seeded(0))
    assert float(losses.terms["light"]) == pytest.approx(0.5, rel=1e-5)
    assert float(losses.generator) == pytest.approx(0.1, abs=1e-4)


@pytest.mark.parametrize(
    "weights", [(1.0, 1.0, 0.0, 0.0), (0.0, 1.0, 1.0, 0.0), (0.0, 1.0, 0.0, 1.0), (1.0, 5.0, 2.0, 3.0)]
)
def test_the_loss_is_the_weighted_sum(
    batch: TrainingBatch, weights: tuple[float, float, float, float]
) -> None:
    losses = L1Objective(*weights)(Generator(TINY).eval(), nn.ModuleDict(), batch, seeded(0))
    terms, (maps, normal, rendering, light) = numbers(losses.terms), weights
    expected = maps * (normal * terms["normal"] + sum(terms[name] for name in MAPS if name != "normal"))
    expected += rendering * terms["rendering"] + light * terms["light"]
    assert float(losses.generator.detach()) == pytest.approx(expected, rel=1e-5)
    assert all(term > 0.0 for term in terms.values())


def test_gradients_reach_every_parameter(batch: TrainingBatch) -> None:
    network = Generator(TINY)
    L1Objective()(network, nn.ModuleDict(), batch, seeded(0)).generator.backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert bool(torch.isfinite(parameter.grad).all()), name


@torch.no_grad()
def test_the_stream_decides(batch: TrainingBatch) -> None:
    network = Generator(TINY).eval()
    first, again, other = (
        float(L1Objective()(network, nn.ModuleDict(), batch, seeded(seed)).generator) for seed in (1, 1, 2)
    )
    assert first == again
    assert first != other


@pytest.mark.parametrize(("stride", "lights"), [(1, 1), (2, 3), (5, 2)])
def test_strides_and_lights_change_the_sample_and_not_the_scale(
    batch: TrainingBatch, stride: int, lights: int
) -> None:
    network, none = Generator(TINY).eval(), nn.ModuleDict()
    objective = replace(L1Objective(), rendering_stride=stride, rendering_lights=lights)
    full = replace(L1Objective(), rendering_stride=1, rendering_lights=8)
    with torch.no_grad():
        found, expected = (o(network, none, batch, seeded(0)).terms["rendering"] for o in (objective, full))
    assert float(found) == pytest.approx(float(expected), rel=0.5)


def test_low_precision_outputs_are_compared_in_single(hybrid_batch: TrainingBatch) -> None:
    for objective in (L1Objective(), override(PAPER, {"synthetic": {"rendering": {"perceptual": 0.0}}})):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            losses = objective(Generator(TINY).eval(), critics_of(objective), hybrid_batch, seeded(0))
        assert losses.generator.dtype == torch.float32
        assert {term.dtype for term in losses.terms.values()} == {torch.float32}


# Eq. 1 to 3


def test_the_answer_costs_what_the_critics_say(batch: TrainingBatch) -> None:
    objective = SyntheticObjective(perceptual=difference)
    losses = objective(Oracle(batch), blind(objective), batch, seeded(0))
    terms = numbers(losses.terms)
    for name in (*MAPS, "rendering"):
        assert terms[name] == pytest.approx(0.0, abs=1e-6)
        assert terms[f"{name} adversarial"] == pytest.approx(0.75**2)
        assert terms[f"{name} features"] == pytest.approx(4.0 / 8.0)
        assert terms[f"{name} accuracy"] == 1.0
    assert terms["light"] == pytest.approx(0.0, abs=1e-6)
    assert terms["rendering perceptual"] == pytest.approx(0.0, abs=1e-6)
    # 4 maps and lambda_r = 5 renderings, each 1 x 0.75^2 + 10 x 1/2.
    assert float(losses.generator) == pytest.approx((4.0 + 5.0) * (0.75**2 + 5.0), abs=1e-4)
    assert losses.critics is not None
    assert float(losses.critics) == pytest.approx(5.0 * 0.5 * (0.25**2 + 0.25**2))


@pytest.mark.parametrize("preset", [PAPER, AS_CODED, NARROW], ids=["paper", "as_coded", "narrow"])
def test_eq_1_adds_up_what_it_says(batch: TrainingBatch, preset: HybridObjective) -> None:
    objective = replace(preset.synthetic, perceptual=difference)
    losses = objective(Generator(TINY).eval(), critics_of(objective), batch, seeded(0))
    terms, maps, shown = numbers(losses.terms), objective.maps, objective.rendering
    expected = objective.light_weight * terms["light"]
    for name in MAPS:
        factor = objective.normal_factor if name == "normal" else 1.0
        expected += factor * (maps.l1 * terms[name] + maps.l2 * terms.get(f"{name} squared", 0.0))
        expected += maps.adversarial * terms[f"{name} adversarial"]
        expected += maps.feature * terms[f"{name} features"]
    expected += objective.rendering_weight * (
        shown.adversarial * terms["rendering adversarial"]
        + shown.feature * terms["rendering features"]
        + shown.l1 * terms["rendering"]
        + shown.l2 * terms.get("rendering squared", 0.0)
        + shown.perceptual * terms["rendering perceptual"]
    )
    assert float(losses.generator.detach()) == pytest.approx(expected, rel=1e-5)
    assert all(math.isfinite(term) and term >= 0.0 for term in terms.values())
    assert ("normal squared" in terms) == (preset is NARROW)


def test_the_median_pleases_l1_and_the_mean_l2() -> None:
    truth = torch.tensor([0.0, 0.0, 0.0, 1.0])
    guesses = torch.linspace(0.0, 1.0, 101)

    def best(weights: TermWeights) -> float:
        sums = []
        for guess in guesses:
            score = Score()
            score.measure("normal", guess - truth, weights)
            sums.append(sum(score.generator))
        return float(guesses[int(torch.stack(sums).argmin())])

    assert best(TermWeights(l1=1.0)) == 0.0
    assert best(TermWeights(l1=0.0, l2=1.0)) == pytest.approx(0.25)
    assert 0.0 < best(TermWeights(l1=0.1, l2=1.0)) < 0.25


def test_the_paper_s_weights() -> None:
    assert HybridObjective() == PAPER
    synthetic, real = PAPER.synthetic, PAPER.real
    assert synthetic.maps == TermWeights(adversarial=1.0, feature=10.0, l1=10.0, perceptual=0.0, l2=0.0)
    assert synthetic.rendering == TermWeights(adversarial=1.0, feature=10.0, l1=50.0, perceptual=10.0)
    assert (synthetic.rendering_weight, synthetic.light_weight) == (5.0, 10.0)
    assert real.rendering == TermWeights(adversarial=1.0, feature=10.0, l1=50.0, perceptual=0.0)
    assert PAPER.real_weight == 5.0
    nothing_of_ours = (synthetic.normal_factor, synthetic.more_lights, synthetic.log_offset)
    assert nothing_of_ours == (1.0, 0, 0.0)
    assert (synthetic.window, synthetic.perceptual_samples, synthetic.perceptual_layers) == (0, 0, 0)


def test_the_weights_of_the_authors_code() -> None:
    assert AS_CODED.synthetic.maps == TermWeights(adversarial=0.2, feature=2.0, l1=10.0, perceptual=0.0)
    assert AS_CODED.real.rendering == TermWeights(adversarial=1.0, feature=10.0, l1=50.0, perceptual=10.0)
    assert AS_CODED.real_weight == 1.0
    same = override(
        AS_CODED,
        {"real_weight": 5.0, "synthetic": {"maps": {"adversarial": 1.0, "feature": 10.0}},
         "real": {"rendering": {"perceptual": 0.0}}},
    )  # fmt: skip
    assert same == PAPER


def recompute(
    objective: SyntheticObjective, network: Generator, critics: nn.ModuleDict, batch: TrainingBatch
) -> dict[str, Tensor]:
    """Write Eq. 1's terms out again, critics asked twice and separately, in float64-free plain steps."""
    condition = to_network_input(batch.photo)
    maps, light = network(condition)
    estimate = maps_to_svbrdf(maps)
    lights = objective.lights.sample(batch.truth.batch, seeded(0))
    rendering, reference = render(estimate, lights), render(batch.truth, lights)
    judged = {name: (svbrdf_to_maps(estimate), svbrdf_to_maps(batch.truth)) for name in MAPS}
    start = 0
    for name in MAPS:
        ours, theirs = judged[name]
        judged[name] = (ours[:, start : start + CHANNELS[name]], theirs[:, start : start + CHANNELS[name]])
        start += CHANNELS[name]
    expected = {name: (ours - theirs).abs().mean() for name, (ours, theirs) in judged.items()}
    judged["rendering"] = (gamma_encode(rendering) * 2 - 1, gamma_encode(reference) * 2 - 1)
    for name, (ours, theirs) in judged.items():
        fake, real = critics[name](ours, condition), critics[name](theirs, condition)
        expected[f"{name} adversarial"] = generator_loss(fake)
        expected[f"{name} features"] = feature_matching(real, fake)
        expected[f"{name} accuracy"] = accuracy(real, fake)
        expected[f"{name} critic"] = discriminator_loss(real, fake)
    white = reference >= 1.0
    seen = torch.where(white, rendering.clamp(max=1.0), rendering).clamp(min=1e-3) ** (1 / 2.2)
    expected["rendering"] = (seen - reference.clamp(1e-3, 1.0) ** (1 / 2.2)).abs().mean()
    expected["light"] = (light - light_to_output(batch.light.position)).abs().mean()
    expected["rendering perceptual"] = difference(gamma_encode(rendering), gamma_encode(reference))
    return expected


def test_every_term_of_eq_1_against_its_definition(batch: TrainingBatch) -> None:
    objective = SyntheticObjective(perceptual=difference)
    network, critics = Generator(TINY).eval(), critics_of(objective)
    losses = objective(network, critics, batch, seeded(0))
    expected = recompute(objective, network, critics, batch)
    told = [expected.pop(f"{name} critic") for name in (*MAPS, "rendering")]
    assert set(losses.terms) == set(expected)
    for name, value in expected.items():
        assert_close(losses.terms[name].detach(), value.detach(), rtol=1e-4, atol=1e-6)
    assert losses.critics is not None
    assert_close(losses.critics.detach(), torch.stack(told).sum().detach(), rtol=1e-4)


def test_the_first_stage_knows_no_renderings(batch: TrainingBatch) -> None:
    objective = SyntheticObjective(rendering_weight=0.0)  # and needs no VGG
    assert objective.judged == CHANNELS
    assert SyntheticObjective().judged == {**CHANNELS, "rendering": 3}
    losses = objective(Generator(TINY).eval(), critics_of(objective), batch, seeded(0))
    assert not any(name.startswith("rendering") for name in losses.terms)
    assert {name for name in losses.terms if " " not in name} == {*MAPS, "light"}


@pytest.mark.parametrize("judged", [(), ("maps",), ("rendering",)])
def test_without_weights_there_are_no_critics(hybrid_batch: TrainingBatch, judged: tuple[str, ...]) -> None:
    def weights(what: str) -> TermWeights:
        return TermWeights() if what in judged else TermWeights(adversarial=0.0, feature=0.0)

    objective = HybridObjective(
        SyntheticObjective(maps=weights("maps"), rendering=weights("rendering")),
        RealObjective(rendering=weights("real")),
    )
    expected = {*(MAPS if "maps" in judged else ()), *(("rendering",) if "rendering" in judged else ())}
    assert set(objective.judged) == expected
    losses = objective(Generator(TINY).eval(), critics_of(objective), hybrid_batch, seeded(0))
    assert {n.split()[0] for n in losses.terms if n.endswith("adversarial")} == expected
    assert (losses.critics is None) == (not judged)
    losses.generator.backward()


def test_without_vgg_its_weight_is_refused(batch: TrainingBatch) -> None:
    objective = SyntheticObjective()
    with pytest.raises(ValueError, match="give it the VGG or the weight 0"):
        objective(Generator(TINY).eval(), critics_of(objective), batch, seeded(0))


def test_normals_are_judged_as_the_material_has_them(batch: TrainingBatch) -> None:
    seen: dict[str, Tensor] = {}

    class Watching(Blind):
        def forward(self, candidate: Tensor, condition: Tensor) -> list[Judgement]:
            seen["normal"] = candidate
            return super().forward(candidate, condition)

    objective = SyntheticObjective(rendering_weight=0.0)
    critics = blind(objective)
    critics["normal"] = Watching()
    objective(Oracle(batch, maps_error=0.3), critics, batch, seeded(0))
    lengths = seen["normal"].norm(dim=1)
    assert_close(lengths, torch.ones_like(lengths))
    assert float((seen["normal"][:2] - seen["normal"][2:]).abs().max()) > 0.05


def test_gradients_of_eq_5_reach_every_parameter(hybrid_batch: TrainingBatch) -> None:
    objective = replace(PAPER, synthetic=replace(PAPER.synthetic, perceptual=difference))
    network, critics = Generator(TINY), critics_of(objective)
    losses = objective(network, critics, hybrid_batch, seeded(0))
    assert losses.critics is not None
    torch.autograd.backward(losses.critics, inputs=list(critics.parameters()), retain_graph=True)
    torch.autograd.backward(losses.generator, inputs=list(network.parameters()))
    for players in (network, critics):
        for name, parameter in players.named_parameters():
            assert parameter.grad is not None, name
            assert bool(torch.isfinite(parameter.grad).all()), name
    # Biases before a normalisation do nothing; everything else is felt.
    silent = [n for n, p in critics.named_parameters() if not bool(p.grad.abs().max() > 0.0)]  # type: ignore[union-attr]
    assert all(name.endswith("bias") for name in silent)
    still = [n for n, p in network.named_parameters() if not bool(p.grad.abs().max() > 0.0)]  # type: ignore[union-attr]
    assert still == []


def test_more_lights_are_weighed_like_the_first(batch: TrainingBatch) -> None:
    network = Generator(TINY).eval()
    objective = SyntheticObjective(rendering=TermWeights(perceptual=0.0), more_lights=2, log_offset=0.1)
    with torch.no_grad():
        found = objective(network, critics_of(objective), batch, seeded(0)).terms["rendering"]
        maps, _ = network(batch.network_input)
        estimate, stream = maps_to_svbrdf(maps), seeded(0)
        first = objective.lights.sample(2, stream)
        more = objective.lights.sample(4, stream)
        every = slice(None, None, 2)
        sparse, truth = (m.map(lambda t: t[..., every, every]) for m in (estimate, batch.truth))
        one = log_l1(*rendering_pair(estimate, batch.truth, first), 0.1)
        others = log_l1(*rendering_pair(sparse, truth, more), 0.1)
    assert float(one) != pytest.approx(float(others), rel=1e-3)
    assert_close(found, (one + 2 * others) / 3)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_revision_is_told_so_many_of_the_true_lights(batch: TrainingBatch, share: float) -> None:
    network = Generator(replace(TINY, revision_channels=4)).eval()
    asked: list[PointLight | None] = []

    def listening(photo: Tensor, known: PointLight | None = None) -> tuple[Tensor, Tensor]:
        asked.append(known)
        return Generator.forward(network, photo, known)

    network.forward = listening  # type: ignore[method-assign]
    no_critic = TermWeights(adversarial=0.0, feature=0.0, perceptual=0.0)
    objective = SyntheticObjective(maps=no_critic, rendering=no_critic, told_share=share)
    guess = light_from_output(network.estimate_light(batch.network_input)).position
    counts = {"told": 0, "guessed": 0}
    for seed in range(20):
        objective(network, nn.ModuleDict(), batch, seeded(seed))
        known = asked[-1]
        if known is None:
            continue
        for position, true, guessed in zip(known.position, batch.light.position, guess, strict=True):
            counts["told"] += torch.equal(position, true)
            counts["guessed"] += torch.equal(position, guessed)
    assert sum(counts.values()) == (20 * len(guess) if share else 0)
    assert counts["told"] == pytest.approx(share * 20 * len(guess), abs=12 * (share == 0.5))


def test_vgg_sees_as_many_as_it_is_shown(batch: TrainingBatch) -> None:
    seen = []

    def watching(a: Tensor, b: Tensor) -> Tensor:
        seen.append((tuple(a.shape), tuple(b.shape), float(a.detach().max()), float(b.max())))
        return difference(a, b)

    for samples, window in ((0, 0), (1, 8)):
        objective = SyntheticObjective(perceptual=watching, perceptual_samples=samples, window=window)
        objective(Generator(TINY).eval(), critics_of(objective), batch, seeded(0))
    assert [shapes[:2] for shapes in seen] == [((2, 3, 16, 24),) * 2, ((1, 3, 8, 8),) * 2]
    assert all(most <= 1.0 for _, _, *highest in seen for most in highest)


# Windows


def test_a_window_is_one_square_of_every_picture() -> None:
    image = torch.arange(2 * 3 * 9 * 12.0).reshape(2, 3, 9, 12)
    corners = set()
    for seed in range(60):
        cut = random_window(5, image, seeded(seed))
        piece, other = cut(image), cut(image[:, :1] + 0.5)
        assert piece.shape == (2, 3, 5, 5)
        assert torch.equal(piece[:, :1] + 0.5, other)
        top, left = divmod(int(piece[0, 0, 0, 0]), 12)
        assert torch.equal(piece, image[..., top : top + 5, left : left + 5])
        corners.add((top, left))
    assert {top for top, _ in corners} == set(range(5))
    assert {left for _, left in corners} == set(range(8))


@pytest.mark.parametrize("side", [0, 9, 10])
def test_no_window_cuts_nothing(side: int) -> None:
    image, stream = torch.rand(1, 3, 9, 12, generator=seeded(0)), seeded(1)
    before = stream.get_state()
    assert random_window(side, image, stream)(image) is image
    assert torch.equal(stream.get_state(), before)


# Eq. 4


def pair_of(gain: float = 1.0) -> tuple[Witness, TrainingBatch]:
    """Return two surfaces, seen under two lights each, and a network that knows what is on each photo."""
    first, second = (random_svbrdf(2, 16, 24, seed=seed) for seed in (1, 2))
    light_a, light_b = (random_light(2, seed=seed).position for seed in (3, 4))
    a = render(first, PointLight(light_a, WHITE)).clamp(0.0, 1.0)
    b = (gain * render(first, PointLight(light_b, WHITE))).clamp(0.0, 1.0)
    known = Witness((a, first, light_a), (b, second, light_b))  # of b only the light is right
    unused, light = random_svbrdf(1, 8, 8), random_light(1)
    return known, TrainingBatch(render(unused, light), unused, light, PairBatch(a, b))


def test_maps_are_from_a_and_the_light_from_b() -> None:
    network, batch = pair_of()
    assert batch.pairs is not None
    objective = RealObjective(match_exposure=False)
    losses = objective(network, blind(objective), batch, seeded(0))
    assert float(losses.terms["real"]) == pytest.approx(0.0, abs=1e-6)
    swapped = replace(batch, pairs=PairBatch(batch.pairs.b, batch.pairs.a))
    wrong = objective(network, blind(objective), swapped, seeded(0))
    assert float(wrong.terms["real"]) > 0.02
    # 1 x 0.75^2 + 10 x 4/8 + 50 x 0
    assert float(losses.generator) == pytest.approx(0.75**2 + 5.0, abs=1e-3)
    assert losses.critics is not None
    assert float(losses.critics) == pytest.approx(0.5 * 2 * 0.25**2)


def test_the_critic_sees_a_the_rendering_and_b() -> None:
    network, batch = pair_of()
    seen: list[Tensor] = []

    class Watching(Blind):
        def forward(self, candidate: Tensor, condition: Tensor) -> list[Judgement]:
            seen.extend([candidate, condition])
            return super().forward(candidate, condition)

    objective = RealObjective(match_exposure=False)
    objective(network, nn.ModuleDict({"real": Watching()}), batch, seeded(0))
    assert batch.pairs is not None
    encoded = to_network_input(batch.pairs.b)
    assert_close(seen[0], torch.cat([encoded, encoded]), atol=1e-4)  # the truth first, then the rendering
    assert_close(seen[1], torch.cat([to_network_input(batch.pairs.a)] * 2))


def test_exposure_is_matched_where_it_can_be() -> None:
    objective = RealObjective()
    network, batch = pair_of(gain=0.5)
    matched = objective(network, blind(objective), batch, seeded(0)).terms["real"]
    plain = replace(objective, match_exposure=False)
    unmatched = plain(network, blind(objective), batch, seeded(0)).terms["real"]
    assert float(matched) == pytest.approx(0.0, abs=1e-4)
    assert float(unmatched) > 0.1


def test_exposure_gain_is_least_squares_on_what_is_not_clipped() -> None:
    rendering = torch.rand(3, 3, 4, 5, generator=seeded(0)) + 0.1
    gains = torch.tensor([0.5, 1.5, 40.0])[:, None, None, None]
    photo = gains * rendering
    found = exposure_gain(rendering, photo.clamp(max=1.0))
    assert found.shape == (3, 1, 1, 1)
    assert_close(found[:2].flatten(), torch.tensor([0.5, 1.5]))
    assert float(found[2]) == GAIN_RANGE[0]  # all white: nothing is known, and the factor stays in range
    noisy = (photo[:1] + 0.1 * torch.rand(1, 3, 4, 5, generator=seeded(1))).clamp(max=0.99)
    solved = torch.linalg.lstsq(rendering[:1].reshape(-1, 1), noisy.reshape(-1, 1)).solution
    assert float(exposure_gain(rendering[:1], noisy)) == pytest.approx(float(solved), rel=1e-4)
    dark = exposure_gain(rendering[:1], torch.full_like(rendering[:1], 0.999) * 5.0 * rendering[:1])
    assert GAIN_RANGE[0] <= float(dark) <= GAIN_RANGE[1] == 4.0


def test_no_gradient_flows_through_the_exposure(hybrid_batch: TrainingBatch) -> None:
    objective = RealObjective(rendering=TermWeights(adversarial=0.0, feature=0.0, l1=1.0))
    network = Generator(TINY).eval()
    critics = critics_of(objective)
    with torch.no_grad():
        assert hybrid_batch.pairs is not None
        maps, _ = network(hybrid_batch.pairs.network_input)
        _, light = network(hybrid_batch.pairs.network_input_b)
    answer = maps.clone().requires_grad_(True)

    class Fixed(Generator):
        def forward(self, photo: Tensor) -> tuple[Tensor, Tensor]:
            return answer, light

        def estimate_light(self, photo: Tensor) -> Tensor:
            return light

    objective(Fixed(TINY), critics, hybrid_batch, seeded(0)).generator.backward()
    found = answer.grad
    leaf = maps.clone().requires_grad_(True)
    rendering = render(maps_to_svbrdf(leaf), light_from_output(light), Camera())
    gain = float(exposure_gain(rendering.detach(), hybrid_batch.pairs.b))
    assert gain != pytest.approx(1.0, rel=0.01)
    shown = torch.where(hybrid_batch.pairs.b < 1.0, gain * rendering, (gain * rendering).clamp(max=1.0))
    encoded_difference(shown, hybrid_batch.pairs.b).abs().mean().backward()
    assert found is not None
    assert leaf.grad is not None
    assert_close(found, leaf.grad, rtol=1e-3, atol=1e-8)


def test_real_pairs_are_needed(batch: TrainingBatch) -> None:
    with pytest.raises(ValueError, match="no real pairs; give the training a folder"):
        RealObjective()(Generator(TINY), critics_of(RealObjective()), batch, seeded(0))


# Eq. 5


@pytest.mark.parametrize("weight", [0.0, 1.0, 5.0])
def test_eq_5_is_synthetic_plus_lambda_real(hybrid_batch: TrainingBatch, weight: float) -> None:
    synthetic, real = SyntheticObjective(perceptual=difference), RealObjective()
    objective = HybridObjective(synthetic, real, weight)
    assert objective.judged == {**synthetic.judged, "real": 3}
    network, critics, stream = Generator(TINY).eval(), critics_of(objective), seeded(0)
    with torch.no_grad():
        both = objective(network, critics, hybrid_batch, seeded(0))
        first = synthetic(network, critics, hybrid_batch, stream)
        second = real(network, critics, hybrid_batch, stream)
    assert_close(both.generator, first.generator + weight * second.generator)
    assert both.critics is not None
    assert first.critics is not None
    assert second.critics is not None
    assert_close(both.critics, first.critics + second.critics)
    assert numbers(both.terms) == pytest.approx(numbers({**first.terms, **second.terms}))


# VGG


def test_vgg_is_given_where_it_has_a_weight(batch: TrainingBatch) -> None:
    state = tiny_vgg()
    synthetic = give_vgg(PAPER.synthetic, state)
    assert synthetic == PAPER.synthetic  # weights are data, a network is not
    a, b = torch.rand(2, 1, 3, 32, 32, generator=seeded(0))
    expected = perceptual_distance(a, b, VGGFeatures(state))
    assert synthetic.perceptual is not None
    assert_close(synthetic.perceptual(a, b), expected)
    shallow = vgg_distance(state, 2)
    assert_close(shallow(a, b), perceptual_distance(a, b, VGGFeatures(state, CK17.layers[:2]), CK17.first(2)))
    assert float(shallow(a, b)) != pytest.approx(float(expected))

    given = give_vgg(PAPER, state)
    assert given.synthetic.perceptual is not None
    assert given.real.perceptual is None
    assert give_vgg(AS_CODED, state).real.perceptual is not None
    assert give_vgg(L1Objective(), state) == L1Objective()
    narrow = give_vgg(NARROW, state).synthetic.perceptual
    assert narrow is not None
    assert_close(narrow(a, b), vgg_distance(state, 3)(a, b))


def test_what_needs_vgg() -> None:
    assert needs_vgg(PAPER)
    assert needs_vgg(AS_CODED.real)
    assert not needs_vgg(PAPER.real)
    assert not needs_vgg(L1Objective())
    assert not needs_vgg(replace(PAPER.synthetic, rendering_weight=0.0))
    without = override(PAPER, {"synthetic": {"rendering": {"perceptual": 0.0}}})
    assert not needs_vgg(without)


def test_a_tiny_vgg_moves_the_generator() -> None:
    truth, light = random_svbrdf(1, 32, 32), random_light(1)
    batch = TrainingBatch(render(truth, light), truth, light)
    only = SyntheticObjective(
        maps=TermWeights(0.0, 0.0, 0.0),
        rendering=TermWeights(0.0, 0.0, 0.0, perceptual=1.0),
        rendering_weight=2.0,
        light_weight=0.0,
    )
    network = Generator(TINY)
    objective = give_vgg(only, tiny_vgg())
    losses = objective(network, critics_of(objective), batch, seeded(0))
    expected = 2.0 * float(losses.terms["rendering perceptual"].detach())
    assert expected > 0.0
    assert float(losses.generator.detach()) == pytest.approx(expected)
    losses.generator.backward()
    gradient = network.encoder[0].weight.grad
    assert gradient is not None
    assert float(gradient.abs().max()) > 0.0


# Score, critics, presets


def test_a_score_adds_what_it_is_told() -> None:
    score = Score()
    score.add("a", 2.0, torch.tensor(3.0))
    score.add("b", 0.5, torch.tensor(4.0))
    score.critics.append(torch.tensor(7.0))
    losses = score.losses()
    assert (float(losses.generator), numbers(losses.terms)) == (8.0, {"a": 3.0, "b": 4.0})
    assert losses.critics is not None
    assert float(losses.critics) == 7.0


def test_critics_are_built_for_what_is_judged() -> None:
    critics = build_critics(PAPER.judged, width=2, layers=1, scales=2)
    assert set(critics) == {*MAPS, "rendering", "real"}
    for name, channels in PAPER.judged.items():
        assert critics[name].config.channels == channels
        critics[name](torch.zeros(1, channels, 8, 8), torch.zeros(1, 3, 8, 8))
    assert not list(build_critics({}))


def test_objectives_by_name() -> None:
    assert set(PRESETS) == {"paper", "as_coded", "narrow"}
    assert ("l1", "synthetic", "hybrid", "light", *BASELINES) == KINDS
    assert find_objective("l1") == L1Objective()
    assert find_objective("synthetic", "narrow") == NARROW.synthetic
    assert find_objective("hybrid", "as_coded") == AS_CODED
    changed = find_objective(
        "hybrid", "paper", {"real_weight": 2, "real": {"camera": {"kind": "collocated"}}}
    )
    assert changed == replace(PAPER, real_weight=2.0, real=RealObjective(camera=Camera("collocated")))
    lights = find_objective("l1", overrides={"lights": {"distance_range": [2, 3.5]}})
    assert isinstance(lights, L1Objective)
    assert lights.lights.distance_range == (2.0, 3.5)


@pytest.mark.parametrize(
    ("kind", "preset", "overrides", "hint"),
    [
        ("l2", "paper", {}, "no objective is called 'l2'; the known ones are l1, synthetic, hybrid"),
        ("hybrid", "soup", {}, "no preset is called 'soup'; the known ones are paper, as_coded, narrow"),
        ("l1", "paper", {"soup": 1.0}, "L1Objective has no 'soup'; it has map_weight"),
        ("synthetic", "paper", {"maps": {"l3": 1.0}}, "TermWeights has no 'l3'"),
        ("synthetic", "paper", {"maps": 3.0}, "SyntheticObjective.maps must be of type TermWeights"),
        ("synthetic", "paper", {"window": 1.5}, "window must be of type int, got 1.5"),
        ("synthetic", "paper", {"window": True}, "window must be of type int, got True"),
        ("l1", "paper", {"map_weight": "2e-5"}, "must be of type float, got '2e-5'; YAML writes"),
        ("l1", "paper", {"lights": {"distance_range": [1.0]}}, "distance_range must have 2 values"),
        ("l1", "paper", {"lights": {"distance_range": [1.0, "x"]}}, "must be of type float, got 'x'"),
        ("hybrid", "paper", {"real": {"match_exposure": 1}}, "match_exposure must be of type bool"),
        ("synthetic", "paper", {"perceptual": 1.0}, "perceptual must be of type NoneType"),
    ],
)
def test_objectives_that_cannot_be_are_named(
    kind: str, preset: str, overrides: dict[str, Any], hint: str
) -> None:
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        find_objective(kind, preset, overrides)
    assert hint in str(caught.value)
    assert "\n" not in str(caught.value)


def test_objectives_are_plain_data() -> None:
    given = give_vgg(AS_CODED, tiny_vgg())
    data = given.as_dict()
    maps = {"adversarial": 0.2, "feature": 2.0, "l1": 10.0, "perceptual": 0.0, "l2": 0.0}
    assert data["synthetic"]["maps"] == maps
    assert data["real"]["camera"]["kind"] == "perspective"
    assert data["synthetic"]["perceptual"] is data["real"]["perceptual"] is None
    assert data == AS_CODED.as_dict()


# Training improves what is trained


def held_out(side: int, seed: int = 100) -> TrainingBatch:
    truth, light = random_material(4, seed, side), random_light(4, seed=seed)
    surface = random_material(2, seed + 1, side)
    a, b = (render(surface, random_light(2, seed=seed + n)).clamp(0.0, 1.0) for n in (2, 3))
    return TrainingBatch(render(truth, light), truth, light, PairBatch(a, b))


def random_material(batch: int, seed: int, side: int) -> SVBRDF:
    """Draw flat coloured surfaces with a little relief: something to learn in 200 steps.

    Relief of single pixels does not pass through a latent code of one pixel, so large ones have none.
    """
    fine = random_svbrdf(batch, side, side, seed=seed, tilt=0.2 if side == 16 else 0.0)
    plain = fine.map(lambda tensor: tensor.mean(dim=(2, 3), keepdim=True) * torch.ones_like(tensor))
    colour = random_svbrdf(batch, 1, 1, seed=seed + 10_000, roughness=(0.4, 0.9))
    even = colour.map(lambda tensor: tensor.expand(-1, -1, side, side))
    return SVBRDF(fine.normal, even.diffuse, even.roughness, 0.2 * even.specular + 0.0 * plain.specular)


def lit_source(batch: int, crop: int, generator: torch.Generator) -> TrainingBatch:
    seed = 1000 + int(torch.randint(5000, (1,), generator=generator))
    truth, light = random_material(batch, seed, crop), random_light(batch, seed=seed)
    surface = random_material(1, seed + 1, crop)
    a, b = (render(surface, random_light(1, seed=seed + n)).clamp(0.0, 1.0) for n in (2, 3))
    return TrainingBatch(render(truth, light), truth, light, PairBatch(a, b))


NO_CRITIC = {"adversarial": 0.0, "feature": 0.0}
WITHOUT_CRITICS = {"maps": NO_CRITIC, "rendering": {**NO_CRITIC, "perceptual": 0.0}}

STAGES = {
    "l1": find_objective("l1"),
    "maps": find_objective("synthetic", "paper", {"rendering_weight": 0.0}),
    "syn": replace(PAPER.synthetic, perceptual=difference),
    "hyb": replace(PAPER, synthetic=replace(PAPER.synthetic, perceptual=difference)),
    "revise": find_objective("synthetic", "narrow", WITHOUT_CRITICS),
    **{name: replace(objective, stride=1) for name, objective in BASELINES.items()},
}
NETWORKS: dict[str, NetworkConfig] = {
    "revise": GeneratorConfig(width=4, levels=3, deep_multiplier=2, revision_channels=8),
    "des18": Des18Config(width=4, levels=2, deep_multiplier=2),
    "des19": Des19Config(width=4, levels=2, deep_multiplier=2),
    "gao19": AutoencoderConfig(width=8),
}
"""Other than the plain generator."""

PARTS = {"revise": ("revision",)}
"""What is trained, where it is not all."""


@pytest.mark.usefixtures("unchecked")  # which takes a third of the time
@pytest.mark.parametrize("name", STAGES)
def test_200_iterations_of_every_stage_improve_its_objective(name: str) -> None:
    objective = STAGES[name]
    torch.manual_seed(0)
    # Nothing in the auto-encoder is normalised, and its code is a 32nd of the material.
    side, rate, count = (32, 1e-2, 4) if name == "gao19" else (16, 2e-3, 2)
    config = TrainerConfig((Phase(200, crop=side, batch=count),), learning_rate=rate, warmup=10, seed=1)
    source: BatchSource = lit_source
    run = Trainer(
        build(NETWORKS.get(name, GeneratorConfig(width=4, levels=2, deep_multiplier=2))),
        source,
        objective,
        config,
        build_critics(objective.judged, width=4, layers=1, scales=1),
        parts=PARTS.get(name, ()),
    )
    batch = held_out(side)

    def supervised() -> dict[str, float]:
        run.network.eval()
        with torch.no_grad():
            losses: Losses = objective(run.network, run.critics, batch, seeded(0))
        told = numbers(losses.terms)
        return {key: told[key] for key in told if " " not in key and (key, name) != ("light", "revise")}

    before = supervised()
    while not run.done:
        run.step()
    after = supervised()
    assert (
        set(before)
        == {
            "l1": {*MAPS, "light", "rendering"},
            "maps": {*MAPS, "light"},
            "syn": {*MAPS, "light", "rendering"},
            "hyb": {*MAPS, "light", "rendering", "real"},
            "revise": {*MAPS, "rendering"},
            "des18": {"rendering"},
            "des19": {*MAPS, "rendering"},
            "gao19": {*MAPS, "rendering"},
        }[name]
    )
    assert all(after[key] < before[key] for key in before)
    assert sum(after.values()) < 0.6 * sum(before.values())
