"""The generator: the paper's shapes, the fast upsampling against its definition, legal predictions."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from nets.generator import (
    MIN_ROUGHNESS,
    NARROW_GENERATOR,
    PAPER_GENERATOR,
    Generator,
    GeneratorConfig,
    UpBlock,
    maps_to_svbrdf,
    svbrdf_to_maps,
    upsampled_convolution,
    upsampled_convolution_reference,
)
from nets.light_head import (
    MIN_LIGHT_Z,
    LightEncoder,
    LightHead,
    at_height,
    light_from_output,
    light_to_output,
)
from nets.render import AUTHORS_CAMERA
from nets.svbrdf import CHANNELS, MAPS
from tests.helpers import assert_close, gradcheck, random_light, random_svbrdf, seeded

TINY = GeneratorConfig(width=3, levels=4, deep_multiplier=2)

ENCODER = [(64, 3), (128, 64), (256, 128), (512, 256), (512, 512), (512, 512), (512, 512), (512, 512)]
DECODER = [(512, 512), (512, 1024), (512, 1024), (512, 1024), (256, 1024), (128, 512), (64, 256)]
LIGHT_HEAD = [(256, 512), (128, 256), (64, 128), (32, 64), (16, 32), (3, 16)]


@pytest.fixture(scope="module")
def papers() -> Generator:
    with torch.device("meta"):
        return Generator()


@pytest.fixture
def tiny() -> Generator:
    return Generator(TINY).eval()


def photo(height: int = 32, width: int = 32, batch: int = 1, seed: int = 0) -> Tensor:
    return torch.rand(batch, 3, height, width, generator=seeded(seed))


def shapes(module: torch.nn.Module) -> list[tuple[int, ...]]:
    return [tuple(parameter.shape) for parameter in module.parameters()]


# --- The paper's network ----------------------------------------------------------------------------------


def test_the_papers_encoder(papers: Generator) -> None:
    assert shapes(papers.encoder) == [(*channels, 4, 4) for channels in ENCODER]
    assert shapes(papers.encoder_norms) == [(w,) for w in (128, 256, 512, 512, 512, 512) for _ in "wb"]
    assert {(conv.stride, conv.padding) for conv in papers.encoder} == {((2, 2), (1, 1))}


@pytest.mark.parametrize("name", MAPS)
def test_the_papers_decoders(papers: Generator, name: str) -> None:
    layers = [*DECODER, (CHANNELS[name], 128)]
    expected = [(outputs, n, 4, 4) for outputs, inputs in layers for n in (inputs, outputs)]
    assert shapes(papers.decoders[name].blocks) == expected
    assert shapes(papers.decoders[name].norms) == [(outputs,) for outputs, _ in DECODER for _ in "wb"]


def test_the_papers_light_head(papers: Generator) -> None:
    assert shapes(papers.light_head) == [shape for layer in LIGHT_HEAD for shape in (layer, layer[:1])]


def test_the_papers_parameters_in_all(papers: Generator) -> None:
    assert sum(parameter.numel() for parameter in papers.parameters()) == 231_828_195


def test_the_papers_norms_are_affine_instance_norms(papers: Generator) -> None:
    norms = [module for module in papers.modules() if isinstance(module, torch.nn.InstanceNorm2d)]
    assert len(norms) == 6 + 4 * 7
    assert all(norm.affine and not norm.track_running_stats and norm.eps == 1e-5 for norm in norms)


def test_the_presets() -> None:
    assert GeneratorConfig() == PAPER_GENERATOR == GeneratorConfig(64, 8, 8)
    assert PAPER_GENERATOR.multiple == 256
    assert 2 * sum(p.numel() for p in Generator(NARROW_GENERATOR).parameters()) < 16e6  # bytes of its file


# --- Fast upsampling against its definition ----------------------------------------------------------------


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (3, 5), (7, 4), (16, 1)])
@pytest.mark.parametrize("channels", [(1, 1), (3, 2), (2, 5)])
def test_upsampled_convolution_is_its_definition(size: tuple[int, int], channels: tuple[int, int]) -> None:
    inputs, outputs = channels
    generator = seeded(sum(size))
    x = torch.randn(2, inputs, *size, generator=generator, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(outputs, inputs, 4, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    found, expected = upsampled_convolution(x, weight), upsampled_convolution_reference(x, weight)
    assert_close(found, expected, rtol=1e-12, atol=1e-12)
    assert found.shape == (2, outputs, 2 * size[0], 2 * size[1])
    direction = torch.randn(found.shape, generator=generator, dtype=torch.float64)
    gradients = torch.autograd.grad(found, (x, weight), direction)
    references = torch.autograd.grad(expected, (x, weight), direction)
    for gradient, reference in zip(gradients, references, strict=True):
        assert_close(gradient, reference, rtol=1e-12, atol=1e-12)


def test_upsampled_convolution_by_hand() -> None:
    # One bright pixel fills 2x2; padded by 1 left and top, the kernel's last tap sees it first.
    weight = torch.arange(16, dtype=torch.float64).reshape(1, 1, 4, 4)
    found = upsampled_convolution(torch.ones(1, 1, 1, 1, dtype=torch.float64), weight)[0, 0]
    assert found.tolist() == [[5 + 6 + 9 + 10, 4 + 5 + 8 + 9], [1 + 2 + 5 + 6, 0 + 1 + 4 + 5]]


def test_up_block_gradients() -> None:
    block = UpBlock(2, 3).double()
    gradcheck(block, torch.randn(1, 2, 2, 3, generator=seeded(0), dtype=torch.float64))


# --- Any shape --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [1, 5])
@pytest.mark.parametrize(("levels", "multiplier"), [(2, 1), (3, 8), (5, 4)])
@pytest.mark.parametrize("tiles", [(1, 1), (2, 1)])
def test_any_width_and_depth_runs(width: int, levels: int, multiplier: int, tiles: tuple[int, int]) -> None:
    config = GeneratorConfig(width, levels, multiplier)
    height, breadth = (config.multiple * count for count in tiles)
    network = Generator(config)
    maps, light = network(photo(height, breadth, batch=2) * 2 - 1)
    assert maps.shape == (2, 10, height, breadth)
    assert light.shape == (2, 3)
    assert float(maps.detach().abs().max()) <= 1.0
    (maps.sum() + light.sum()).backward()
    assert all(parameter.grad is not None for parameter in network.parameters())


@pytest.mark.parametrize(("cues", "detail"), [(True, 0), (False, 6), (True, 6)])
def test_cues_and_detail_are_seen_and_trained(cues: bool, detail: int) -> None:
    config = GeneratorConfig(2, 4, 2, shading_cues=cues, detail_channels=detail)
    network = Generator(config)
    assert config.inputs == network.encoder[0].in_channels == (7 if cues else 3)
    maps, light = network(photo(16, 32, batch=2) * 2 - 1)
    assert maps.shape == (2, 10, 16, 32)
    (maps.sum() + light.sum()).backward()
    assert all(parameter.grad is not None for parameter in network.parameters())


@pytest.mark.parametrize("cues", [True, False])
def test_the_light_alone_is_that_of_the_whole(cues: bool) -> None:
    network = Generator(GeneratorConfig(2, 4, 2, shading_cues=cues))  # in training: dropout is not in its way
    x = photo(16, 32, batch=2) * 2 - 1
    assert torch.equal(network.estimate_light(x), network(x)[1])


def test_detail_begins_as_no_correction_and_learns_from_the_input() -> None:
    network = Generator(GeneratorConfig(2, 4, 2, detail_channels=6)).eval()
    assert network.detail is not None
    x = photo(16, 16) * 2 - 1
    decoded = [network.decoders[name](network.encode(x))[:, : CHANNELS[name]] for name in MAPS]
    assert_close(network(x)[0], torch.tanh(torch.cat(decoded, dim=1)))
    torch.nn.init.normal_(network.detail.conv2.weight)
    changed = x.clone()
    changed[..., 8, 8] += 0.1  # one pixel reaches at most a 5x5 neighbourhood through the detail layers
    features = torch.zeros(1, 8, 16, 16)
    maps = torch.zeros(1, 10, 16, 16)
    difference = (network.detail(maps, features, changed) - network.detail(maps, features, x)).detach()
    assert float(difference[..., 8, 8].abs().max()) > 0.0
    outside = torch.ones(16, 16, dtype=torch.bool)
    outside[6:11, 6:11] = False
    assert_close(difference[..., outside], torch.zeros(1, 10, int(outside.sum())), atol=1e-6)


def test_eight_levels_shrink_256_pixels_to_one() -> None:
    network = Generator(GeneratorConfig(width=1, levels=8)).eval()
    features = network.encode(photo(256, 256))
    assert [feature.shape[-1] for feature in features] == [128, 64, 32, 16, 8, 4, 2, 1]
    assert network(photo(256, 256))[0].shape == (1, 10, 256, 256)


@pytest.mark.parametrize("size", [(31, 32), (32, 40), (8, 8)])
def test_wrong_sides_are_named(tiny: Generator, size: tuple[int, int]) -> None:
    message = rf"photo has shape \(1, 3, {size[0]}, {size[1]}\), its sides must be multiples of 16"
    with pytest.raises(ValueError, match=message):
        tiny.predict(photo(*size))


@pytest.mark.parametrize("wrong", [(0, 8, 8), (64, 1, 8), (64, 11, 8), (64, 8, 0), (64, 8, 8, False, -1)])
def test_impossible_shapes_are_refused(wrong: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="not a generator"):
        GeneratorConfig(*wrong)


def test_the_config_is_plain_data() -> None:
    assert GeneratorConfig(**TINY.as_dict()) == TINY


def test_a_large_bottleneck_is_averaged_for_the_light() -> None:
    head = LightHead(4)
    bottleneck = torch.randn(2, 4, 2, 3, generator=seeded(0))
    assert_close(head(bottleneck), head(bottleneck.mean(dim=(2, 3), keepdim=True)))


# --- Dropout and determinism ------------------------------------------------------------------------------


def test_evaluation_is_deterministic_and_training_is_not(tiny: Generator) -> None:
    x = photo() * 2 - 1
    assert torch.equal(tiny(x)[0], tiny(x)[0])
    tiny.train()
    first, second = tiny(x), tiny(x)
    assert not torch.allclose(first[0], second[0])
    assert torch.equal(first[1], second[1])  # the light head has no dropout


@pytest.mark.parametrize(("levels", "drops"), [(3, 2), (4, 3), (6, 3)])
def test_dropout_follows_the_three_deepest_levels(levels: int, drops: int) -> None:
    network = Generator(GeneratorConfig(1, levels, 2))
    seen: list[int] = []
    decoder = network.decoders["normal"]
    assert decoder.dropout.p == 0.5
    decoder.dropout.register_forward_hook(lambda module, inputs, output: seen.append(output.shape[-1]))
    side = network.config.multiple
    network(photo(side, side))
    assert seen == [2 ** (level + 1) for level in range(drops)]


def test_one_image_of_a_batch_does_not_touch_another(tiny: Generator) -> None:
    pair = photo(batch=2)
    assert_close(tiny.predict(pair)[0][1].channels(), tiny.predict(pair[1:])[0].channels())


# --- What predictions mean --------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1.0, 30.0])
def test_predictions_are_legal_whatever_the_weights(tiny: Generator, scale: float) -> None:
    with torch.no_grad():
        for parameter in tiny.parameters():
            parameter.mul_(scale)
    svbrdf, light = tiny.predict(photo(32, 48, batch=2))
    svbrdf.validate()
    assert svbrdf.size == (32, 48)
    assert float(svbrdf.normal[:, 2].min()) > 0.0
    assert light.position.shape == (2, 3)
    assert float(light.position[:, 2].min()) >= MIN_LIGHT_Z
    assert torch.equal(light.intensity, torch.ones(2, 3))
    assert not svbrdf.diffuse.requires_grad


def test_predict_leaves_the_mode_as_it_was(tiny: Generator) -> None:
    tiny.train()
    first = tiny.predict(photo())[0].channels()
    assert tiny.training
    assert torch.equal(tiny.predict(photo())[0].channels(), first)
    with pytest.raises(ValueError, match="multiples"):
        tiny.predict(photo(5, 5))
    assert tiny.training


def test_predict_clamps_overexposed_photos(tiny: Generator) -> None:
    bright = 3.0 * photo()
    found, expected = tiny.predict(bright)[0], tiny.predict(bright.clamp(max=1.0))[0]
    assert torch.equal(found.channels(), expected.channels())


def test_maps_and_materials_are_inverses() -> None:
    material = random_svbrdf(2, dtype=torch.float64)
    maps = svbrdf_to_maps(material)
    assert float(maps.abs().max()) <= 1.0
    assert_close(maps_to_svbrdf(maps).channels(), material.channels())
    assert_close(maps[:, 3], material.diffuse[:, 0] * 2 - 1)
    assert_close(maps[:, :3], material.normal)


def test_the_ends_of_the_networks_range_are_legal() -> None:
    for value in (-1.0, 0.0, 1.0):
        material = maps_to_svbrdf(torch.full((1, 10, 2, 2), value)).validate()
        expected = (value + 1.0) / 2.0
        assert_close(material.diffuse, torch.full((1, 3, 2, 2), expected))
        assert_close(material.roughness, torch.full((1, 1, 2, 2), max(expected, MIN_ROUGHNESS)))


def test_light_standardisation_and_back() -> None:
    position = random_light(5, dtype=torch.float64).position
    assert_close(light_from_output(light_to_output(position)).position, position)
    centre = light_from_output(torch.zeros(1, 3)).position
    assert_close(centre, torch.tensor([[-0.0012, 0.0018, 3.0988]]))
    one = light_from_output(torch.ones(1, 3)).position
    assert_close(one - centre, torch.tensor([[1.6891, 1.6833, 2.7202]]))
    assert float(light_from_output(torch.full((1, 3), -9.0)).position[0, 2]) == pytest.approx(MIN_LIGHT_Z)


@torch.no_grad()
def test_the_light_encoder_sees_where_things_are_and_no_maps() -> None:
    torch.manual_seed(0)
    network = Generator(GeneratorConfig(width=2, levels=4, deep_multiplier=2, light_channels=4)).eval()
    assert isinstance(network.light_head, LightEncoder)
    photo = torch.rand(1, 3, 64, 32) * 2.0 - 1.0
    output = network(photo)[1]
    assert torch.equal(network.estimate_light(photo), output)
    assert not torch.equal(network.estimate_light(photo.flip(-1)), output)
    even = torch.zeros(1, 3, 256, 256)
    spot = even.clone()
    spot[..., 20:60, 180:220] = 1.0
    assert not torch.allclose(network.estimate_light(spot), network.estimate_light(spot.flip(-2)), atol=1e-6)
    heights = light_from_output(network.estimate_light(torch.cat([even, spot]))).position[:, 2]
    assert_close(heights, torch.full((2,), AUTHORS_CAMERA[2]))  # where the camera is


@pytest.mark.parametrize("height", [1.0, 2.4, 7.0])
def test_a_light_at_another_height_has_its_mirror_image_at_the_same_place(height: float) -> None:
    camera = torch.tensor(AUTHORS_CAMERA, dtype=torch.float64)
    light = torch.tensor([[0.6, -0.4, 2.4], [-0.1, 0.3, 1.2]], dtype=torch.float64)
    moved = at_height(light, torch.full((2,), height, dtype=torch.float64))
    assert_close(moved[:, 2], torch.full((2,), height, dtype=torch.float64))

    def bisects(position: Tensor, place: Tensor) -> bool:
        towards = [torch.nn.functional.normalize(point - place, dim=1) for point in (position, camera)]
        return bool((sum(towards)[:, :2].abs() < 1e-12).all())  # half vector upright

    share = camera[2] / (camera[2] + light[:, 2:])
    place = torch.cat([light[:, :2] * share, torch.zeros_like(share)], dim=1)
    assert bisects(light, place)
    assert bisects(moved, place)


@torch.no_grad()
def test_the_light_encoder_averages_larger_photos() -> None:
    torch.manual_seed(0)
    encoder = LightEncoder(3)
    small = torch.rand(2, 3, 128, 128) * 2.0 - 1.0
    large = small.repeat_interleave(3, dim=2).repeat_interleave(3, dim=3)
    assert_close(encoder(large), encoder(small), rtol=1e-4, atol=1e-5)
