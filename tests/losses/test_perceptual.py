"""LPIPS against numbers of the reference implementation, its errors and its gradients.

The expected values were printed by the `lpips` 0.1.4 package itself (its own `LPIPS(net="alex")`, its
heads, torchvision's fp32 AlexNet) on the pictures that `picture` draws: analytic, so that they need no file.
"""

import io
import json
import pickle
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from torch import Tensor

from losses.fetch_weights import FEATURES, HEADS, NumpyUnpickler
from losses.perceptual import LPIPS, LPIPS_ALEX

SHAPE = (96, 128)

# kind of the first picture, kind of the second, the reference package's distance
REFERENCE = [
    ("stripes", "checks", 0.50910),
    ("stripes", "shifted", 0.03441),
    ("stripes", "dimmed", 0.02449),
    ("checks", "noise", 0.97167),
    ("blobs", "dimmed", 0.69472),
    ("blobs", "noise", 1.55436),
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


@pytest.mark.parametrize(("first", "second", "expected"), REFERENCE)
def test_agrees_with_the_reference_package(distance: LPIPS, first: str, second: str, expected: float) -> None:
    found = float(distance(picture(first), picture(second)))
    assert found == pytest.approx(expected, abs=0.001)


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
