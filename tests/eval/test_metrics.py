"""Metrics against an independent recomputation in numpy, and their properties."""

import math

import numpy as np
import pytest
import torch

from eval.metrics import (
    SceneScores,
    evaluate_material,
    map_rmse,
    rendering_lpips,
    rendering_rmse,
)
from losses.perceptual import LPIPS
from nets.render import PointLight, render
from nets.svbrdf import SVBRDF

SIZE = 48


def material(seed: int, size: int = SIZE) -> SVBRDF:
    generator = torch.Generator().manual_seed(seed)

    def draw(channels: int) -> torch.Tensor:
        return torch.rand(1, channels, size, size, generator=generator)

    normal = torch.nn.functional.normalize(draw(3) - torch.tensor([0.5, 0.5, -0.5])[:, None, None], dim=1)
    # A black corner: the encoding must have no floor there.
    diffuse = draw(3)
    diffuse[..., :20, :20] = 0.0
    return SVBRDF(normal, diffuse, 0.1 + 0.9 * draw(1), 0.3 * draw(3))


def lights(count: int = 6) -> PointLight:
    generator = torch.Generator().manual_seed(7)
    position = torch.rand(count, 3, generator=generator) * 2.0 + torch.tensor([-1.0, -1.0, 1.5])
    return PointLight(position, torch.ones(count, 3))


# The independent script: numpy only, from DESIGN.md's formulas, float64, pixel loops left to broadcasting.
def numpy_render(maps: dict[str, np.ndarray], light: np.ndarray) -> np.ndarray:
    size = maps["normal"].shape[-1]
    centres = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(centres, -centres)
    points = np.stack([x, y, np.zeros_like(x)])

    def unit(v: np.ndarray) -> np.ndarray:
        return v / np.sqrt((v**2).sum(0))

    def dot(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.maximum((u * v).sum(0), 0)

    n = maps["normal"]
    to_light = unit(light[:, None, None] - points)
    to_eye = unit(np.array([0, 0, 2.14])[:, None, None] - points)
    half = unit(to_light + to_eye)
    nl, nv, nh, vh = dot(n, to_light), dot(n, to_eye), dot(n, half), dot(to_eye, half)
    alpha = maps["roughness"][0] ** 2
    k = alpha / 2
    d = (alpha / (nh**2 * (alpha**2 - 1) + 1)) ** 2 / np.pi
    g = 1 / ((nl * (1 - k) + k) * (nv * (1 - k) + k))
    f = maps["specular"] + (1 - maps["specular"]) * 2 ** ((-5.55473 * vh - 6.98316) * vh)
    brdf = maps["diffuse"] * (1 - maps["specular"]) / np.pi + d * g * f / 4
    return np.pi * brdf * nl


def numpy_scores(estimate: SVBRDF, truth: SVBRDF, positions: np.ndarray) -> dict[str, float]:
    names = ("normal", "diffuse", "roughness", "specular")
    a, b = ({m: getattr(s, m)[0].double().numpy() for m in names} for s in (estimate, truth))

    def rmse(u: np.ndarray, v: np.ndarray) -> float:
        return float(np.sqrt(np.mean((u - v) ** 2)))

    def encode(u: np.ndarray) -> np.ndarray:
        return np.clip(u, 0, 1) ** (1 / 2.2)

    scores = {m: rmse(a[m], b[m]) for m in names[1:]}
    scores["normal"] = rmse((a["normal"] + 1) / 2, (b["normal"] + 1) / 2)
    scores |= {f"{m}_gamma": rmse(encode(a[m]), encode(b[m])) for m in ("diffuse", "specular")}
    pictures = [np.stack([encode(numpy_render(s, p)) for p in positions]) for s in (a, b)]
    return scores | {"rendering": rmse(*pictures)}


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_agree_with_the_independent_script(seed: int) -> None:
    estimate, truth, novel = material(seed), material(seed + 100), lights()
    found = evaluate_material(estimate, truth, novel)
    expected = numpy_scores(estimate, truth, novel.position.double().numpy())
    assert {name: getattr(found, name) for name in expected} == pytest.approx(expected, abs=1e-4)
    assert math.isnan(found.lpips)


def test_functional_forms_agree_with_evaluate_material() -> None:
    estimate, truth, novel, network = material(0), material(1), lights(), LPIPS()
    scores = evaluate_material(estimate, truth, novel, lpips=network)
    a, b = render(estimate, novel), render(truth, novel)
    assert rendering_rmse(a, b) == pytest.approx(scores.rendering, abs=1e-6)
    assert rendering_lpips(a, b, network) == pytest.approx(scores.lpips, abs=1e-5)
    each = [float(network(encoded(x), encoded(y))) for x, y in zip(a.split(1), b.split(1), strict=True)]
    assert scores.lpips == pytest.approx(sum(each) / len(each), abs=1e-5)
    assert scores.lpips > 0.05


def encoded(image: torch.Tensor) -> torch.Tensor:
    return image.clamp(0, 1) ** (1 / 2.2) * 2 - 1


def test_the_truth_itself_scores_zero() -> None:
    truth = material(3)
    assert evaluate_material(truth, truth, lights(), lpips=LPIPS()) == SceneScores(*[0.0] * 8)


def test_known_values() -> None:
    truth = SVBRDF.constant(32, 32, diffuse=0.2, roughness=0.5, specular=0.04, batch=2)
    other = SVBRDF.constant(32, 32, diffuse=0.5, roughness=0.3, specular=0.06, batch=2)
    tilted = SVBRDF(other.normal[:, [2, 1, 0]], other.diffuse, other.roughness, other.specular)
    found = map_rmse(tilted, truth)
    expected = {
        "normal": math.sqrt(2 * 0.5**2 / 3),  # (1, 0, 0) against (0, 0, 1), halved
        "diffuse": 0.3,
        "roughness": 0.2,
        "specular": 0.02,
        "diffuse_gamma": 0.5 ** (1 / 2.2) - 0.2 ** (1 / 2.2),
        "specular_gamma": 0.06 ** (1 / 2.2) - 0.04 ** (1 / 2.2),
    }
    assert set(found) == set(expected)
    for name, value in expected.items():
        assert found[name].tolist() == pytest.approx([value, value], abs=1e-6)


def test_rendering_rmse_pools_the_renderings_of_a_scene() -> None:
    a = torch.zeros(2, 3, 8, 8)
    b = torch.stack([torch.zeros(3, 8, 8), torch.full((3, 8, 8), 5.0)])
    # One rendering off by 1 after clamping, one exact: sqrt(1/2), not the mean of 0 and 1.
    assert rendering_rmse(a, b) == pytest.approx(math.sqrt(0.5), abs=1e-6)


def test_the_mean_is_over_scenes() -> None:
    mean = SceneScores.mean([SceneScores(*[0.1] * 8), SceneScores(*[0.3] * 8)])
    assert mean.normal == pytest.approx(0.2)
    assert mean.lpips == pytest.approx(0.2)
    with pytest.raises(ValueError, match="no scenes"):
        SceneScores.mean([])


def test_errors_quote_shapes() -> None:
    with pytest.raises(ValueError, match=r"normal maps differ.*\(1, 3, 48, 48\).*\(1, 3, 32, 32\)"):
        map_rmse(material(0), material(0, size=32))
    with pytest.raises(ValueError, match=r"\(2, 3, 8, 8\) and \(1, 3, 8, 8\)"):
        rendering_rmse(torch.zeros(2, 3, 8, 8), torch.zeros(1, 3, 8, 8))
    two = SVBRDF.cat([material(0), material(1)])
    with pytest.raises(ValueError, match=r"one material .* 2 and 2"):
        evaluate_material(two, two, lights())


def test_nan_is_refused_rather_than_averaged() -> None:
    broken = material(0)
    broken.diffuse[0, 0, 0, 0] = torch.nan
    with pytest.raises(ValueError, match="NaN"):
        evaluate_material(broken, material(1), lights())
