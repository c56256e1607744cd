"""LPIPS against numbers of the reference implementation, its errors and its gradients.

The expected values were printed by the `lpips` 0.1.4 package itself (its own `LPIPS(net="alex")` and
`LPIPS(net="vgg")`, its heads, torchvision's fp32 weights) on the pictures that `picture` draws: analytic, so
that they need no file.
"""

import io
import json
import os
import pickle
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from losses.fetch_weights import FEATURES, HEADS, VGG_HEADS, NumpyUnpickler
from losses.perceptual import INPUT_SCALE, INPUT_SHIFT, LPIPS, LPIPS_ALEX, LPIPS_VGG_HEADS, LPIPSVGG
from losses.vgg import BLOCKS
from losses.vgg_weights import VGGWeightsMissing, load_vgg16
from nets.data.images import read_image, to_tensor
from tests.helpers import seeded

SHAPE = (96, 128)

IMAGES = "REFINE_LPIPS_IMAGES"
"""Environment variable: the folder `imgs` of the reference package's repository."""

# kind of the first picture, kind of the second, the reference package's distances with AlexNet and VGG-16
REFERENCE = [
    ("stripes", "checks", 0.50910, 0.70520),
    ("stripes", "shifted", 0.03441, 0.20694),
    ("stripes", "dimmed", 0.02449, 0.02375),
    ("checks", "noise", 0.97167, 0.72849),
    ("blobs", "dimmed", 0.69472, 0.78060),
    ("blobs", "noise", 1.55436, 0.95176),
]


@pytest.fixture(scope="module")
def distance() -> LPIPS:
    return LPIPS()


def picture(kind: str) -> Tensor:
    """Draw a colour picture in [-1, 1], [1, 3, 96, 128], from formulas alone."""
    row = torch.arange(SHAPE[0], dtype=torch.float64)[:, None]
    column = torch.arange(SHAPE[1], dtype=torch.float64)[None]
    channel = torch.arange(3, dtype=torch.float64)[:, None, None]
    stripes = torch.sin(0.35 * column + 0.1 * row + channel)
    image = {
        "stripes": stripes,
        "shifted": torch.sin(0.35 * (column + 3) + 0.1 * row + channel),
        "dimmed": 0.5 * stripes - 0.2,
        "checks": torch.sign(torch.sin(0.5 * column) * torch.sin(0.5 * row) + 1e-3) * (0.9 - 0.2 * channel),
        "blobs": 2 * torch.exp(-(torch.sin(0.06 * row) ** 2) * 3 - torch.cos(0.05 * column + channel) ** 2)
        - 1,
        # The classic one-line hash of GLSL shaders.
        "noise": 2 * torch.frac(torch.abs(torch.sin(12.9898 * row + 78.233 * column + channel)) * 43758.5)
        - 1,
    }[kind]
    return image[None].float()


@pytest.mark.parametrize(("first", "second", "expected", "_"), REFERENCE)
def test_agrees_with_the_reference_package(
    distance: LPIPS, first: str, second: str, expected: float, _: float
) -> None:
    found = float(distance(picture(first), picture(second)))
    assert found == pytest.approx(expected, abs=0.001)


@pytest.mark.skipif(IMAGES not in os.environ, reason=f"{IMAGES} does not name the reference package's imgs/")
@pytest.mark.parametrize(("other", "expected"), [("ex_p0.png", 0.722), ("ex_p1.png", 0.138)])
def test_the_reference_package_s_examples_have_the_distances_it_prints(
    distance: LPIPS, other: str, expected: float
) -> None:
    """The pictures are in its repository only, and in no package: for those who have it."""
    folder = Path(os.environ[IMAGES])
    a, b = (to_tensor(read_image(folder / name)[0]) * 2.0 - 1.0 for name in ("ex_ref.png", other))
    assert float(distance(a, b)) == pytest.approx(expected, abs=0.002)


@pytest.fixture(scope="module")
def vgg_state() -> dict[str, Tensor]:
    """Random weights of VGG-16's widths."""
    generator, state, inputs = seeded(0), {}, 3
    for block, (count, width) in enumerate(zip(BLOCKS, (64, 128, 256, 512, 512), strict=True), 1):
        for n in range(1, count + 1):
            weight = torch.randn(width, inputs, 3, 3, generator=generator) * (2.0 / (9 * inputs)) ** 0.5
            state |= {f"conv{block}_{n}.weight": weight, f"conv{block}_{n}.bias": torch.zeros(width)}
            inputs = width
    return state


def test_vgg_is_its_formula(vgg_state: dict[str, Tensor]) -> None:
    a, b = (2.0 * torch.rand(1, 3, 32, 48, generator=seeded(seed)) - 1.0 for seed in (1, 2))
    heads = load_file(LPIPS_VGG_HEADS)
    expected = 0.0
    x = [
        (image - torch.tensor(INPUT_SHIFT).view(3, 1, 1)) / torch.tensor(INPUT_SCALE).view(3, 1, 1)
        for image in (a, b)
    ]
    for block, count in enumerate(BLOCKS, 1):
        x = [functional.max_pool2d(image, 2) for image in x] if block > 1 else x
        for n in range(1, count + 1):
            weight = vgg_state[f"conv{block}_{n}.weight"]
            x = [functional.conv2d(image, weight, padding=1).clamp(min=0.0) for image in x]
        unit = [image / (image.square().sum(dim=1, keepdim=True).sqrt() + 1e-10) for image in x]
        per_pixel = ((unit[0] - unit[1]) ** 2 * heads[f"heads.{block - 1}"].view(1, -1, 1, 1)).sum(dim=1)
        expected += float(per_pixel.mean())
    vgg = LPIPSVGG(vgg_state)
    assert float(vgg(a, b)) == pytest.approx(expected, rel=1e-4)
    assert float(vgg(a, a)) == 0.0
    with pytest.raises(ValueError, match=r"at least 16 px"):
        vgg(a[..., :15], b[..., :15])


def test_vgg_agrees_with_the_reference_package() -> None:
    try:
        vgg = LPIPSVGG(load_vgg16())
    except VGGWeightsMissing as error:
        pytest.skip(str(error))
    for first, second, _, expected in REFERENCE:
        assert float(vgg(picture(first), picture(second))) == pytest.approx(expected, abs=0.001)


def test_the_shipped_heads_of_vgg_name_their_source() -> None:
    with safe_open(LPIPS_VGG_HEADS, framework="pt") as file:
        record = json.loads(file.metadata()["record"])
    assert record["heads_sha256"] == VGG_HEADS.member_sha256
    assert LPIPS_VGG_HEADS.name in (LPIPS_ALEX.parent / "NOTICE").read_text()
    heads = load_file(LPIPS_VGG_HEADS)
    assert [len(heads[f"heads.{i}"]) for i in range(5)] == [64, 128, 256, 512, 512]
    assert all(bool((head >= 0.0).all()) for head in heads.values())


def test_a_batch_is_its_pairs(distance: LPIPS) -> None:
    a = torch.cat([picture("stripes"), picture("blobs")])
    b = torch.cat([picture("checks"), picture("noise")])
    pairs = torch.cat([distance(a[:1], b[:1]), distance(a[1:], b[1:])])
    assert distance(a, b).shape == (2,)
    torch.testing.assert_close(distance(a, b), pairs, atol=1e-5, rtol=1e-4)


def test_equal_images_are_at_distance_zero(distance: LPIPS) -> None:
    assert float(distance(picture("blobs"), picture("blobs"))) == 0.0


def test_gradients_flow_to_the_images_and_descend(distance: LPIPS) -> None:
    image = (0.5 * picture("stripes")).requires_grad_()
    target = picture("blobs")
    before = distance(image, target).sum()
    before.backward()
    gradient = image.grad
    assert gradient is not None
    assert bool(torch.isfinite(gradient).all())
    step = 0.01 * gradient / gradient.abs().max()
    assert float(distance((image - step).detach(), target)) < float(before.detach())
    assert all(parameter.grad is None for parameter in distance.parameters())


def test_gradients_of_a_black_image_are_finite(distance: LPIPS) -> None:
    image = torch.full((1, 3, 64, 64), -1.0, requires_grad=True)
    distance(image, torch.full((1, 3, 64, 64), 0.3)).sum().backward()
    assert image.grad is not None
    assert bool(torch.isfinite(image.grad).all())


def test_the_smallest_image_works_and_a_smaller_one_is_refused(distance: LPIPS) -> None:
    smallest = torch.zeros(1, 3, 31, 31)
    assert float(distance(smallest, smallest)) == 0.0
    with pytest.raises(ValueError, match=r"at least 31 px, got \(1, 3, 30, 40\)"):
        distance(torch.zeros(1, 3, 30, 40), torch.zeros(1, 3, 30, 40))


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        (torch.zeros(1, 3, 64, 64), torch.zeros(1, 3, 64, 32), r"\(1, 3, 64, 64\) and \(1, 3, 64, 32\)"),
        (torch.zeros(1, 1, 64, 64), torch.zeros(1, 1, 64, 64), r"\(1, 1, 64, 64\)"),
        (torch.zeros(1, 3, 64, 64), torch.full((1, 3, 64, 64), 255.0), r"second lies in \[255, 255\]"),
        (torch.full((1, 3, 64, 64), torch.nan), torch.zeros(1, 3, 64, 64), r"first lies in \[nan, nan\]"),
    ],
)
def test_errors_quote_shape_and_range(distance: LPIPS, a: Tensor, b: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        distance(a, b)


def test_missing_weights_name_the_command(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"python -m losses\.fetch_weights --lpips-alex"):
        LPIPS(tmp_path / "none.safetensors")


def test_the_shipped_file_names_its_sources_and_licences() -> None:
    with safe_open(LPIPS_ALEX, framework="pt") as file:
        record = json.loads(file.metadata()["record"])
    assert record["features_sha256"] == FEATURES.member_sha256
    assert record["heads_archive_sha256"] == HEADS.archive_sha256
    notice = (LPIPS_ALEX.parent / "NOTICE").read_text()
    for part in ("features_licence", "heads_licence"):
        assert record[part].split()[0] in notice
    assert LPIPS_ALEX.stat().st_size < 5.2e6


class _Exploit:
    def __reduce__(self) -> tuple:
        return (print, ("executed",))


def test_the_conversion_reads_arrays_and_refuses_code(capsys: pytest.CaptureFixture[str]) -> None:
    arrays = {"kernel": torch.arange(6.0).reshape(2, 3).numpy()}
    read = NumpyUnpickler(io.BytesIO(pickle.dumps(arrays, protocol=4))).load()
    assert read["kernel"].tolist() == arrays["kernel"].tolist()
    with pytest.raises(pickle.UnpicklingError, match=r"builtins\.print"):
        NumpyUnpickler(io.BytesIO(pickle.dumps(_Exploit()))).load()
    assert capsys.readouterr().out == ""
