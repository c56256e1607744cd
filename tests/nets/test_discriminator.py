"""The multi-scale PatchGAN: shapes of pix2pixHD, patch facts, conditioning, and gradients to both players."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from nets.discriminator import Discriminator, DiscriminatorConfig, Judgement, PatchDiscriminator
from tests.helpers import assert_close, seeded

SMALL = DiscriminatorConfig(width=4)

PIX2PIXHD_SHAPES = [(64, 6, 4, 4), (128, 64, 4, 4), (256, 128, 4, 4), (512, 256, 4, 4), (1, 512, 4, 4)]
"""`NLayerDiscriminator(6, 64, 3)`: every convolution with a bias, InstanceNorm without parameters."""


def images(side: int = 64, channels: int = 3, batch: int = 2, seed: int = 0) -> Tensor:
    return torch.rand(batch, channels, side, side, generator=seeded(seed)) * 2.0 - 1.0


def test_the_papers_layers_are_pix2pixhds() -> None:
    network = Discriminator()
    assert len(network.scales) == 2
    for scale in network.scales:
        shapes = [tuple(parameter.shape) for parameter in scale.parameters()]
        assert shapes == [shape for weight in PIX2PIXHD_SHAPES for shape in (weight, weight[:1])]
    assert sum(parameter.numel() for parameter in network.scales[0].parameters()) == 2_767_809


@pytest.mark.parametrize(("side", "patches"), [(256, [35, 19, 11]), (128, [19, 11, 7]), (100, [16, 10, 6])])
def test_patches_per_scale(side: int, patches: list[int]) -> None:
    network = Discriminator(DiscriminatorConfig(width=1, scales=3))
    judgements = network(images(side, batch=1), images(side, batch=1))
    assert [tuple(judgement.logits.shape) for judgement in judgements] == [(1, 1, n, n) for n in patches]


def test_features_are_those_of_every_layer_but_the_last() -> None:
    first, second = Discriminator(SMALL)(images(), images())
    assert [tuple(feature.shape) for feature in first.features] == [
        (2, 4, 33, 33), (2, 8, 17, 17), (2, 16, 9, 9), (2, 32, 10, 10),
    ]  # fmt: skip
    assert [feature.shape[1] for feature in second.features] == [4, 8, 16, 32]


@pytest.mark.parametrize(("layers", "field"), [(1, 16), (2, 34), (3, 70), (4, 142)])
def test_a_logit_sees_its_patch_and_no_more(layers: int, field: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # InstanceNorm sees the whole image; without it the gradient shows the patch.
    monkeypatch.setattr(nn, "InstanceNorm2d", lambda width: nn.Identity())
    config = DiscriminatorConfig(width=2, layers=layers, scales=1, condition_channels=0)
    assert config.receptive_field == field
    picture = images(2 * field + 40, batch=1).requires_grad_(True)
    logits = PatchDiscriminator(config)(picture).logits
    logits[0, 0, logits.shape[2] // 2, logits.shape[3] // 2].backward()
    assert picture.grad is not None
    seen = picture.grad.abs().sum(dim=(0, 1)) > 0
    assert int(seen.any(dim=0).sum()) == field
    assert int(seen.any(dim=1).sum()) == field


@pytest.mark.parametrize("scales", [1, 2, 3])
def test_scales_are_finest_first_and_each_sees_a_smaller_picture(scales: int) -> None:
    network = Discriminator(DiscriminatorConfig(width=4, scales=scales))
    judgements = network(images(), images(seed=1))
    assert len(judgements) == scales
    sides = [judgement.logits.shape[-1] for judgement in judgements]
    assert sides == sorted(sides, reverse=True)
    assert len({judgement.logits.shape[-1] for judgement in judgements}) == scales


def test_the_coarse_scale_sees_the_averaged_picture() -> None:
    network = Discriminator(DiscriminatorConfig(width=4, condition_channels=0))
    picture = images()
    pooled = nn.functional.avg_pool2d(picture, 3, stride=2, padding=1, count_include_pad=False)
    assert_close(network(picture)[1].logits, network.scales[1](pooled).logits)
    flat = torch.full((1, 3, 16, 16), 0.7)
    averaged = nn.functional.avg_pool2d(flat, 3, stride=2, padding=1, count_include_pad=False)
    assert_close(averaged, flat[..., :8, :8])  # padding does not darken the border


def test_scales_have_weights_of_their_own() -> None:
    network = Discriminator(SMALL)
    first, second = (scale.convolutions[0].weight for scale in network.scales)
    assert first is not second
    assert not torch.equal(first, second)


def test_the_verdict_depends_on_the_condition() -> None:
    network = Discriminator(SMALL)
    candidate = images()
    one, other = (network(candidate, images(seed=seed))[0].logits for seed in (1, 2))
    assert not torch.allclose(one, other)


def test_hidden_features_are_normalised() -> None:
    hidden = Discriminator(SMALL)(50.0 * images(), images())[0].features[1]
    before = torch.where(hidden < 0, hidden / 0.2, hidden)  # undo the leaky ReLU
    before = before.detach()
    assert_close(before.mean(dim=(2, 3)), torch.zeros(2, 8), atol=1e-4)
    assert_close(before.std(dim=(2, 3), correction=0), torch.ones(2, 8), atol=1e-2)


def test_initial_weights_are_small() -> None:
    weight = Discriminator(DiscriminatorConfig(width=32)).scales[0].convolutions[2].weight
    assert float(weight.detach().std()) == pytest.approx(0.02, rel=0.05)


def test_gradients_reach_both_players() -> None:
    network = Discriminator(SMALL)
    candidate, condition = images().requires_grad_(True), images(seed=1).requires_grad_(True)
    loss = sum(((judgement.logits - 1.0) ** 2).mean() for judgement in network(candidate, condition))
    assert isinstance(loss, Tensor)
    loss.backward()
    for name, tensor in (*network.named_parameters(), ("candidate", candidate), ("condition", condition)):
        assert tensor.grad is not None, name
        assert bool(torch.isfinite(tensor.grad).all()), name
        if not name.endswith(("convolutions.1.bias", "convolutions.2.bias", "convolutions.3.bias")):
            assert float(tensor.grad.abs().max()) > 0.0, name  # a norm takes a constant away


def test_it_learns_to_tell_two_kinds_apart() -> None:
    network = Discriminator(DiscriminatorConfig(width=8, condition_channels=0, scales=1))
    optimizer = torch.optim.Adam(network.parameters(), 2e-3)
    smooth = torch.linspace(-1, 1, 32).expand(2, 3, 32, 32)
    rough = images(32)

    def loss() -> Tensor:
        (real,), (fake,) = network(smooth), network(rough)
        return ((real.logits - 1.0) ** 2).mean() + (fake.logits**2).mean()

    before = float(loss().detach())
    for _ in range(15):
        optimizer.zero_grad()
        loss().backward()
        optimizer.step()
    assert float(loss().detach()) < 0.5 * before


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("condition", [0, 3])
@pytest.mark.parametrize("size", [(3, 3), (16, 40), (33, 17)])
def test_any_channels_and_sizes(channels: int, condition: int, size: tuple[int, int]) -> None:
    network = Discriminator(DiscriminatorConfig(channels, condition, width=2))
    photo = torch.zeros(1, condition, *size) if condition else None
    judgements = network(torch.zeros(1, channels, *size), photo)
    assert all(isinstance(judgement, Judgement) for judgement in judgements)
    assert all(bool(torch.isfinite(judgement.logits).all()) for judgement in judgements)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("candidate", "condition", "message"),
    [
        (images(channels=1), images(), r"candidate has shape \(2, 1, 64, 64\), expected \(2, 3, 64, 64\)"),
        (images(), images(channels=1), r"condition has shape \(2, 1, 64, 64\), expected \(2, 3, 64, 64\)"),
        (images(), None, r"condition has shape \(2, 0, 64, 64\)"),
        (images(), images(32), r"condition has shape \(2, 3, 32, 32\)"),
        (images(), images(batch=1), r"condition has shape \(1, 3, 64, 64\)"),
        (images(2), images(2), "its sides must be at least 3"),
    ],
)
def test_wrong_inputs_are_named(candidate: Tensor, condition: Tensor | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Discriminator(SMALL)(candidate, condition)


@pytest.mark.parametrize(
    "wrong", [{"scales": 0}, {"layers": 0}, {"width": 0}, {"channels": 0}, {"condition_channels": -1}]
)
def test_impossible_shapes_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="not a discriminator"):
        DiscriminatorConfig(**wrong)


def test_the_config_is_plain_data() -> None:
    assert DiscriminatorConfig(**SMALL.as_dict()) == SMALL
