"""The search in latent space: it explains photos, by what the decoder can make and nothing else."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from nets import checkpoint
from nets.baselines.autoencoder import Autoencoder, AutoencoderConfig
from nets.baselines.conventions import maps_of
from nets.checkpoint import CheckpointError, Record, save_model
from nets.data.images import write_image
from nets.generator import Generator, GeneratorConfig, maps_to_svbrdf
from nets.render import PointLight, render
from nets.svbrdf import MAPS, SVBRDF
from refine import Refiner, cli
from refine.bands import distance_in_bands
from refine.capture import Capture
from refine.engine import ENGINES, find_gradients
from refine.engine.reference import Stopped
from refine.latent import decode, descend_latent, encode
from refine.parametrization import Parameters
from refine.result import describe_auto_encoders
from refine.run import run_stages
from refine.stages import GAO_PIXELS, LatentStage, PixelStage, Recipe, find_recipe
from tests.helpers import assert_close, random_svbrdf, seeded

FLASH = PointLight.at((0.1, -0.2, 2.0))
TINY = AutoencoderConfig(width=2)


def untrained(seed: int = 0) -> Autoencoder:
    torch.manual_seed(seed)
    network = Autoencoder(TINY)
    with torch.no_grad():  # they start with plain materials
        last_of(network).weight.mul_(20.0)
    return network


def last_of(network: Autoencoder) -> nn.ConvTranspose2d:
    layer = network.decoder[-1]
    assert isinstance(layer, nn.ConvTranspose2d)
    return layer


@pytest.fixture
def weights(tmp_path: Path) -> str:
    path = tmp_path / "materials.safetensors"
    save_model(path, untrained(), Record(TINY))
    return str(path)


def capture_of(material: SVBRDF) -> Capture:
    photo = render(material, FLASH)
    return Capture(photo.clamp(max=1.0), (photo < 1.0).all(dim=1, keepdim=True), light=FLASH)


def makeable(height: int = 24, width: int = 40) -> SVBRDF:
    """Return a material that the decoder can make."""
    code = 2.0 * torch.randn(1, 16, 2, 2, generator=seeded(4))
    with torch.no_grad():
        return decode(untrained(), code, (height, width)).svbrdf()


# From codes to parameters


def test_parameters_of_a_code_are_those_of_its_maps() -> None:
    network, code = untrained(), torch.randn(1, 16, 1, 2, generator=seeded(0))
    with torch.no_grad():
        found = decode(network, code, (32, 64)).svbrdf()
        maps = maps_to_svbrdf(maps_of(network.decode(code), 1.0))
    assert found.size == (32, 64)
    for name in ("normal", "diffuse", "specular"):
        assert_close(getattr(found, name), getattr(maps, name))
    # The renderer tells no roughness below its floor from another.
    assert_close(found.roughness, maps.roughness.clamp(0.03, 1.0), atol=2.1e-3)


@pytest.mark.parametrize("size", [(32, 64), (24, 40), (33, 5)])
def test_materials_of_any_size_have_codes(size: tuple[int, int]) -> None:
    network, material = untrained(), random_svbrdf(1, *size)
    code = encode(network, material)
    assert code.shape == (1, 16, -(-size[0] // 32), -(-size[1] // 32))
    assert decode(network, code, size).svbrdf().validate().size == size
    if size == (32, 64):
        assert_close(decode(network, code, size).svbrdf().diffuse, network.reconstruct(material).diffuse)


# Engines


@pytest.mark.parametrize("engine", ENGINES)
def test_gradients_are_those_of_finite_differences(engine: str) -> None:
    photo = capture_of(random_svbrdf(1, 5, 7, seed=1, dtype=torch.float64))
    photo = Capture(photo.photo, photo.unsaturated, light=FLASH.to(torch.float64))
    start = Parameters.from_svbrdf(random_svbrdf(1, 5, 7, seed=2, dtype=torch.float64))
    measure = find_gradients(engine)(start, photo)
    distance, gradients = measure(start)
    assert distance == pytest.approx(distance_in_bands(start.svbrdf(), photo), rel=1e-9)
    for name in MAPS:
        direction = torch.randn(gradients[name].shape, generator=seeded(3), dtype=torch.float64)
        ahead, behind = (
            measure(start.shifted({name: sign * 1e-6 * direction}))[0] * 5 * 7 for sign in (1.0, -1.0)
        )
        expected = (ahead - behind) / 2e-6
        assert float((gradients[name] * direction).sum()) == pytest.approx(expected, rel=1e-5)


def test_engines_take_the_same_way(weights: str) -> None:
    photo, start = capture_of(makeable()), Parameters.from_svbrdf(random_svbrdf(1, 24, 40))
    stage = LatentStage(12, rate=0.05, checkpoint=weights)
    ways = [descend_latent(start, [photo], stage, engine)[1] for engine in ("fused", "reference")]
    assert ways[0] == pytest.approx(ways[1], rel=1e-3)


# What is found


def test_a_material_that_can_be_made_is_found(weights: str) -> None:
    truth = makeable()
    photo, start = capture_of(truth), Parameters.from_svbrdf(random_svbrdf(1, 24, 40))
    told: list[tuple[int, float]] = []
    found, history = descend_latent(
        start,
        [photo],
        LatentStage(80, rate=0.1, checkpoint=weights),
        "fused",
        lambda *news: told.append(news),
    )
    assert len(history) == 81
    assert told == [(number + 1, loss) for number, loss in enumerate(history[:-1])]
    assert min(history) < 0.4 * history[0]
    assert distance_in_bands(found.svbrdf(), photo) == pytest.approx(min(history), rel=1e-4)


@pytest.mark.parametrize("rate", [1e-3, 10.0])
def test_the_end_is_never_worse_than_the_start(rate: float, weights: str) -> None:
    photo, start = capture_of(random_svbrdf(1, 24, 40, seed=7)), random_svbrdf(1, 24, 40)
    parameters = Parameters.from_svbrdf(start)
    found, history = descend_latent(
        parameters, [photo], LatentStage(5, rate=rate, checkpoint=weights), "fused"
    )
    assert distance_in_bands(found.svbrdf(), photo) <= history[0] * (1.0 + 1e-5)
    recipe = Recipe("some", stages=(LatentStage(5, rate=rate, checkpoint=weights), PixelStage(4)))
    refined, losses = run_stages(start, photo, recipe, {})
    assert losses["per-pixel"][0] == pytest.approx(min(losses["latent"]), rel=1e-4)
    assert distance_in_bands(refined, photo) <= min(losses["latent"])


def test_a_better_initialization_does_not_take_the_decoder_s_place(weights: str) -> None:
    truth = random_svbrdf(1, 24, 40, seed=7)
    photo, recipe = capture_of(truth), Recipe("some", stages=(LatentStage(3, checkpoint=weights),))
    refined, losses = run_stages(truth, photo, recipe, {})
    assert losses["initialization"][0] < 0.5 * min(losses["latent"])
    assert distance_in_bands(refined, photo) == pytest.approx(min(losses["latent"]), rel=1e-4)


def test_an_interrupted_search_keeps_the_best_so_far(weights: str) -> None:
    photo, start = capture_of(makeable()), Parameters.from_svbrdf(random_svbrdf(1, 24, 40))

    def interrupt(iteration: int, loss: float) -> None:
        if iteration == 4:
            raise KeyboardInterrupt

    with pytest.raises(Stopped) as caught:
        descend_latent(start, [photo], LatentStage(9, rate=0.1, checkpoint=weights), "fused", interrupt)
    assert len(caught.value.history) == 4
    assert distance_in_bands(caught.value.parameters.svbrdf(), photo) == pytest.approx(
        min(caught.value.history), rel=1e-4
    )


def test_only_what_the_decoder_can_make_is_found(tmp_path: Path) -> None:
    """Of a decoder that makes one material whatever the code, that is found, whatever the photo."""
    network = untrained()
    with torch.no_grad():
        last_of(network).weight.zero_()
        last_of(network).bias = nn.Parameter(torch.linspace(-1.0, 1.0, 9))
    save_model(tmp_path / "one.safetensors", network, Record(TINY))
    photo, start = capture_of(random_svbrdf(1, 24, 40, seed=7)), random_svbrdf(1, 24, 40)
    stage = LatentStage(5, rate=0.1, checkpoint=str(tmp_path / "one.safetensors"))
    found, history = descend_latent(Parameters.from_svbrdf(start), [photo], stage, "fused")
    assert history == [pytest.approx(history[0])] * 6
    made = found.svbrdf()
    for name in MAPS:
        values: Tensor = getattr(made, name)
        assert_close(values, values[..., :1, :1].expand_as(values))
    assert float(made.diffuse[0, 0, 0, 0]) == pytest.approx((1.0 + math.tanh(-0.5)) / 2.0, abs=1e-3)


def test_the_same_photo_gives_the_same_material(weights: str) -> None:
    photo, start = capture_of(makeable()), Parameters.from_svbrdf(random_svbrdf(1, 24, 40))
    stage = LatentStage(6, checkpoint=weights)
    first, again = (descend_latent(start, [photo], stage, "fused")[0] for _ in range(2))
    assert all(torch.equal(getattr(first, name), getattr(again, name)) for name in MAPS)


# Recipes


def test_gao_s_settings() -> None:
    assert find_recipe("gao").stages == (LatentStage(4000, 1e-3, 0.5, "gao19"),)
    assert find_recipe("gao+").stages == (*find_recipe("gao").stages, GAO_PIXELS)
    assert GAO_PIXELS.iterations == 200
    assert set(GAO_PIXELS.rates.moving()) == set(MAPS)
    latent, pixels = find_recipe("gao+").with_iterations(420).stages
    assert (latent.iterations, pixels.iterations) == (400, 20)


def constant(photo: Tensor) -> tuple[SVBRDF, PointLight]:
    return SVBRDF.constant(*photo.shape[-2:]), FLASH


def test_refining_by_gao_s_recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "WEIGHTS", tmp_path)
    save_model(tmp_path / "gao19.safetensors", untrained(), Record(TINY))
    refined = Refiner(constant, "gao+").fit(capture_of(makeable()).photo[0], light=FLASH, iters=42)
    assert {name: len(curve) for name, curve in refined.losses.items()} == {
        "initialization": 1, "latent": 41, "per-pixel": 3,
    }  # fmt: skip
    assert set(refined.seconds) == {"initialization", "latent", "per-pixel"}
    assert refined.svbrdf.validate().size == (24, 40)


def test_missing_weights_are_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(checkpoint, "WEIGHTS", tmp_path)
    for recipe in ("gao", "gao+"):
        with pytest.raises(CheckpointError, match="gao19: no such checkpoint"):
            Refiner(constant, recipe)
    config = GeneratorConfig(width=2, levels=3, deep_multiplier=2)
    save_model(tmp_path / "start.safetensors", Generator(config), Record(config))
    write_image(tmp_path / "photo.png", np.full((40, 40, 3), 99, dtype=np.uint8))
    monkeypatch.chdir(tmp_path)
    code = cli.run(["photo.png", "--init", "start", "--recipe", "gao", "--quiet"])
    said = capsys.readouterr().err
    assert code == 2
    assert said.startswith("refine: gao19: no such checkpoint; ")
    assert said.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"start.safetensors", "photo.png"}


def test_results_name_the_auto_encoder_they_depend_on(weights: str) -> None:
    recipe = Recipe("some", stages=(LatentStage(2, checkpoint=weights), PixelStage(2)))
    (found,) = describe_auto_encoders(recipe)
    assert found["name"] == weights
    assert found["sha256"] == hashlib.sha256(Path(weights).read_bytes()).hexdigest()
    assert found["record"]["architecture"] == TINY.as_dict()
    assert describe_auto_encoders(find_recipe("default")) == []
