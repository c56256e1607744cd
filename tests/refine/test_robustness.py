"""Whatever refinement is fed: finite legal maps, no exception, no photo explained worse than before."""

import math
from dataclasses import dataclass
from typing import Any, Literal

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from nets.render import Camera, PointLight, render
from nets.svbrdf import SVBRDF
from refine.bands import distance_in_bands
from refine.capture import Capture
from refine.run import run_stages
from refine.stages import RECIPES

values = st.sampled_from([0.0, 1.0, 1e-30, 1e-8, 1e-3, 0.03, 0.5, 0.999, 1.0 - 1e-7])
coordinates = st.one_of(
    st.sampled_from([0.0, -1.0, 1.0, 1e-6, 30.0]), st.floats(-20.0, 20.0, allow_nan=False, width=32)
)
HEIGHTS = [1e-3, 0.3, 2.0, 50.0, 1e4]


@st.composite
def planes(draw: st.DrawFn, channels: int, size: tuple[int, int]) -> Tensor:
    """Noise in [0, 1], a constant at or near an end of the range, or noise with such pixels in it."""
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    noise = torch.rand(1, channels, *size, generator=generator)
    odd = torch.full_like(noise, draw(values))
    share = draw(st.sampled_from([0.0, 0.3, 1.0]))
    return torch.where(torch.rand(noise.shape, generator=generator) < share, odd, noise)


@st.composite
def materials(draw: st.DrawFn, size: tuple[int, int]) -> dict[str, Tensor]:
    """Maps of any legal material: normals down to the horizon, mirrors, black and white."""
    tilt = draw(st.sampled_from([0.0, 0.3, 3.0, 1e4]))
    slope = (2.0 * draw(planes(2, size)) - 1.0) * tilt
    normal = torch.cat([slope, torch.ones_like(slope[:, :1])], dim=1)
    return {
        "normal": torch.nn.functional.normalize(normal, dim=1),
        "diffuse": draw(planes(3, size)),
        "roughness": draw(planes(1, size)).clamp(min=1e-3),
        "specular": draw(planes(3, size)),
    }


@dataclass(frozen=True)
class Case:
    """A material, photos that may or may not be of it, and a recipe with few steps."""

    initial: dict[str, Tensor]
    photos: list[dict[str, Any]]
    recipe: str
    iterations: int


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """Draw one to three photos: renderings of some material, or anything."""
    size = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    photos = [
        {
            "position": [draw(coordinates), draw(coordinates), draw(st.sampled_from(HEIGHTS))],
            "intensity": draw(st.sampled_from([1e-4, 1.0, 100.0])),
            "falloff": draw(st.sampled_from(["none", "inverse_square"])),
            "camera": draw(st.sampled_from(["perspective", "orthographic", "collocated"])),
            "shown": draw(materials(size)) if draw(st.booleans()) else draw(planes(3, size)),
        }
        for _ in range(draw(st.sampled_from([1, 1, 1, 3])))
    ]
    recipe, iterations = draw(st.sampled_from(sorted(RECIPES))), draw(st.integers(0, 24))
    return Case(draw(materials(size)), photos, recipe, iterations)


def capture(
    position: list[float],
    intensity: float,
    falloff: Literal["none", "inverse_square"],
    camera: Literal["perspective", "orthographic", "collocated"],
    shown: dict[str, Tensor] | Tensor,
) -> Capture:
    """Make a photo: a rendering of some maps, or what is shown."""
    light = PointLight(torch.tensor([position]), torch.full((1, 3), intensity), falloff)
    photo = shown
    if isinstance(shown, dict):
        photo = render(SVBRDF(**shown), light, Camera(camera)).clamp(0.0, 1.0)
    return Capture(photo, (photo < 1.0).all(dim=1, keepdim=True), Camera(camera), light)


@pytest.mark.parametrize(("engine", "examples"), [("fused", 1000), ("reference", 100)])
def test_any_input_gives_a_legal_material_that_explains_its_photos_no_worse(
    engine: str, examples: int
) -> None:
    @settings(max_examples=examples)
    @given(cases())
    def check(case: Case) -> None:
        captures = [capture(**photo) for photo in case.photos]
        recipe = RECIPES[case.recipe].with_iterations(case.iterations)
        refined, losses = run_stages(SVBRDF(**case.initial), captures, recipe, {}, None, engine)
        refined.validate()
        assert all(math.isfinite(loss) for history in losses.values() for loss in history)
        assert sum(distance_in_bands(refined, photo) for photo in captures) <= losses["initialization"][0]

    check()
