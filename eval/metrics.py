"""Metrics of the evaluation (paper Table 1): map RMSE, rendering RMSE and LPIPS under novel lights.

Pure functions of tensors. Files and test sets are `datasets.py`; averaging over scenes is `development.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from losses.perceptual import LPIPS
from nets.color import GAMMA
from nets.render import Camera, PointLight, shade, shading_geometry, surface_points
from nets.svbrdf import MAPS, SVBRDF

CHUNK = 4
"""Renderings computed at a time: four at 512 px, truth and estimate and LPIPS features, stay below 1 GB."""


@dataclass(frozen=True)
class SceneScores:
    """Scores of one estimate of one scene, or their means over scenes; lower is better in all.

    Attributes:
        normal: RMSE of (n + 1) / 2.
        diffuse: RMSE of the linear map.
        roughness: RMSE.
        specular: RMSE of the linear map.
        diffuse_gamma: RMSE of the map encoded with gamma 1/2.2.
        specular_gamma: RMSE of the map encoded with gamma 1/2.2.
        rendering: RMSE over all test renderings of the scene, clamped and encoded with gamma 1/2.2.
        lpips: mean LPIPS over the test renderings; NaN if it was not asked for.
    """

    normal: float
    diffuse: float
    roughness: float
    specular: float
    diffuse_gamma: float
    specular_gamma: float
    rendering: float
    lpips: float = math.nan

    @staticmethod
    def mean(scores: Sequence[SceneScores]) -> SceneScores:
        """Average over scenes (or over test sets).

        Raises:
            ValueError: if there are none.
        """
        if not scores:
            raise ValueError("there are no scenes to average over")
        columns = (field.name for field in fields(SceneScores))
        return SceneScores(*(math.fsum(getattr(s, name) for s in scores) / len(scores) for name in columns))


def encode(image: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Clamp linear values to [0, 1] and encode them with gamma 1/2.2.

    Unlike `nets.color.gamma_encode` this has no floor near black: no gradient passes here, and the
    definition must be the one anyone would recompute.
    """
    return image.clamp(0.0, 1.0) ** (1.0 / GAMMA)


def map_rmse(estimate: SVBRDF, truth: SVBRDF) -> dict[str, Float[Tensor, "batch"]]:
    """Return the RMSE of each map of each material, over its pixels and channels.

    Args:
        estimate: maps as `SVBRDF` states them.
        truth: maps of the same size.

    Returns:
        `normal` (of (n + 1) / 2), `diffuse`, `roughness`, `specular` (linear), and `diffuse_gamma`,
        `specular_gamma` (encoded with 1/2.2): the paper does not say which its Table 1 means.

    Raises:
        ValueError: quoting both shapes if they differ.
    """
    _check_maps(estimate, truth)
    result = {}
    for name in MAPS:
        # (n + 1) / 2 halves differences of normals; the offset cancels.
        scale = 0.5 if name == "normal" else 1.0
        result[name] = scale * _rmse(getattr(estimate, name), getattr(truth, name))
    for name in ("diffuse", "specular"):
        result[f"{name}_gamma"] = _rmse(encode(getattr(estimate, name)), encode(getattr(truth, name)))
    return result


def rendering_rmse(
    a: Tensor,  # [lights, 3, h, w], checked below
    b: Tensor,  # [lights, 3, h, w]
) -> float:
    """Return one RMSE over all of a scene's renderings, clamped and encoded with gamma 1/2.2.

    Args:
        a: linear radiance.
        b: linear radiance of the same shape.

    Raises:
        ValueError: quoting both shapes if they differ.
    """
    _check_renderings(a, b)
    return math.sqrt(float(((encode(a) - encode(b)) ** 2).mean()))


@torch.no_grad()
def rendering_lpips(
    a: Tensor,  # [lights, 3, h, w], checked below
    b: Tensor,  # [lights, 3, h, w]
    lpips: LPIPS,
) -> float:
    """Return the mean LPIPS over a scene's renderings, clamped, encoded with 1/2.2 and scaled to [-1, 1].

    Args:
        a: linear radiance.
        b: linear radiance of the same shape.
        lpips: the network.

    Raises:
        ValueError: quoting both shapes if they differ.
    """
    _check_renderings(a, b)
    pairs = zip(a.split(CHUNK), b.split(CHUNK), strict=True)
    return _mean_lpips([lpips(encode(x) * 2.0 - 1.0, encode(y) * 2.0 - 1.0) for x, y in pairs])


@torch.no_grad()
def evaluate_material(
    estimate: SVBRDF,
    truth: SVBRDF,
    lights: PointLight,
    camera: Camera | None = None,
    *,
    lpips: LPIPS | None = None,
) -> SceneScores:
    """Score one estimated material against the truth.

    Args:
        estimate: a batch of one.
        truth: a batch of one of the same size.
        lights: the novel lights, one rendering each.
        camera: of the renderings; the authors' perspective camera by default.
        lpips: the network; None skips LPIPS, which takes six sevenths of the time.

    Returns:
        Scores as `SceneScores` states them.

    Raises:
        ValueError: if shapes differ, either batch is not one, or the estimate holds NaN.
    """
    if estimate.batch != 1 or truth.batch != 1:
        raise ValueError(f"one material is scored at a time, got batches {estimate.batch} and {truth.batch}")
    maps = {name: float(value) for name, value in map_rmse(estimate, truth).items()}
    if not all(math.isfinite(value) for value in maps.values()):
        raise ValueError("the estimate holds NaN or infinity")

    squares, distances = [], []
    for a, b in _render_pairs(estimate, truth, lights, camera):
        squares.append((a - b).square().mean(dim=(1, 2, 3)))
        if lpips is not None:
            distances.append(lpips(a * 2.0 - 1.0, b * 2.0 - 1.0))
    return SceneScores(
        **maps,
        rendering=math.sqrt(float(torch.cat(squares).mean())),
        lpips=_mean_lpips(distances) if distances else math.nan,
    )


def _render_pairs(
    estimate: SVBRDF, truth: SVBRDF, lights: PointLight, camera: Camera | None
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield encoded renderings of both, a few lights at a time; they share directions and Fresnel weights."""
    points = surface_points(*truth.size, dtype=truth.normal.dtype, device=truth.normal.device)
    for start in range(0, lights.position.shape[0], CHUNK):
        geometry = shading_geometry(points, lights[slice(start, start + CHUNK)], camera)
        yield encode(shade(estimate, geometry)), encode(shade(truth, geometry))


def _mean_lpips(distances: Sequence[Tensor]) -> float:
    return float(torch.cat(list(distances)).mean())


def _rmse(a: Tensor, b: Tensor) -> Tensor:
    return ((a - b) ** 2).mean(dim=(1, 2, 3)).sqrt()


def _check_maps(estimate: SVBRDF, truth: SVBRDF) -> None:
    for name in MAPS:
        a, b = tuple(getattr(estimate, name).shape), tuple(getattr(truth, name).shape)
        if a != b:
            raise ValueError(f"the {name} maps differ in shape: estimate {a}, truth {b}")


def _check_renderings(a: Tensor, b: Tensor) -> None:
    if a.shape != b.shape or a.ndim != 4 or a.shape[1] != 3:
        raise ValueError(
            f"expected two stacks of renderings [lights, 3, height, width] of one shape, "
            f"got {tuple(a.shape)} and {tuple(b.shape)}"
        )
