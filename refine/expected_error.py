"""How wrong maps are likely to be, by what can be seen of a photo and its material: a small regression.

Some photos tell more than others: a dull surface says little of its specular albedo, a dark one little of its
colour, and a material that contradicts its photo is wrong somewhere. Such features of every pixel, and
their means over the photo, predict the logarithm of each map's error linearly. The coefficients were fitted
to materials of training licence kept out of training (`python -m eval.uncertainty fit`); no error in them
comes from an evaluation set.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from losses.refinement import log_residual
from losses.reflectance import LOG_OFFSET
from nets.svbrdf import MAPS, SVBRDF
from refine.bands import render_in_bands
from refine.capture import Capture
from refine.initialization import NETWORK_SIZE
from refine.upsampling import legal

FEATURES = (
    "contradiction",
    "residue",
    "contrast",
    "luminance",
    "clipped",
    "diffuse",
    "diffuse chroma",
    "roughness",
    "roughness from the middle",
    "specular",
    "specular chroma",
    "slope",
    "diffuse moved",
    "specular moved",
    "normal moved",
)
"""What is looked at, at the pixel and as the photo's mean; see `features`."""

NEIGHBOURHOOD = 9
"""Side of the squares that contrast is measured in, pixels of 256."""

SMALL = 1e-3
"""Added before logarithms of map values."""

ERROR_FLOOR = 0.01
"""Added before logarithms of errors: what is smaller counts as right."""

LARGEST_SCORE = 3.0
"""Features farther than this many standard deviations from their mean count as if they were there."""


@dataclass(frozen=True)
class ErrorModel:
    """Coefficients of the regression.

    Attributes:
        mean: of the features, then of their means over a photo.
        deviation: likewise.
        weights: of the standardised features and of 1, by map.
        scale: by map; what makes deviations (`refine.uncertainty`) as large as errors are.
        origin: data, seed, commit and what else is known of the fit.
    """

    mean: tuple[float, ...]
    deviation: tuple[float, ...]
    weights: dict[str, tuple[float, ...]]
    scale: dict[str, float]
    origin: dict[str, Any]

    def of(self, seen: Float[Tensor, "pixels twice_features"]) -> Float[Tensor, "pixels 4"]:
        """Return the expected errors of `MAPS`, in the units of the maps, without `scale`."""
        weights = seen.new_tensor([self.weights[name] for name in MAPS])
        scores = standardise(seen, seen.new_tensor(self.mean), seen.new_tensor(self.deviation))
        return ((scores @ weights.T).exp() - ERROR_FLOOR).clamp(min=SMALL)

    def save(self, path: Path) -> None:
        """Write as JSON."""
        path.write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")

    @staticmethod
    @cache
    def shipped() -> ErrorModel:
        """Return the model of the shipped network and the recipe `default`."""
        content = json.loads(files("refine").joinpath("error_model.json").read_text(encoding="utf-8"))
        return ErrorModel(
            tuple(content["mean"]),
            tuple(content["deviation"]),
            {name: tuple(weights) for name, weights in content["weights"].items()},
            content["scale"],
            content["origin"],
        )


def standardise(
    seen: Float[Tensor, "pixels n"], mean: Float[Tensor, "n"], deviation: Float[Tensor, "n"]
) -> Float[Tensor, "pixels n_and_1"]:
    """Return clipped z-scores, and a column of ones."""
    scores = ((seen - mean) / deviation).clamp(-LARGEST_SCORE, LARGEST_SCORE)
    return torch.cat([scores, torch.ones_like(scores[:, :1])], dim=1)


def expected_errors(
    initial: SVBRDF, refined: SVBRDF, capture: Capture, model: ErrorModel | None = None
) -> Float[Tensor, "1 4 h w"]:
    """Return the error to be expected of each of `MAPS`, root mean square over its channels.

    It is computed at the network's size and interpolated: how doubtful a place is changes slowly.

    Args:
        initial: where refinement began.
        refined: where it ended.
        capture: the photo, with its light.
        model: by default the shipped one.
    """
    model = model or ErrorModel.shipped()
    height, width = refined.size
    seen = features(shrink(initial), shrink(refined), shrink_capture(capture))
    errors = model.of(with_means(seen)).T.reshape(1, len(MAPS), *seen.shape[-2:])
    return functional.interpolate(errors, (height, width), mode="bilinear", align_corners=False)


def with_means(seen: Float[Tensor, "1 n h w"]) -> Float[Tensor, "pixels twice_n"]:
    """Return features by pixel, each followed by the photo's means."""
    by_pixel = seen[0].flatten(1).T
    return torch.cat([by_pixel, by_pixel.mean(dim=0).expand_as(by_pixel)], dim=1)


@torch.no_grad()
def features(initial: SVBRDF, refined: SVBRDF, capture: Capture) -> Float[Tensor, "1 15 h w"]:
    """Return `FEATURES` of every pixel: logarithms but for what is a share or a roughness."""
    light = capture.light
    assert light is not None
    luminance = _log(_mean(capture.photo), LOG_OFFSET)

    def residual(svbrdf: SVBRDF) -> Tensor:
        rendering = render_in_bands(svbrdf, light, capture.camera)
        return _log(_mean(log_residual(rendering, capture.photo, capture.unsaturated).abs()))

    variance = (_blur(luminance**2) - _blur(luminance) ** 2).clamp(min=0.0)
    moved = (
        _mean((initial.diffuse - refined.diffuse).abs()),
        _mean((initial.specular - refined.specular).abs()),
        torch.linalg.vector_norm(initial.normal - refined.normal, dim=1, keepdim=True),
    )
    return torch.cat(
        [
            residual(initial),
            residual(refined),
            _log(variance.sqrt()),
            luminance,
            (~capture.unsaturated).to(luminance.dtype),
            _log(_mean(refined.diffuse)),
            _log(_range(refined.diffuse)),
            refined.roughness,
            (refined.roughness - 0.5) ** 2,
            _log(_mean(refined.specular)),
            _log(_range(refined.specular)),
            _log(torch.linalg.vector_norm(refined.normal[:, :2], dim=1, keepdim=True)),
            *(_log(distance) for distance in moved),
        ],
        dim=1,
    )


def shrink(svbrdf: SVBRDF) -> SVBRDF:
    """Return the material at no more than the network's size."""
    return legal(svbrdf.map(_shrink))


def shrink_capture(capture: Capture) -> Capture:
    """Return the photo at no more than the network's size; a pixel that holds a clipped one is clipped."""
    unsaturated = _shrink(capture.unsaturated.to(capture.photo.dtype)) == 1.0
    return Capture(_shrink(capture.photo), unsaturated, capture.camera, capture.light)


def _shrink(tensor: Tensor) -> Tensor:
    height, width = tensor.shape[-2:]
    ratio = NETWORK_SIZE / max(height, width)
    if ratio >= 1.0:
        return tensor
    return functional.interpolate(
        tensor, (max(1, round(height * ratio)), max(1, round(width * ratio))), mode="area"
    )


def _blur(tensor: Tensor) -> Tensor:
    return functional.avg_pool2d(tensor, NEIGHBOURHOOD, 1, NEIGHBOURHOOD // 2, count_include_pad=False)


def _mean(tensor: Tensor) -> Tensor:
    return tensor.mean(dim=1, keepdim=True)


def _range(tensor: Tensor) -> Tensor:
    return tensor.amax(dim=1, keepdim=True) - tensor.amin(dim=1, keepdim=True)


def _log(tensor: Tensor, small: float = SMALL) -> Tensor:
    return (tensor + small).log()
