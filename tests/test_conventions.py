"""`docs/conventions.md`, executed: every statement of the page is quoted here and checked against the code.

`@states("C01", "...")` ties a test to a statement. What goes wrong in detail is for the tests of each room;
here each convention is checked once, from outside, with its formula written out again. At the end: the
constants of `docs/methods.md` and the modules of `docs/architecture.md`.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from torch import Tensor

from eval.datasets import CAMERA, input_photo, novel_lights, strip_scenes
from eval.metrics import SceneScores, evaluate_material, map_rmse, rendering_lpips, rendering_rmse
from losses.perceptual import LPIPS
from losses.refinement import photo_distance
from nets.architectures import NetworkConfig, build
from nets.baselines.autoencoder import NARROW_AUTOENCODER, PAPER_AUTOENCODER
from nets.baselines.des18 import NARROW_DES18, PAPER_DES18
from nets.baselines.des19 import NARROW_DES19, PAPER_DES19
from nets.color import gamma_encode, to_network_input
from nets.data.augment import Pose, view_tile
from nets.data.images import resize
from nets.data.pbr import read_pbr_folder
from nets.data.strips import read_strip, write_strip
from nets.generator import NARROW_GENERATOR, PAPER_GENERATOR, Generator, GeneratorConfig, maps_to_svbrdf
from nets.light_head import light_from_output, light_to_output
from nets.render import (
    PRESETS,
    Camera,
    Conventions,
    Geometry,
    PointLight,
    cook_torrance,
    render,
    schlick_weight,
    shading_geometry,
    surface_points,
)
from nets.sampling import PAPER_LIGHTS
from nets.svbrdf import CHANNELS, MAPS, SVBRDF
from nets.training import TrainingBatch
from refine.capture import Capture
from refine.errors import UserError
from refine.export import packed
from refine.export.bundle import TEXTURES, Picture, Source
from refine.fidelity import rerendering_rmse
from refine.initialization import NETWORK_SIZE, initialize
from refine.maps import MapFormat, NormalConvention, read_maps, write_maps
from refine.photo import photo_from_array, read_photo, resize_photo
from tests.helpers import assert_close, random_light, random_svbrdf, seeded

ROOT = Path(__file__).parent.parent
PAGE, METHODS, ARCHITECTURE = (ROOT / "docs" / f"{n}.md" for n in ("conventions", "methods", "architecture"))
TINY = GeneratorConfig(width=4, levels=2, deep_multiplier=2)
ORTHOGRAPHIC = Camera("orthographic")

QUOTED: dict[str, str] = {}
"""Statement text by id, as the tests below quote it."""

Test = Callable[..., None]


def states(identity: str, text: str) -> Callable[[Test], Test]:
    """Tie a test to one statement of the page; two tests of one id are a mistake."""

    def register(test: Test) -> Test:
        assert identity not in QUOTED, f"{identity} has two tests"
        assert test.__name__.startswith("test_"), f"{test.__name__} would not run"
        assert test.__name__ not in globals(), f"two tests are called {test.__name__}"
        QUOTED[identity] = text
        return test

    return register


def statements(page: str) -> list[tuple[str, str]]:
    """Return the ids and texts of a page's statements, in order, line breaks undone."""
    items = re.findall(r"^- \*\*(C\d+)\*\* (.*(?:\n  .*)*)", page, flags=re.MULTILINE)
    return [(identity, " ".join(text.split())) for identity, text in items]


def test_every_statement_is_quoted_and_tested() -> None:
    page = PAGE.read_text(encoding="utf-8")
    found = statements(page)
    assert len(found) == len(re.findall(r"\*\*C\d+\*\*", page)), "an id stands outside a list item"
    identities = [identity for identity, _ in found]
    assert len(identities) == len(set(identities)), "an id is used twice"
    untested = sorted(set(identities) - set(QUOTED))
    assert not untested, f"statements without a test: {untested}"
    gone = sorted(set(QUOTED) - set(identities))
    assert not gone, f"tests of statements that are not on the page: {gone}"
    for identity, text in found:
        assert QUOTED[identity] == text, f"{identity} is not quoted word for word"


def test_the_reader_of_statements_sees_what_is_there() -> None:
    page = "Text.\n\n- **C01** One\n  and a half.\n- **C02** Two.\n\n- **C01** Again.\n- not one\n"
    assert statements(page) == [("C01", "One and a half."), ("C02", "Two."), ("C01", "Again.")]


# Surface and pixels


@states(
    "C01",
    "The surface is the plane z = 0; the longer side of the image spans [-1, 1] from edge to edge, and "
    "pixels are square.",
)
def test_surface_plane() -> None:
    for height, width in ((4, 8), (8, 4), (6, 6)):
        x, y, z = surface_points(height, width)
        pixel = 2.0 / max(height, width)
        assert float(z.abs().max()) == 0.0
        assert_close(x.diff(dim=1), torch.full((height, width - 1), pixel))
        assert_close(y.diff(dim=0), torch.full((height - 1, width), -pixel))
        edges = torch.stack(
            [x.min() - pixel / 2, x.max() + pixel / 2, y.min() - pixel / 2, y.max() + pixel / 2]
        )
        half_width, half_height = width * pixel / 2, height * pixel / 2
        assert max(half_width, half_height) == 1.0
        assert_close(edges, torch.tensor([-half_width, half_width, -half_height, half_height]))


@states("C02", "x points right, y up and z to the viewer; row 0 of every image is its top.")
def test_axes() -> None:
    def brightest(light: tuple[float, float, float]) -> tuple[int, int]:
        image = render(matte(9, 9), PointLight.at(light), ORTHOGRAPHIC)[0, 0]
        return divmod(int(image.argmax()), 9)

    right, top = 8.0 / 9.0, 8.0 / 9.0
    assert brightest((right, 0.0, 0.5)) == (4, 8)
    assert brightest((0.0, top, 0.5)) == (0, 4)
    assert float(render(matte(9, 9), PointLight.at((0.0, 0.0, -0.5))).max()) == 0.0  # behind the surface


@states("C03", "Pixel centres are sampled: along a longer side of n pixels the first one is at -1 + 1/n.")
def test_pixel_centres() -> None:
    for count in (1, 2, 5, 256):
        x, y, _ = surface_points(count, count)
        assert float(x[0, 0]) == pytest.approx(-1.0 + 1.0 / count, abs=1e-6)
        assert float(y[-1, 0]) == pytest.approx(-1.0 + 1.0 / count, abs=1e-6)
    assert Conventions().grid == "centre"


@states(
    "C04",
    "The `corner` grid puts the first and last pixel of the longer side on -1 and 1, as the authors' code "
    "does; of the presets only `des19` uses it.",
)
def test_corner_grid() -> None:
    x, y, _ = surface_points(8, 8, grid="corner")
    assert_close(x[0], torch.linspace(-1.0, 1.0, 8))
    assert_close(y[:, 0], torch.linspace(1.0, -1.0, 8))
    assert {name for name, preset in PRESETS.items() if preset.grid == "corner"} == {"des19"}


# Material


def matte(height: int, width: int) -> SVBRDF:
    """White Lambertian: no specular but for the trace that Schlick's blend leaves at this roughness."""
    return SVBRDF.constant(height, width, diffuse=1.0, roughness=1.0, specular=0.0)


def with_map(name: str, value: Tensor) -> SVBRDF:
    """A legal material of one map's size but for that map."""
    legal = SVBRDF.constant(value.shape[-2], value.shape[-1], batch=value.shape[0])
    return SVBRDF(**{key: value if key == name else getattr(legal, key) for key in MAPS})


def refused(name: str, values: float | tuple[float, ...]) -> bool:
    """Whether a map of that value everywhere is refused, by name."""
    channels = (
        torch.tensor(values).expand(CHANNELS[name]) if isinstance(values, float) else torch.tensor(values)
    )
    material = with_map(name, channels[None, :, None, None].expand(1, -1, 2, 2))
    try:
        material.validate()
    except ValueError as error:
        return name in str(error)
    return False


@states(
    "C05",
    "`SVBRDF.normal` is `[B, 3, H, W]`: unit vectors in tangent space, +y up (OpenGL), never below the "
    "horizon.",
)
def test_normal_map() -> None:
    assert SVBRDF.constant(2, 5, batch=3).validate().normal.shape == (3, 3, 2, 5)
    assert not refused("normal", (0.6, 0.0, 0.8))
    assert refused("normal", (0.6, 0.0, 0.9))
    assert refused("normal", (0.6, 0.0, -0.8))
    up, down = (with_map("normal", torch.tensor([0.0, y, 0.8])[None, :, None, None]) for y in (0.6, -0.6))
    from_the_top = PointLight.at((0.0, 3.0, 1.0))
    assert float(render(up, from_the_top).mean()) > 2.0 * float(render(down, from_the_top).mean())


@states("C06", "`SVBRDF.diffuse` is `[B, 3, H, W]`: linear albedo in [0, 1].")
def test_diffuse_map() -> None:
    assert SVBRDF.constant(2, 5, batch=3).validate().diffuse.shape == (3, 3, 2, 5)
    assert [refused("diffuse", value) for value in (-0.01, 0.0, 1.0, 1.01)] == [True, False, False, True]
    # Linear: half the albedo reflects half the light.
    full, half = (SVBRDF.constant(3, 3, diffuse=d, specular=0.0, roughness=1.0) for d in (0.8, 0.4))
    dark = render(SVBRDF.constant(3, 3, diffuse=0.0, specular=0.0, roughness=1.0), PointLight.at((0, 0, 2)))
    first, second = (render(m, PointLight.at((0, 0, 2))) - dark for m in (full, half))
    assert_close(first, 2.0 * second)


@states("C07", "`SVBRDF.roughness` is `[B, 1, H, W]` in (0, 1]; the GGX alpha is its square.")
def test_roughness_map() -> None:
    assert SVBRDF.constant(2, 5, batch=3).validate().roughness.shape == (3, 1, 2, 5)
    assert [refused("roughness", value) for value in (0.0, 1e-4, 1.0, 1.01)] == [True, False, False, True]
    # Straight above, D = 1 / (pi alpha^2) and G = F = 1: the peak tells alpha.
    bare = SVBRDF.constant(1, 1, diffuse=0.0, specular=1.0, roughness=0.5)
    peak = float(render(bare, PointLight.at((0.0, 0.0, 2.0)), ORTHOGRAPHIC)[0, 0])
    alpha = 1.0 / math.sqrt(4.0 * peak)
    assert alpha == pytest.approx(0.5**2, rel=1e-4)


@states("C08", "`SVBRDF.specular` is `[B, 3, H, W]`: linear reflectance at normal incidence (F0) in [0, 1].")
def test_specular_map() -> None:
    assert SVBRDF.constant(2, 5, batch=3).validate().specular.shape == (3, 3, 2, 5)
    assert [refused("specular", value) for value in (-0.01, 0.0, 1.0, 1.01)] == [True, False, False, True]
    low, high = (SVBRDF.constant(1, 1, diffuse=0.0, specular=s, roughness=1.0) for s in (0.3, 0.6))
    overhead = PointLight.at((0.0, 0.0, 2.0))
    ratio = render(high, overhead, ORTHOGRAPHIC) / render(low, overhead, ORTHOGRAPHIC)
    assert_close(ratio, torch.full_like(ratio, 2.0), rtol=1e-3)


@states("C09", "The order of the maps is normal, diffuse, roughness, specular: ten channels.")
def test_order_of_maps() -> None:
    assert MAPS == ("normal", "diffuse", "roughness", "specular")
    material = random_svbrdf()
    maps = [material.normal, material.diffuse, material.roughness, material.specular]
    assert torch.equal(material.channels(), torch.cat(maps, dim=1))
    assert material.channels().shape[1] == 10


@states(
    "C10",
    "When a picture of a material turns or is mirrored, its normals turn with it: the turned material under "
    "the turned light is the turned photo.",
)
def test_normals_turn_with_the_picture() -> None:
    material, light = random_svbrdf(1, 8, 8), PointLight.at((0.5, 0.9, 1.6))
    photo = render(material, light)
    centre, whole = torch.zeros(1, 2), torch.ones(1)
    quarter = Pose(torch.tensor([math.pi / 2]), torch.tensor([False]), whole, centre)
    turned = render(view_tile(material, quarter, 8), PointLight.at((-0.9, 0.5, 1.6)))
    assert_close(turned, torch.rot90(photo, 1, dims=(2, 3)), atol=1e-4, rtol=1e-3)
    flip = Pose(torch.zeros(1), torch.tensor([True]), whole, centre)
    mirrored = render(view_tile(material, flip, 8), PointLight.at((-0.5, 0.9, 1.6)))
    assert_close(mirrored, photo.flip(3), atol=1e-4, rtol=1e-3)


# Reflectance


def dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(dim=1, keepdim=True).clamp(min=0.0)


def geometry(light: Tensor, view: Tensor, half: Tensor) -> Geometry:
    """Any three directions, consistent or not, so that one factor of the model can be looked at alone."""
    weight = schlick_weight(dot(view, half))
    return Geometry(light, view, half, weight, torch.ones(1, 3, 1, 1, dtype=light.dtype))


def tilted(cosine: Tensor) -> Tensor:
    """Unit vectors [1, 3, 1, n] at given cosines to the flat normal."""
    return torch.stack([torch.sqrt(1.0 - cosine**2), torch.zeros_like(cosine), cosine])[None, :, None]


COSINES = torch.linspace(0.0, 1.0, 33, dtype=torch.float64)
FLAT = tilted(torch.ones_like(COSINES))


def mirror(roughness: float) -> SVBRDF:
    """Neither diffuse nor Fresnel: f = D G / 4."""
    return SVBRDF.constant(1, 33, diffuse=0.0, roughness=roughness, specular=1.0, dtype=torch.float64)


@states(
    "C11",
    "The BRDF is Cook-Torrance as in Deschaintre et al. 2018 and Karis 2013: `f = d (1 - s) / pi + D G F / "
    "4`.",
)
def test_brdf() -> None:
    material = random_svbrdf(2, 8, 8, dtype=torch.float64)
    light = random_light(2, dtype=torch.float64)
    seen = shading_geometry(surface_points(8, 8, dtype=torch.float64), light)
    n_l, n_v = dot(material.normal, seen.light_direction), dot(material.normal, seen.view)
    n_h, v_h = dot(material.normal, seen.half_vector), dot(seen.view, seen.half_vector)
    a = material.roughness**2
    k = a / 2
    d_term = (a / (n_h**2 * (a**2 - 1) + 1)) ** 2 / math.pi
    g_term = 1 / ((n_l * (1 - k) + k) * (n_v * (1 - k) + k))
    f_term = material.specular + (1 - material.specular) * 2 ** ((-5.55473 * v_h - 6.98316) * v_h)
    expected = material.diffuse * (1 - material.specular) / math.pi + d_term * g_term * f_term / 4
    assert_close(cook_torrance(material, seen), expected, rtol=1e-6, atol=1e-9)


@states("C12", "The distribution is GGX: `D = (a / ((n.h)^2 (a^2 - 1) + 1))^2 / pi` with `a = r^2`.")
def test_distribution() -> None:
    for roughness in (0.1, 0.4, 1.0):
        a = roughness**2
        found = 4.0 * cook_torrance(mirror(roughness), geometry(FLAT, FLAT, tilted(COSINES)))  # G = F = 1
        expected = (a / (COSINES**2 * (a**2 - 1) + 1)) ** 2 / math.pi
        assert_close(found[0, 0, 0], expected, rtol=1e-6)


@states(
    "C13",
    "The visibility term `G = 1 / (((n.l) (1 - k) + k) ((n.v) (1 - k) + k))` with `k = a / 2` already "
    "contains the division by `(n.l) (n.v)`.",
)
def test_visibility() -> None:
    for roughness in (0.1, 0.4, 1.0):
        k = roughness**2 / 2
        peak = 1.0 / (math.pi * roughness**4)  # D where h = n
        leaning = geometry(tilted(COSINES), tilted(COSINES.flip(0)), FLAT)
        # F = 1 because s = 1.
        found = 4.0 * cook_torrance(mirror(roughness), leaning) / peak
        n_l, n_v = COSINES, COSINES.flip(0)
        assert_close(found[0, 0, 0], 1 / ((n_l * (1 - k) + k) * (n_v * (1 - k) + k)), rtol=1e-6)
    # As alpha vanishes only the textbook's division by n.l and n.v is left (n.l + n.v = 1 here).
    middle = (4.0 * cook_torrance(mirror(0.05), leaning) * math.pi * 0.05**4)[0, 0, 0, 16]
    assert float(middle) == pytest.approx(1.0 / (0.5 * 0.5), rel=0.01)


@states("C14", "The Fresnel term is `F = s + (1 - s) 2^((-5.55473 (v.h) - 6.98316) (v.h))`.")
def test_fresnel() -> None:
    for specular in (0.0, 0.04, 0.7):
        material = SVBRDF.constant(1, 33, diffuse=0.0, roughness=1.0, specular=specular, dtype=torch.float64)
        # At roughness 1 the distribution is 1 / pi in every direction; n.v = v.h because h = n here.
        found = cook_torrance(material, geometry(FLAT, tilted(COSINES), FLAT))
        visibility = 1.0 / (COSINES * 0.5 + 0.5)
        expected = specular + (1 - specular) * 2.0 ** ((-5.55473 * COSINES - 6.98316) * COSINES)
        assert_close(found[0, 0, 0] * 4.0 * math.pi / visibility, expected, rtol=1e-6)


@states(
    "C15",
    "Every floor of the model is a named field of `Conventions`; a roughness below `roughness_floor` is "
    "shaded as that floor, which is 0.03 in the preset `paper` and 0.001 in `des19` and `gao19`.",
)
def test_floors() -> None:
    assert {name: preset.roughness_floor for name, preset in PRESETS.items()} == {
        "paper": 0.03,
        "des19": 0.001,
        "gao19": 0.001,
    }
    assert PRESETS["paper"] == Conventions()
    light = PointLight.at((0.3, 0.2, 2.0))

    def lobe(roughness: float, preset: str) -> Tensor:
        material = SVBRDF.constant(32, 32, roughness=roughness, specular=0.5)
        return render(material, light, ORTHOGRAPHIC, PRESETS[preset])

    assert torch.equal(lobe(0.001, "paper"), lobe(0.03, "paper"))
    assert not torch.equal(lobe(0.04, "paper"), lobe(0.03, "paper"))
    assert not torch.equal(lobe(0.01, "gao19"), lobe(0.03, "gao19"))


# Light and camera


@states(
    "C16",
    "The renderer returns linear radiance `pi f (n.l)` times the light's intensity: a white Lambertian "
    "surface that faces a light of intensity 1 has radiance 1.",
)
def test_unit_of_radiance() -> None:
    white = render(matte(1, 1), PointLight.at((0.0, 0.0, 3.0)))
    assert_close(white, torch.ones(1, 3, 1, 1), atol=1e-4)
    material, light = random_svbrdf(2), random_light(2)
    seen = shading_geometry(surface_points(*material.size), light)
    reflected = math.pi * cook_torrance(material, seen) * dot(material.normal, seen.light_direction)
    assert_close(render(material, light), reflected * light.intensity[:, :, None, None])


@states("C17", "Radiance is not clamped by the renderer; what faces away from the light is black.")
def test_radiance_is_not_clamped() -> None:
    shiny = SVBRDF.constant(3, 3, roughness=0.1, specular=0.5)
    assert float(render(shiny, PointLight.at((0.0, 0.0, 2.0))).max()) > 100.0
    leaning = with_map("normal", torch.tensor([-0.8, 0.0, 0.6])[None, :, None, None])
    assert float(render(leaning, PointLight.at((3.0, 0.0, 1.0))).abs().max()) == 0.0


@states(
    "C18",
    "`PointLight.position` is in surface units, from the centre of the surface; `PointLight.intensity` is "
    "linear RGB.",
)
def test_light() -> None:
    position = (0.4, -0.7, 1.1)
    image = render(matte(8, 16), PointLight.at(position, (1.0, 0.5, 0.25)), ORTHOGRAPHIC)
    x, y, _ = surface_points(8, 16)
    cosine = position[2] / torch.sqrt((position[0] - x) ** 2 + (position[1] - y) ** 2 + position[2] ** 2)
    assert_close(image[0, 0], cosine, rtol=0.05)  # a matte surface, but for its trace of specular
    assert_close(image[0, 1], image[0, 0] * 0.5)
    assert_close(image[0, 2], image[0, 0] * 0.25)


@states(
    "C19",
    "A light has no falloff (the paper) unless it says `inverse_square`; that falloff is normalised to 1 at "
    "the centre of the surface.",
)
def test_falloff() -> None:
    assert PointLight.at((0.0, 0.0, 1.0)).falloff == "none"
    centre = matte(1, 1)
    for distance in (0.7, 1.4, 30.0):
        for falloff in ("none", "inverse_square"):
            light = PointLight.at((0.0, 0.0, distance), falloff=falloff)
            assert_close(render(centre, light), torch.ones(1, 3, 1, 1), atol=1e-4)
    p = torch.tensor([0.3, 0.2, 1.5])
    steady, falling = (
        render(matte(6, 6), PointLight.at((0.3, 0.2, 1.5), falloff=falloff))
        for falloff in ("none", "inverse_square")
    )
    squared = ((p[:, None, None] - surface_points(6, 6)) ** 2).sum(dim=0)
    assert_close(falling / steady, (p.square().sum() / squared).expand(1, 3, 6, 6))


@states(
    "C20",
    "The default camera is perspective at (0, 0, 2.14) surface units, as in the authors' code; photos are "
    "rectified to the surface, so that a camera only decides `v`.",
)
def test_default_camera() -> None:
    assert Camera() == Camera("perspective", (0.0, 0.0, 2.14))
    points, light = surface_points(4, 6), PointLight.at((0.3, 0.2, 1.5))
    seen, flat = shading_geometry(points, light), shading_geometry(points, light, ORTHOGRAPHIC)
    towards = torch.tensor([0.0, 0.0, 2.14])[:, None, None] - points
    assert_close(seen.view[0], towards / torch.linalg.vector_norm(towards, dim=0))
    assert torch.equal(seen.light_direction, flat.light_direction)
    assert torch.equal(seen.irradiance, flat.irradiance)
    material = random_svbrdf(1, 4, 6)
    assert torch.equal(
        render(material, light), render(material, light, Camera("perspective", (0.0, 0.0, 2.14)))
    )


@states("C21", "The orthographic camera (the paper's text) sees every pixel along +z.")
def test_orthographic_camera() -> None:
    view = shading_geometry(surface_points(4, 6), PointLight.at((0.3, 0.2, 1.5)), ORTHOGRAPHIC).view
    assert_close(view, torch.tensor([0.0, 0.0, 1.0])[None, :, None, None].expand(1, 3, 4, 6))


@states("C22", "The collocated camera is at the light, as a phone's flash is.")
def test_collocated_camera() -> None:
    seen = shading_geometry(surface_points(4, 6), PointLight.at((0.3, 0.2, 1.5)), Camera("collocated"))
    assert_close(seen.view, seen.light_direction)


@states(
    "C23",
    "The paper's lights have a cosine-weighted direction on the upper hemisphere and the distance exp(x) "
    "from the centre, x drawn from N(1, 0.75); they are white, of intensity 1, without falloff.",
)
def test_light_distribution() -> None:
    light = PAPER_LIGHTS.sample(40_000, seeded(0))
    distance = torch.linalg.vector_norm(light.position, dim=1)
    assert float(distance.log().mean()) == pytest.approx(1.0, abs=0.02)
    assert float(distance.log().std()) == pytest.approx(0.75, abs=0.02)
    cosine = light.position[:, 2] / distance
    assert float(cosine.min()) >= 0.0
    # With density cos(theta) / pi the square of the cosine is uniform.
    deciles = torch.quantile(cosine**2, torch.linspace(0.1, 0.9, 9))
    assert_close(deciles, torch.linspace(0.1, 0.9, 9), atol=0.01)
    assert torch.equal(light.intensity, torch.ones(40_000, 3))
    assert light.falloff == "none"


# Network


@states(
    "C24",
    "A network sees the linear photo clamped to [0, 1], encoded with gamma 1/2.2 and scaled to [-1, 1]; "
    "values below 1e-6 count as 1e-6.",
)
def test_network_input() -> None:
    photo = torch.cat([torch.tensor([-0.1, 0.0, 0.5, 1.0, 7.0]), torch.rand(187)]).reshape(1, 3, 8, 8)
    expected = photo.clamp(1e-6, 1.0) ** (1.0 / 2.2) * 2.0 - 1.0
    assert_close(to_network_input(photo), expected)
    seen: list[Tensor] = []
    network = Generator(TINY)
    network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    network.predict(photo)
    light = PointLight.at((0.0, 0.0, 1.0))
    seen.append(TrainingBatch(photo, SVBRDF.constant(8, 8), light).network_input)
    assert_close(torch.cat(seen), expected.repeat(2, 1, 1, 1))


@states(
    "C25",
    "A network's maps are in [-1, 1], in the order of C09; diffuse, roughness and specular are scaled to "
    "[0, 1], normals have z raised to at least 0.02 and are then normalised.",
)
def test_network_maps() -> None:
    network = Generator(TINY)
    maps, _ = network(torch.rand(2, 3, 8, 8) * 2.0 - 1.0)
    assert maps.shape == (2, 10, 8, 8)
    assert float(maps.detach().abs().max()) <= 1.0
    maps = torch.rand(2, 10, 8, 8) * 2.0 - 1.0
    material = maps_to_svbrdf(maps).validate()
    assert_close(material.diffuse, maps[:, 3:6] / 2 + 0.5)
    assert_close(material.roughness, (maps[:, 6:7] / 2 + 0.5).clamp(min=1e-3))
    assert_close(material.specular, maps[:, 7:10] / 2 + 0.5)
    vectors = torch.cat([maps[:, :2], maps[:, 2:3].clamp(min=0.02)], dim=1)
    assert_close(material.normal, vectors / torch.linalg.vector_norm(vectors, dim=1, keepdim=True))


@states(
    "C26",
    "A network's light is standardised: position = output x (1.6891, 1.6833, 2.7202) + (-0.0012, 0.0018, "
    "3.0988), z at least 0.2, white, of intensity 1, without falloff.",
)
def test_network_light() -> None:
    output = torch.tensor([[0.0, 0.0, 0.0], [1.0, -1.0, 0.5], [0.3, 0.2, -4.0]])
    light = light_from_output(output)
    mean, deviation = torch.tensor([-0.0012, 0.0018, 3.0988]), torch.tensor([1.6891, 1.6833, 2.7202])
    position = output * deviation + mean
    assert float(position[2, 2]) < 0.2
    position[2, 2] = 0.2
    assert_close(light.position, position)
    assert_close(light_to_output(light.position[:2]), output[:2])
    assert torch.equal(light.intensity, torch.ones(3, 3))
    assert light.falloff == "none"


@states(
    "C27",
    "A photo that is not square is continued by mirroring to the square the network sees, never cropped or "
    "squashed: its longer side spans [-1, 1] for the network too.",
)
def test_network_sees_the_whole_photo() -> None:
    half, quarter = NETWORK_SIZE // 2, NETWORK_SIZE // 4
    wide = torch.rand(1, 3, half, NETWORK_SIZE)
    for photo, axis in ((wide, 2), (wide.transpose(2, 3).contiguous(), 3)):
        seen: list[Tensor] = []

        def model(square: Tensor, seen: list[Tensor] = seen) -> tuple[SVBRDF, PointLight]:
            seen.append(square)
            answer = SVBRDF.constant(NETWORK_SIZE, NETWORK_SIZE)
            marked = SVBRDF(answer.normal, square, answer.roughness, answer.specular)
            return marked, PointLight.at((0.0, 0.0, 2.0))

        found, _ = initialize(model, photo)
        before = photo.narrow(axis, 0, quarter).flip(axis)
        after = photo.narrow(axis, half - quarter, quarter).flip(axis)
        assert torch.equal(seen[0], torch.cat([before, photo, after], dim=axis))
        assert torch.equal(found.diffuse, photo)


# Photos in


def put(path: Path, pixels: np.ndarray, **attributes: str) -> Path:
    """Write an image as its dtype; `__` in the name of an attribute stands for `:`."""
    names = {"uint8": "uint8", "uint16": "uint16", "float16": "half", "float32": "float"}
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], names[str(pixels.dtype)])
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(pixels), output.geterror()
    assert output.close()
    return path


def stored(path: Path) -> np.ndarray:
    """What a file holds, in its own type, `[h, w, channels]`."""
    source = oiio.ImageInput.open(str(path))
    assert source is not None, path
    spec = source.spec()
    pixels = source.read_image(0, 0, 0, spec.nchannels, spec.format)
    source.close()
    return np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels)


def grid(values: list[int | float], dtype: Any = np.uint8, side: int = 16) -> np.ndarray:
    """Return a grey picture with these values in its first row and 0 elsewhere."""
    pixels = np.zeros((side, side, 3), dtype=dtype)
    pixels[0, : len(values)] = np.asarray(values, dtype=dtype)[:, None]
    return pixels


def srgb_decoded(encoded: np.ndarray) -> np.ndarray:
    """The piecewise curve, written out again (IEC 61966-2-1)."""
    encoded = encoded.astype(np.float64)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def srgb_encoded(linear: np.ndarray) -> np.ndarray:
    linear = linear.astype(np.float64)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1.0 / 2.4) - 0.055)


def hwc(tensor: Tensor) -> np.ndarray:
    """Pixels of a batch of one."""
    return np.asarray(tensor[0].permute(1, 2, 0).numpy())


@states(
    "C28",
    "A file without a colour profile or tag is sRGB-encoded if it stores integers and linear if it stores "
    "floats; what a file says of itself is honoured.",
)
def test_colours_of_files(tmp_path: Path) -> None:
    codes = grid([0, 5, 60, 128, 200, 254])
    for name, pixels in (("a.tif", codes), ("b.png", codes), ("c.tif", codes.astype(np.uint16) * 257)):
        expected = srgb_decoded(codes / 255.0)
        np.testing.assert_allclose(hwc(read_photo(put(tmp_path / name, pixels)).linear), expected, atol=1e-5)
    light = grid([0.0, 0.01, 0.5, 3.5], np.float32)
    for name in ("d.exr", "e.tif"):
        np.testing.assert_allclose(hwc(read_photo(put(tmp_path / name, light)).linear), light, rtol=1e-3)
    said = put(tmp_path / "f.png", codes, oiio__ColorSpace="g22_rec709_scene")
    np.testing.assert_allclose(hwc(read_photo(said).linear), (codes / 255.0) ** 2.2, atol=1e-5)


@states(
    "C29",
    'Every array is taken as sRGB-encoded; linear light must be said with `color_space="linear"`, and only '
    "then may floats exceed 1.",
)
def test_colours_of_arrays() -> None:
    codes = grid([0, 5, 60, 128, 200, 254])
    for array in (codes, codes.astype(np.uint16) * 257, (codes / 255.0).astype(np.float32)):
        linear = hwc(photo_from_array(array).linear)
        np.testing.assert_allclose(linear, srgb_decoded(codes / 255.0), atol=1e-5)
    bright = grid([0.25, 3.5], np.float32)
    np.testing.assert_allclose(hwc(photo_from_array(bright, color_space="linear").linear), bright)
    with pytest.raises(UserError, match="linear"):
        photo_from_array(bright)


@states(
    "C30",
    "A pixel is saturated if any of its channels, as stored, reaches 254.5/255 of the format's maximum; "
    "pixels of linear float images never are.",
)
def test_saturation() -> None:
    def saturated(array: np.ndarray, **options: Any) -> list[bool]:
        return (~photo_from_array(array, **options).unsaturated[0, 0, 0, :3]).tolist()

    assert saturated(grid([254, 255, 0])) == [False, True, False]
    limit = 254.5 / 255.0 * 65535.0
    assert saturated(grid([math.floor(limit), math.ceil(limit), 0], np.uint16)) == [False, True, False]
    one_channel = grid([0, 0, 0])
    one_channel[0, 1, 2] = 255
    assert saturated(one_channel) == [False, True, False]
    assert saturated(grid([1.0, 4.0, 0.0], np.float32), color_space="linear") == [False] * 3


@states(
    "C31",
    "Photos are shrunk in linear light, and a pixel is saturated if any pixel that contributes to it is.",
)
def test_shrinking() -> None:
    stripes = np.zeros((64, 64, 3), dtype=np.uint8)
    stripes[:, ::2] = 200
    half = resize_photo(photo_from_array(stripes), 32)
    mean = float(srgb_decoded(np.array(200 / 255.0))) / 2.0
    assert float(half.linear[..., 8:-8].mean()) == pytest.approx(mean, rel=0.01)
    dot_of_light = np.zeros((64, 64, 3), dtype=np.uint8)
    dot_of_light[32, 32] = 255
    small = resize_photo(photo_from_array(dot_of_light), 32)
    touched = small.linear.amax(dim=1, keepdim=True) > 0.0
    assert bool(touched.any())
    assert torch.equal(~small.unsaturated, touched)


@states(
    "C32",
    'A saturated pixel says "at least 1": a rendering above 1 costs nothing there, a darker one does.',
)
def test_saturated_pixels_are_lower_bounds() -> None:
    photo = torch.ones(1, 3, 2, 2)
    clipped, seen = torch.zeros(1, 1, 2, 2, dtype=torch.bool), torch.ones(1, 1, 2, 2, dtype=torch.bool)
    assert float(photo_distance(photo * 5.0, photo, clipped)) == 0.0
    assert float(photo_distance(photo * 5.0, photo, seen)) > 1.0
    assert float(photo_distance(photo * 0.5, photo, clipped)) > 0.5


# Strips


@states(
    "C33",
    "A strip holds square tiles side by side, `[input |] normal | diffuse | roughness | specular`, 8 bits "
    "per channel.",
)
def test_strip_layout(tmp_path: Path) -> None:
    material, photo = random_svbrdf(1, 6, 6), torch.rand(1, 3, 6, 6)
    normal = (material.normal + 1.0) / 2.0
    tiles = [normal, material.diffuse, material.roughness.expand(-1, 3, -1, -1), material.specular]
    for name, first in (("four.png", []), ("five.png", [photo])):
        write_strip(tmp_path / name, material, first[0] if first else None)
        pixels = stored(tmp_path / name)
        assert pixels.dtype == np.uint8
        expected = np.rint(hwc(torch.cat([*first, *tiles], dim=3)) * 255.0)
        assert np.abs(pixels - expected).max() <= 1.0
        strip = read_strip(tmp_path / name)
        assert (strip.input is None) == (not first)
        for found, written in zip(strip.svbrdf.channels(), material.channels(), strict=True):
            assert_close(found, written, atol=0.02)


@states(
    "C34",
    "A strip's normals are stored as (n + 1) / 2 and its diffuse, roughness and specular tiles are linear, "
    'unless `gamma="srgb"` is said, which is for diffuse and specular only.',
)
def test_strip_encoding(tmp_path: Path) -> None:
    flat = np.zeros((4, 16, 3), dtype=np.uint8)
    for tile, code in enumerate(((128, 204, 230), (51, 102, 204), (102,) * 3, (26, 51, 77))):
        flat[:, 4 * tile : 4 * tile + 4] = code
    path = put(tmp_path / "strip.png", flat)
    linear, encoded = read_strip(path).svbrdf, read_strip(path, gamma="srgb").svbrdf
    vector = np.array([128, 204, 230]) / 255.0 * 2.0 - 1.0
    for found in (linear, encoded):
        np.testing.assert_allclose(hwc(found.normal)[0, 0], vector / np.linalg.norm(vector), atol=1e-6)
        np.testing.assert_allclose(hwc(found.roughness)[0, 0], [102 / 255.0], atol=1e-6)
    for name, codes in (("diffuse", (51, 102, 204)), ("specular", (26, 51, 77))):
        values = np.array(codes) / 255.0
        np.testing.assert_allclose(hwc(getattr(linear, name))[0, 0], values, atol=1e-6)
        np.testing.assert_allclose(hwc(getattr(encoded, name))[0, 0], srgb_decoded(values), atol=1e-5)


# PBR folders

BASE, FLAT_CODES = (200, 120, 40), (128, 128, 255)


def pbr(folder: Path, **maps: tuple[int, int, int] | np.ndarray) -> Path:
    """Make a folder of PNGs: base colour, flat normal, roughness 0.4 and what is given, by name."""
    folder.mkdir()
    for name, value in {"basecolor": BASE, "normal": FLAT_CODES, "roughness": (102,) * 3, **maps}.items():
        put(folder / f"{name}.png", np.full((4, 4, 3), value, dtype=np.uint8))
    return folder


def first_pixel(tensor: Tensor) -> np.ndarray:
    return hwc(tensor)[0, 0]


@states(
    "C35",
    "Base colour is sRGB-encoded in integer files and linear in float files; every other map is read raw.",
)
def test_pbr_encoding(tmp_path: Path) -> None:
    found = read_pbr_folder(pbr(tmp_path / "integer"))
    np.testing.assert_allclose(first_pixel(found.diffuse), srgb_decoded(np.array(BASE) / 255.0), atol=1e-5)
    np.testing.assert_allclose(first_pixel(found.roughness), [0.4], atol=1e-6)
    folder = pbr(tmp_path / "float")
    put(folder / "basecolor.exr", np.full((4, 4, 3), (0.6, 0.3, 0.1), dtype=np.float32))
    np.testing.assert_allclose(first_pixel(read_pbr_folder(folder).diffuse), (0.6, 0.3, 0.1), atol=1e-3)


@states(
    "C36",
    "Without a specular file a dielectric has F0 = 0.04; with metallic m, diffuse = base (1 - m) and F0 = "
    "0.04 (1 - m) + base m.",
)
def test_pbr_metallic(tmp_path: Path) -> None:
    base = srgb_decoded(np.array(BASE) / 255.0)
    plain = read_pbr_folder(pbr(tmp_path / "dielectric"))
    np.testing.assert_allclose(first_pixel(plain.specular), [0.04] * 3, atol=1e-6)
    m = 51 / 255.0
    mixed = read_pbr_folder(pbr(tmp_path / "mixed", metallic=(51,) * 3))
    np.testing.assert_allclose(first_pixel(mixed.diffuse), base * (1 - m), atol=1e-5)
    np.testing.assert_allclose(first_pixel(mixed.specular), 0.04 * (1 - m) + base * m, atol=1e-5)


@states(
    "C37",
    'A file named specular holds Blender\'s IOR level, F0 = 0.08 x value, unless `specular_workflow="f0"` '
    "is said.",
)
def test_pbr_specular(tmp_path: Path) -> None:
    folder = pbr(tmp_path / "set", specular=(204,) * 3)
    np.testing.assert_allclose(first_pixel(read_pbr_folder(folder).specular), [0.08 * 0.8] * 3, atol=1e-6)
    f0 = read_pbr_folder(folder, specular_workflow="f0")
    np.testing.assert_allclose(first_pixel(f0.specular), srgb_decoded(np.full(3, 0.8)), atol=1e-5)


@states("C38", "Glossiness is one minus roughness.")
def test_pbr_glossiness(tmp_path: Path) -> None:
    folder = pbr(tmp_path / "set", glossiness=(51,) * 3)
    (folder / "roughness.png").unlink()
    np.testing.assert_allclose(first_pixel(read_pbr_folder(folder).roughness), [0.8], atol=1e-6)


@states(
    "C39",
    "Normal maps are OpenGL unless their name (`dx`, `directx`) or the caller says DirectX, whose green "
    "channel is flipped.",
)
def test_pbr_normals(tmp_path: Path) -> None:
    leaning = (128, 204, 230)
    folder = pbr(tmp_path / "set", normal=leaning)
    up = first_pixel(read_pbr_folder(folder).normal)
    assert up[1] > 0.5
    down = up * np.array([1.0, -1.0, 1.0])
    caller = read_pbr_folder(folder, normal_convention="directx")
    np.testing.assert_allclose(first_pixel(caller.normal), down, atol=1e-6)
    for name in ("NormalDX", "NormalDirectX"):
        folder = pbr(tmp_path / name, **{f"wall_{name}": leaning})
        (folder / "normal.png").unlink()
        np.testing.assert_allclose(first_pixel(read_pbr_folder(folder).normal), down, atol=1e-6)


# Files out


def written(
    folder: Path, extension: Any = "png", bits: Any = 16, normals: NormalConvention = "opengl"
) -> tuple[SVBRDF, Tensor, dict[str, np.ndarray]]:
    """Write a material with a rendering that reaches 3; return both, and what the files hold by name."""
    material = random_svbrdf(1, 5, 7)
    rendering = torch.linspace(0.0, 3.0, 105).reshape(1, 3, 5, 7)
    format = MapFormat(extension, bits)
    paths = write_maps(
        folder, "wall", material, rendering=rendering, format=format, normal_convention=normals
    )
    return material, rendering, {name: stored(path) for name, path in paths.items()}


@states(
    "C40",
    "The files of a material are `<stem>_normal`, `<stem>_diffuse`, `<stem>_specular`, `<stem>_roughness` "
    "and `<stem>_rendering`, 16-bit PNG unless another format is asked for.",
)
def test_file_names(tmp_path: Path) -> None:
    paths = write_maps(tmp_path, "wall", random_svbrdf(), rendering=torch.rand(1, 3, 5, 7))
    names = ("normal", "diffuse", "specular", "roughness", "rendering")
    assert {path.name for path in tmp_path.iterdir()} == {f"wall_{name}.png" for name in names}
    assert {name: path.name for name, path in paths.items()} == {name: f"wall_{name}.png" for name in names}
    for name, path in paths.items():
        pixels = stored(path)
        assert pixels.dtype == np.uint16
        assert pixels.shape == (5, 7, 1 if name == "roughness" else 3)


@states(
    "C41",
    "8-bit and 16-bit integer diffuse, specular and rendering files are sRGB-encoded, the rendering clipped "
    "at 1.",
)
def test_integer_files(tmp_path: Path) -> None:
    for extension, bits in (("png", 8), ("png", 16), ("tif", 8), ("tif", 16)):
        material, rendering, files = written(tmp_path / f"{extension}{bits}", extension, bits)
        top = 2**bits - 1
        colours = {"diffuse": material.diffuse, "specular": material.specular, "rendering": rendering}
        for name, linear in colours.items():
            expected = srgb_encoded(hwc(linear).clip(0.0, 1.0)) * top
            assert files[name].dtype == f"uint{bits}"
            assert np.abs(files[name] - expected).max() <= 0.6 + 1e-5 * top, (name, extension, bits)
        assert files["rendering"].max() == top


@states(
    "C42",
    "EXR and 32-bit TIFF diffuse, specular and rendering files are linear, the rendering not clipped.",
)
def test_float_files(tmp_path: Path) -> None:
    for extension, bits in (("exr", 16), ("exr", 32), ("tif", 32)):
        material, rendering, files = written(tmp_path / f"{extension}{bits}", extension, bits)
        colours = {"diffuse": material.diffuse, "specular": material.specular, "rendering": rendering}
        for name, linear in colours.items():
            tolerance = 1e-3 if bits == 16 else 0.0
            np.testing.assert_allclose(files[name], hwc(linear), rtol=tolerance, atol=1e-6)
        assert files["rendering"].max() == 3.0


@states("C43", "Roughness, and normals as (n + 1) / 2, are stored raw in every format.")
def test_raw_files(tmp_path: Path) -> None:
    for extension, bits in (
        ("png", 8),
        ("png", 16),
        ("tif", 8),
        ("tif", 16),
        ("tif", 32),
        ("exr", 16),
        ("exr", 32),
    ):
        material, _, files = written(tmp_path / f"{extension}{bits}", extension, bits)
        for name, values in (("roughness", material.roughness), ("normal", (material.normal + 1.0) / 2.0)):
            integer = files[name].dtype.kind == "u"
            top = 2**bits - 1 if integer else 1
            tolerance = 0.6 / top if integer else 1e-3
            np.testing.assert_allclose(files[name] / top, hwc(values), rtol=0.0, atol=tolerance)


@states(
    "C44",
    "Normals are OpenGL in memory, always; asking for DirectX flips the green channel of the normal file "
    "and nothing else.",
)
def test_directx_files(tmp_path: Path) -> None:
    material, _, up = written(tmp_path / "up")
    _, _, down = written(tmp_path / "down", normals="directx")
    for name in up:
        if name != "normal":
            assert np.array_equal(up[name], down[name])
    assert np.array_equal(up["normal"][..., [0, 2]], down["normal"][..., [0, 2]])
    green = up["normal"][..., 1].astype(np.int64) + down["normal"][..., 1]
    assert np.abs(green - 65535).max() <= 1
    back = read_maps(tmp_path / "down", "wall", normal_convention="directx")
    assert_close(back.normal, material.normal, atol=1e-4)


@states("C45", "The same material gives the same bytes.")
def test_bytes_repeat(tmp_path: Path) -> None:
    for extension, bits in (("png", 16), ("tif", 8), ("exr", 16)):
        folders = [tmp_path / f"{extension}{number}" for number in (1, 2)]
        for folder in folders:
            written(folder, extension, bits)
        files = [sorted(folder.iterdir()) for folder in folders]
        assert [path.name for path in files[0]] == [path.name for path in files[1]]
        assert [path.read_bytes() for path in files[0]] == [path.read_bytes() for path in files[1]]


# Metrics


def encoded(linear: Tensor) -> Tensor:
    return linear.clamp(0.0, 1.0) ** (1.0 / 2.2)


@states("C46", "Renderings are compared after clamping to [0, 1] and encoding with gamma 1/2.2.")
def test_metric_encoding() -> None:
    black, white = torch.zeros(1, 3, 4, 4), torch.ones(1, 3, 4, 4)
    assert rendering_rmse(white * 7.0, white) == 0.0
    assert rendering_rmse(black - 1.0, black) == 0.0
    assert rendering_rmse(white * 0.25, black) == pytest.approx(0.25 ** (1 / 2.2), rel=1e-5)


@states(
    "C47",
    "The rendering RMSE is one root mean square over all pixels, channels and test renderings of a scene, "
    "then averaged over scenes.",
)
def test_rendering_rmse() -> None:
    estimate, truth, lights = random_svbrdf(seed=1), random_svbrdf(seed=2), random_light(6)
    found = evaluate_material(estimate, truth, lights)
    difference = encoded(render(estimate, lights)) - encoded(render(truth, lights))
    assert found.rendering == pytest.approx(float(difference.square().mean().sqrt()), rel=1e-4)
    per_light = difference.square().mean(dim=(1, 2, 3)).sqrt().mean()
    assert found.rendering != pytest.approx(float(per_light), rel=1e-4)  # not a mean of roots within a scene
    other = evaluate_material(random_svbrdf(seed=3), truth, lights)
    mean = SceneScores.mean([found, other]).rendering
    assert mean == pytest.approx((found.rendering + other.rendering) / 2, rel=1e-6)


@states(
    "C48",
    "LPIPS is v0.1 with AlexNet on encoded renderings scaled to [-1, 1], averaged over the test renderings "
    "of a scene.",
)
def test_lpips() -> None:
    lpips = LPIPS()
    assert [layer.out_channels for layer in lpips.features] == [64, 192, 384, 256, 256]  # AlexNet's
    a, b = torch.rand(3, 3, 48, 48) * 1.2, torch.rand(3, 3, 48, 48) * 1.2
    expected = torch.stack(
        [lpips(encoded(x)[None] * 2 - 1, encoded(y)[None] * 2 - 1) for x, y in zip(a, b, strict=True)]
    )
    assert rendering_lpips(a, b, lpips) == pytest.approx(float(expected.mean()), rel=1e-4)
    with pytest.raises(ValueError, match="-1, 1"):
        lpips(a * 2.0, b)


@states(
    "C49",
    "Map RMSE compares normals as (n + 1) / 2 and the other maps linear; diffuse and specular are also "
    "compared encoded with gamma 1/2.2, in columns of their own.",
)
def test_map_rmse() -> None:
    a, b = random_svbrdf(seed=1), random_svbrdf(seed=2)
    found = {name: float(value) for name, value in map_rmse(a, b).items()}

    def rmse(x: Tensor, y: Tensor) -> float:
        return float((x - y).square().mean().sqrt())

    expected = {
        "normal": rmse((a.normal + 1) / 2, (b.normal + 1) / 2),
        "diffuse": rmse(a.diffuse, b.diffuse),
        "roughness": rmse(a.roughness, b.roughness),
        "specular": rmse(a.specular, b.specular),
        "diffuse_gamma": rmse(encoded(a.diffuse), encoded(b.diffuse)),
        "specular_gamma": rmse(encoded(a.specular), encoded(b.specular)),
    }
    assert found == pytest.approx(expected, rel=1e-5)


@states(
    "C50",
    "The test photo of a scene is rendered under a white light without falloff at (0, 0, 2.14), where the "
    "camera is, and clamped to 1.",
)
def test_test_photo(tmp_path: Path) -> None:
    material = random_svbrdf(1, 64, 64, roughness=(0.1, 0.2))
    photo, light = input_photo(material)
    assert Camera("perspective", (0.0, 0.0, 2.14)) == CAMERA
    assert_close(light.position, torch.tensor([[0.0, 0.0, 2.14]]))
    assert (light.intensity.tolist(), light.falloff) == ([[1.0, 1.0, 1.0]], "none")
    rendering = render(material, PointLight.at((0.0, 0.0, 2.14)))
    assert float(rendering.max()) > 1.0
    assert torch.equal(photo, rendering.clamp(max=1.0))
    write_strip(tmp_path / "wall.png", material)
    (scene,) = strip_scenes(tmp_path)
    assert torch.equal(scene.photo, input_photo(scene.truth)[0])
    assert_close(scene.truth.diffuse, resize(read_strip(tmp_path / "wall.png").svbrdf.diffuse, 256, 256))


@states(
    "C51",
    "The twenty novel lights are the paper's, kept within 45 degrees of the surface's normal and at "
    "distances clipped to [1.5, 8]; a scene's lights depend on its place in the test set and the seed only.",
)
def test_novel_lights() -> None:
    lights = [novel_lights(index) for index in range(200)]
    position = torch.cat([light.position for light in lights])
    assert position.shape == (200 * 20, 3)
    distance = torch.linalg.vector_norm(position, dim=1)
    assert 1.5 - 1e-5 <= float(distance.min()) <= float(distance.max()) <= 8.0 + 1e-5
    cosine = position[:, 2] / distance
    assert float(cosine.min()) >= math.cos(math.radians(45.0)) - 1e-5
    # Cosine-weighted on the cap: the squared cosine is uniform on [1/2, 1]. Medians survive the clipping.
    assert float((cosine**2).mean()) == pytest.approx(0.75, abs=0.01)
    assert float(distance.log().median()) == pytest.approx(1.0, abs=0.05)
    assert all(
        torch.equal(light.intensity, torch.ones(20, 3)) and light.falloff == "none" for light in lights
    )
    assert torch.equal(novel_lights(7).position, lights[7].position)
    assert not torch.equal(novel_lights(7, seed=1).position, lights[7].position)
    assert torch.equal(novel_lights(7, 5).position, lights[7].position[:5])


@states(
    "C52",
    "The re-rendering RMSE of a result compares it with its photo, both encoded with gamma 1/2.2, on "
    "unsaturated pixels only.",
)
def test_rerendering_rmse() -> None:
    photo, rendering = torch.rand(1, 3, 8, 8), torch.rand(1, 3, 8, 8) * 2.0
    unsaturated = torch.rand(1, 1, 8, 8) < 0.7
    found = rerendering_rmse(rendering, Capture(photo, unsaturated))
    difference = (gamma_encode(rendering) - gamma_encode(photo)).movedim(1, -1)[unsaturated[:, 0]]
    assert found == pytest.approx(float(difference.square().mean().sqrt()), rel=1e-5)
    assert found == pytest.approx(
        float((encoded(rendering) - encoded(photo)).movedim(1, -1)[unsaturated[:, 0]].square().mean().sqrt()),
        rel=1e-3,
    )


# Exports


@states(
    "C53",
    "Where a model lays the lobe over the diffuse (glTF, Blender, MaterialX), base colour is `d (1 - s) / (1 "
    "- max s)`, clipped at 1; the diffuse colour of USD's preview surface is d.",
)
def test_base_color_of_exports() -> None:
    material = random_svbrdf()
    strongest = material.specular.max(dim=1, keepdim=True).values
    expected = (material.diffuse * (1.0 - material.specular) / (1.0 - strongest)).clamp(max=1.0)
    assert_close(TEXTURES["base_color"].pixels(material), expected)
    assert_close(TEXTURES["diffuse"].pixels(material), material.diffuse)


@states(
    "C54",
    "In the metallic workflow the diffuse is `b (1 - m)` and F0 = 0.04 (1 - m) + b m; an ORM picture holds "
    "occlusion, roughness and metallic in red, green and blue, raw.",
)
def test_metallic_workflow() -> None:
    base, metallic, roughness = 0.4, 0.3, 0.7
    f0 = 0.04 * (1.0 - metallic) + base * metallic
    diffuse = base * (1.0 - metallic) / (1.0 - f0)
    material = SVBRDF.constant(2, 2, diffuse=diffuse, roughness=roughness, specular=f0)
    source = Source(material, "stone")
    files = packed.orm(source).files
    mixed, color = files[source.file("orm")], files[source.file("metallic_base_color")]
    assert isinstance(mixed, Picture)
    assert isinstance(color, Picture)
    assert not mixed.color
    assert_close(mixed.pixels[0, :, 0, 0], torch.tensor([1.0, roughness, metallic]))
    assert_close(color.pixels[0, :, 0, 0], torch.tensor([base] * 3))


@states(
    "C55",
    "A height is in surface units and grows towards the viewer; 0 and 1 of a height file are the `low` and "
    "`high` of its record.",
)
def test_height_file() -> None:
    slope = 0.1  # up to the right: the normal leans to the left
    normal = torch.tensor([-slope, 0.0, 1.0]) / math.sqrt(1.0 + slope**2)
    flat = SVBRDF.constant(8, 64)
    tilted = SVBRDF(
        normal[None, :, None, None].expand(1, 3, 8, 64), flat.diffuse, flat.roughness, flat.specular
    )
    source = Source(tilted, "stone")
    bundle = packed.height(source)
    picture = bundle.files[source.file("height")]
    assert isinstance(picture, Picture)
    heights = bundle.notes["low"] + picture.pixels * (bundle.notes["high"] - bundle.notes["low"])
    centre = heights[0, 0, 4, 16:48]
    assert_close(centre.diff(), torch.full((31,), slope * 2.0 / 64), rtol=0.1)


# The other pages

CONSTANTS = re.findall(
    r"^\| `((?:nets|losses|refine|eval)\.[\w.]+)` \| `(.+?)` \|", METHODS.read_text(), re.M
)


def constant(path: str) -> Any:
    """Return what a dotted path names: an attribute of an attribute ... of a module."""
    parts = path.split(".")
    module = next(".".join(parts[:n]) for n in range(2, len(parts)) if not is_module(parts[: n + 1]))
    value: Any = import_module(module)
    for name in parts[len(module.split(".")) :]:
        value = getattr(value, name)
    return value


def is_module(parts: list[str]) -> bool:
    try:
        return find_spec(".".join(parts)) is not None
    except ModuleNotFoundError:  # the last but one is a module, not a package
        return False


@pytest.mark.parametrize(("path", "value"), CONSTANTS, ids=[path for path, _ in CONSTANTS])
def test_constants_of_the_methods_page(path: str, value: str) -> None:
    expected, found = ast.literal_eval(re.sub(r"\binf\b", "1e999", value)), constant(path)
    if isinstance(expected, float):
        expected = pytest.approx(expected, rel=1e-5)
    assert found == expected, f"docs/methods.md says {value}, the code {found}"


def test_no_row_of_the_methods_page_is_overlooked() -> None:
    rows = [line for line in METHODS.read_text().splitlines() if line.startswith("| `")]
    assert len(rows) == len(CONSTANTS) > 80
    assert len({path for path, _ in CONSTANTS}) == len(CONSTANTS)


def test_modules_of_the_architecture_page() -> None:
    listed = re.findall(r"^\| `([\w/]+\.py)` \|", ARCHITECTURE.read_text(), re.M)
    assert len(listed) == len(set(listed))
    rooms = ("nets", "losses", "refine", "eval")
    files = (path for room in rooms for path in (ROOT / room).rglob("*.py") if path.name != "__init__.py")
    assert set(listed) == {path.relative_to(ROOT).as_posix() for path in files}


def test_sizes_of_the_architecture_page() -> None:
    sizes: tuple[tuple[NetworkConfig, str], ...] = (
        (PAPER_GENERATOR, "231.8 M"),
        (NARROW_GENERATOR, "4.70 M"),
        (PAPER_DES18, "79.98 M"),
        (NARROW_DES18, "1.249 M"),
        (PAPER_DES19, "80.25 M"),
        (NARROW_DES19, "1.262 M"),
        (PAPER_AUTOENCODER, "13.92 M"),
        (NARROW_AUTOENCODER, "0.220 M"),
    )
    for config, words in sizes:
        with torch.device("meta"):
            count = sum(parameter.numel() for parameter in build(config).parameters())
        number, digits = float(words.split()[0]), len(words.split()[0].partition(".")[2])
        assert round(count / 1e6, digits) == number
        assert words in ARCHITECTURE.read_text()
