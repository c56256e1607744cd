"""Des18, Des19 and Gao19's auto-encoder: shapes, sizes, and what each of them promises."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from nets.architectures import CONFIGS, Network, NetworkConfig, build, find_config, kind_of
from nets.baselines.autoencoder import Autoencoder, AutoencoderConfig
from nets.baselines.conventions import CENTRED_FLASH, maps_of
from nets.baselines.des18 import NARROW_DES18, PAPER_DES18, STEEPEST, Des18, Des18Config
from nets.baselines.des19 import PAPER_DES19, Des19, Des19Config
from nets.baselines.unet import TrackedLayer
from nets.generator import GeneratorConfig
from nets.svbrdf import SVBRDF
from tests.helpers import assert_close, random_svbrdf, seeded

TINY: dict[str, NetworkConfig] = {
    "generator": GeneratorConfig(width=2, levels=3, deep_multiplier=2),
    "des18": Des18Config(width=2, levels=3, deep_multiplier=2),
    "des19": Des19Config(width=2, levels=3, deep_multiplier=2),
    "autoencoder": AutoencoderConfig(width=2),
}


def tiny(kind: str, seed: int = 0) -> Network:
    torch.manual_seed(seed)
    return build(TINY[kind]).eval()


def photos(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=seeded(seed)) * 2.0 - 1.0


def free_of(maps: Tensor) -> tuple[Tensor, Tensor]:
    """Return slopes and the other maps."""
    return maps[:, :2] / maps[:, 2:3], maps[:, 3:]


# Kinds


def test_every_kind_is_built_from_its_shape() -> None:
    assert set(TINY) == set(CONFIGS)
    for kind, config in TINY.items():
        assert kind_of(config) == kind
        assert find_config(kind)(**config.as_dict()) == config  # type: ignore[arg-type]
        assert build(config).config == config
    assert Des18Config(4, 5, 6) != Des19Config(4, 5, 6)
    with pytest.raises(ValueError, match="no network is called 'soup'; the known ones are generator, des18"):
        find_config("soup")


@pytest.mark.parametrize("kind", ["des18", "des19", "autoencoder"])
def test_shapes_that_cannot_be_are_refused(kind: str) -> None:
    with pytest.raises(ValueError, match="not a"):
        find_config(kind)(width=0)


# Networks of photos


@pytest.mark.parametrize("kind", ["des18", "des19"])
def test_photos_become_legal_materials_under_a_centred_flash(kind: str) -> None:
    network = tiny(kind).train()
    assert isinstance(network, Des18 | Des19)
    photo = torch.rand(2, 3, 16, 24, generator=seeded(1)) * 1.5
    svbrdf, light = network.predict(photo)
    assert svbrdf.validate().size == (16, 24)
    assert light.position.tolist() == [pytest.approx(CENTRED_FLASH)] * 2
    assert light.intensity.tolist() == [[1.0, 1.0, 1.0]] * 2
    assert network.training  # as it was, though dropout was off
    again, _ = network.predict(photo.clamp(max=1.0))
    assert torch.equal(again.channels(), svbrdf.channels())


@pytest.mark.parametrize("kind", ["des18", "des19", "autoencoder"])
def test_gradients_reach_every_parameter(kind: str) -> None:
    network = tiny(kind).train()
    side = 2 * network.config.multiple
    inputs = 10 if kind == "autoencoder" else 3
    network(photos(2, inputs, side, side)).square().sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.any()), name


@pytest.mark.parametrize("kind", ["des18", "des19", "autoencoder"])
def test_sides_that_do_not_fit_are_named(kind: str) -> None:
    network = tiny(kind)
    inputs = 10 if kind == "autoencoder" else 3
    with pytest.raises(ValueError, match=r"\(1, \d+, 20, 32\), its sides must be multiples of"):
        network(torch.zeros(1, inputs, 20, 32))


def test_nine_channels_are_slopes_and_bounded_maps() -> None:
    free = 3.0 * torch.randn(2, 9, 4, 5, generator=seeded(0))
    slopes, others = free_of(maps_of(free, 3.0))
    assert_close(slopes, 3.0 * torch.tanh(free[:, :2]))
    assert_close(others, torch.tanh(free[:, 2:]))
    steep = maps_of(torch.tensor([50.0, -50.0, *[0.0] * 7]).reshape(1, 9, 1, 1), STEEPEST)
    assert steep[0, :3, 0, 0].tolist() == pytest.approx([x / math.sqrt(19.0) for x in (3.0, -3.0, 1.0)])


@torch.no_grad()
def test_the_global_track_tells_what_normalisation_takes_away() -> None:
    """Features that are larger everywhere are the same to a normalised layer, but not to the track."""
    torch.manual_seed(0)
    # A 1x1 convolution, so that borders do not tell either.
    layer = TrackedLayer(nn.Conv2d(2, 4, 1, bias=False), 4, 4, 4)
    features, state = photos(1, 2, 8, 8), torch.zeros(1, 4)
    dark, told_of_dark = layer(features, state)
    bright, told_of_bright = layer(features + 5.0, state)
    assert_close(bright, dark, atol=1e-3)
    assert float((told_of_bright - told_of_dark).abs().max()) > 0.1
    heard, _ = layer(features, state + 1.0)
    assert_close(heard - dark, layer.merge(state + 1.0)[:, :, None, None].expand_as(dark), atol=1e-5)


def test_the_papers_u_net_has_the_papers_layers() -> None:
    with torch.device("meta"):
        network = Des18(PAPER_DES18)
    widths = [64, 128, 256, 512, 512, 512, 512, 512]
    convolutions = 16 * sum(a * b for a, b in pairwise([3, *widths]))
    inputs = [512, 1024, 1024, 1024, 1024, 512, 256, 128]
    outputs = [*widths[-2::-1], 9]
    convolutions += 16 * sum(o * (i + o) for i, o in zip(inputs, outputs, strict=True))
    found = sum(p.numel() for p in network.parameters() if p.ndim == 4)
    assert found == convolutions
    assert PAPER_DES18.multiple == PAPER_DES19.multiple == 256
    assert NARROW_DES18.multiple == 128


# Several photos


def test_des19_does_not_mind_the_order_of_photos_nor_their_repetition() -> None:
    network = tiny("des19")
    assert isinstance(network, Des19)
    seen = photos(2, 3, 3, 16, 16)
    with torch.no_grad():
        answer = network.fuse(seen)
        for order in ([2, 0, 1], [1, 0, 2], [0, 0, 1, 2, 2]):
            assert_close(network.fuse(seen[:, order]), answer)
        assert_close(network.fuse(seen[:, :1]), network(seen[:, 0]))
        assert float((network.fuse(seen[:, :2]) - answer).abs().max()) > 1e-3


def test_des19_sees_where_it_looks() -> None:
    network = tiny("des19")
    assert isinstance(network, Des19)
    seen = photos(1, 3, 16, 16)
    with torch.no_grad():
        informed = network(seen)
        network.unet.first.weight[:, 3:] = 0.0  # of the coordinates
        assert float((network(seen) - informed).abs().max()) > 1e-4


# The auto-encoder


def test_the_papers_latent_code_is_8_by_8_by_512() -> None:
    with torch.device("meta"):
        network = Autoencoder()
        assert network.encode(torch.zeros(1, 10, 256, 256)).shape == (1, 512, 8, 8)
    widths = [10, 64, 128, 256, 512, 512]
    back = [512, 512, 256, 128, 64, 9]
    count = sum(16 * a * b + b for a, b in [*pairwise(widths), *pairwise(back)])
    assert sum(p.numel() for p in network.parameters()) == count


def test_the_auto_encoder_takes_materials_of_any_legal_size() -> None:
    network = tiny("autoencoder")
    assert isinstance(network, Autoencoder)
    material = random_svbrdf(2, 32, 96)
    again = network.reconstruct(material)
    assert again.validate().size == (32, 96)
    assert again.batch == 2
    slopes = again.normal[:, :2] / again.normal[:, 2:]
    assert float(slopes.abs().max()) <= 1.0 + 1e-5
    code = network.encode(torch.zeros(1, 10, 32, 96))
    assert code.shape == (1, 16, 1, 3)


@torch.no_grad()
def test_an_untrained_auto_encoder_is_neither_silent_nor_saturated() -> None:
    torch.manual_seed(0)
    network = Autoencoder(AutoencoderConfig(8))
    maps = functional.interpolate(random_svbrdf(8, 16, 16).channels(), scale_factor=8)
    material = SVBRDF.from_channels(maps)
    code = network.encode(maps)
    assert 0.1 < float(code.std()) < 10.0
    assert float(network.decode(code).std()) < 0.5
    assert float((network.reconstruct(material).diffuse - 0.5).abs().max()) < 0.45
