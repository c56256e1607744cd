"""The renderer against a scalar reference, closed forms, symmetries, energy, gradients and hard corners."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, replace

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional

from nets.render import (
    AUTHORS_CAMERA,
    PAPER,
    PRESETS,
    Camera,
    Conventions,
    Geometry,
    PointLight,
    cook_torrance,
    render,
    schlick_weight,
    shade,
    shading_geometry,
    surface_points,
)
from nets.svbrdf import MAPS, SVBRDF
from refine.parametrization import Parameters
from tests.helpers import assert_close, gradcheck, random_light, random_svbrdf

CAMERAS = {
    "orthographic": Camera("orthographic"),
    "perspective": Camera("perspective"),
    "perspective aside": Camera("perspective", (0.7, -0.4, 1.5)),
    "collocated": Camera("collocated"),
}
SIZES = [(3, 3), (2, 5), (5, 1)]

Vector = tuple[float, float, float]


# --- The slow, obvious reference: DESIGN.md's formulas, one scalar at a time ------------------------------


def pixel_position(row: int, column: int, height: int, width: int, grid: str) -> Vector:
    longer = max(height, width)
    if grid == "centre":
        return (2 * column + 1 - width) / longer, (height - 1 - 2 * row) / longer, 0.0
    return (2 * column - (width - 1)) / (longer - 1), ((height - 1) - 2 * row) / (longer - 1), 0.0


def unit(vector: Vector) -> Vector:
    length = math.sqrt(sum(value * value for value in vector))
    return tuple(value / length for value in vector)  # type: ignore[return-value]


def dot(a: Vector, b: Vector) -> float:
    return max(0.0, sum(x * y for x, y in zip(a, b, strict=True)))


def reference_pixel(
    material: dict[str, list[float]],
    point: Vector,
    light: Vector,
    intensity: list[float],
    falloff: str,
    camera: Camera,
    rules: Conventions,
) -> list[float]:
    n: Vector = tuple(material["normal"])  # type: ignore[assignment]
    to_light: Vector = tuple(a - b for a, b in zip(light, point, strict=True))  # type: ignore[assignment]
    l = unit(to_light)  # noqa: E741
    eye = light if camera.kind == "collocated" else camera.position
    v = unit(tuple(a - b for a, b in zip(eye, point, strict=True)))  # type: ignore[arg-type]
    if camera.kind == "orthographic":
        v = (0.0, 0.0, 1.0)
    h = unit(tuple(a + b for a, b in zip(l, v, strict=True)))  # type: ignore[arg-type]
    r = max(material["roughness"][0], rules.roughness_floor)
    a = r**2
    k = a / 2
    nl, nv, nh, vh = dot(n, l), dot(n, v), dot(n, h), dot(v, h)
    d_term = (a / max(nh**2 * (a**2 - 1) + 1, rules.distribution_floor)) ** 2 / math.pi
    g_term = 1 / (
        max(nl * (1 - k) + k, rules.visibility_floor) * max(nv * (1 - k) + k, rules.visibility_floor)
    )
    strength = 1.0
    if falloff == "inverse_square":
        strength = sum(x * x for x in light) / sum(x * x for x in to_light)
    radiance = []
    for d, s, e in zip(material["diffuse"], material["specular"], intensity, strict=True):
        f_term = s + (1 - s) * 2 ** ((-5.55473 * vh - 6.98316) * vh)
        f = d * (1 - s) / math.pi + d_term * g_term * f_term / 4
        radiance.append(math.pi * f * nl * e * strength)
    return radiance


def reference(svbrdf: SVBRDF, light: PointLight, camera: Camera, rules: Conventions) -> Tensor:
    height, width = svbrdf.size
    picture = torch.zeros(svbrdf.batch, 3, height, width, dtype=torch.float64)
    for batch in range(svbrdf.batch):
        for row in range(height):
            for column in range(width):
                picture[batch, :, row, column] = torch.tensor(
                    reference_pixel(
                        {name: getattr(svbrdf, name)[batch, :, row, column].tolist() for name in MAPS},
                        pixel_position(row, column, height, width, rules.grid),
                        tuple(light.position[batch].tolist()),
                        light.intensity[batch].tolist(),
                        light.falloff,
                        camera,
                        rules,
                    ),
                    dtype=torch.float64,
                )
    return picture


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("grid", ["centre", "corner"])
@pytest.mark.parametrize("falloff", ["none", "inverse_square"])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_values_are_the_references(camera: Camera, falloff, grid, size: tuple[int, int]) -> None:  # type: ignore[no-untyped-def]
    material = random_svbrdf(2, *size, seed=sum(size), tilt=2.0, dtype=torch.float64)
    light = random_light(2, seed=3, falloff=falloff, dtype=torch.float64)
    rules = Conventions(grid=grid)
    expected = reference(material, light, camera, rules)
    assert_close(render(material, light, camera, rules), expected)
    single = render(material.to(torch.float32), light.to(torch.float32), camera, rules)
    assert_close(single, expected, rtol=1e-3)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_is_the_reference_with_its_floors(preset: str) -> None:
    # Sharp lobes around mirror directions, so that the floors of each preset decide.
    material = random_svbrdf(1, 9, 9, tilt=0.05, roughness=(1e-3, 0.12), dtype=torch.float64)
    light = random_light(1, dtype=torch.float64)
    light = replace(light, position=torch.tensor([[0.1, -0.1, 2.0]], dtype=torch.float64))
    rules = PRESETS[preset]
    expected = reference(material, light, Camera(), rules)
    assert_close(render(material, light, Camera(), rules), expected, rtol=1e-6)


def test_one_material_under_many_lights_is_each_alone() -> None:
    material, lights = random_svbrdf(1), random_light(3, seed=1)
    together = render(material, lights)
    for index in range(3):
        assert_close(together[index : index + 1], render(material, lights[index : index + 1]))
    many = random_svbrdf(3)
    assert_close(render(many, lights[:1])[1:2], render(many[1], lights[:1]))


def test_render_is_geometry_then_shade() -> None:
    material, light, camera = random_svbrdf(2), random_light(2), Camera("collocated")
    geometry = shading_geometry(surface_points(*material.size), light, camera)
    assert torch.equal(shade(material, geometry), render(material, light, camera))


# --- Coordinates and conventions --------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(4, 4), (3, 6), (6, 3), (1, 1)])
def test_the_longer_side_spans_minus_one_to_one(size: tuple[int, int]) -> None:
    height, width = size
    x, y, z = surface_points(height, width, dtype=torch.float64)
    step = 2.0 / max(size)
    assert_close(x[0], -width * step / 2 + step * (torch.arange(width, dtype=torch.float64) + 0.5))
    assert_close(y[:, 0], height * step / 2 - step * (torch.arange(height, dtype=torch.float64) + 0.5))
    assert float(z.abs().max()) == 0.0


def test_the_corner_grid_is_the_authors_linspace() -> None:
    x, y, _ = surface_points(5, 5, grid="corner", dtype=torch.float64)
    assert_close(x[0], torch.linspace(-1, 1, 5, dtype=torch.float64))
    assert_close(y[:, 0], torch.linspace(1, -1, 5, dtype=torch.float64))
    assert float(surface_points(1, 1, grid="corner").abs().max()) == 0.0


def test_presets_differ_as_documented() -> None:
    assert set(PRESETS) == {"paper", "des19", "gao19"}
    assert PRESETS["paper"] == PAPER == Conventions()
    assert [PRESETS[name].grid for name in ("paper", "des19", "gao19")] == ["centre", "corner", "centre"]
    assert PAPER.roughness_floor == 0.03
    assert PRESETS["des19"].roughness_floor == PRESETS["gao19"].roughness_floor == 0.001
    floors = {
        name: {k: v for k, v in asdict(rules).items() if k != "grid"} for name, rules in PRESETS.items()
    }
    assert len({tuple(values.items()) for values in floors.values()}) == 3
    mirror = SVBRDF.constant(8, 8, roughness=0.01, specular=0.9)
    light = PointLight.at((0.0, 0.0, 2.14))
    pictures = [render(mirror, light, Camera(), rules) for rules in PRESETS.values()]
    assert all(not torch.equal(a, b) for i, a in enumerate(pictures) for b in pictures[:i])


def test_default_camera_is_the_authors() -> None:
    assert AUTHORS_CAMERA == (0.0, 0.0, 2.14)
    material, light = random_svbrdf(), random_light()
    assert torch.equal(render(material, light), render(material, light, Camera("perspective", (0, 0, 2.14))))


def test_collocated_is_a_perspective_camera_at_the_light() -> None:
    material, light = random_svbrdf(), PointLight.at((0.3, -0.2, 1.7))
    assert_close(
        render(material, light, Camera("collocated")),
        render(material, light, Camera("perspective", (0.3, -0.2, 1.7))),
    )


def test_a_far_camera_is_orthographic() -> None:
    material, light = random_svbrdf(dtype=torch.float64), random_light(dtype=torch.float64)
    far = render(material, light, Camera("perspective", (0.0, 0.0, 1e7)))
    assert_close(far, render(material, light, Camera("orthographic")), rtol=1e-5)


# --- Closed forms -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("height", [0.5, 2.0, 9.0])
@pytest.mark.parametrize("falloff", ["none", "inverse_square"])
def test_a_white_lambertian_patch_facing_a_unit_light_is_one(height: float, falloff) -> None:  # type: ignore[no-untyped-def]
    white = SVBRDF.constant(5, 5, diffuse=1.0, roughness=1.0, specular=0.0, dtype=torch.float64)
    light = PointLight.at((0.0, 0.0, height), falloff=falloff, dtype=torch.float64)
    picture = render(white, light)
    assert float(picture[0, 0, 2, 2]) == pytest.approx(1.0, abs=1e-4)  # Schlick's fit leaves 2^-12.5


def test_lambert_and_inverse_square_off_centre() -> None:
    white = SVBRDF.constant(5, 5, diffuse=1.0, specular=0.0, dtype=torch.float64)
    light = PointLight.at((0.0, 0.0, 1.0), falloff="inverse_square", dtype=torch.float64)
    geometry = shading_geometry(surface_points(5, 5, dtype=torch.float64), light)
    # Pixel (2, 4) lies at x = 0.8: squared distance 1.64, cosine 1 / sqrt(1.64).
    assert float(geometry.irradiance[0, 0, 2, 4]) == pytest.approx(math.pi / 1.64)
    assert float(geometry.irradiance[0, 0, 2, 2]) == pytest.approx(math.pi)
    black = replace(white, diffuse=white.diffuse * 0.0)
    lambert = shade(white, geometry) - shade(black, geometry)
    assert float(lambert[0, 0, 2, 4]) == pytest.approx(1.64**-1.5)


def test_radiance_is_linear_in_intensity_per_channel() -> None:
    material, one = random_svbrdf(), PointLight.at((0.3, 0.2, 2.0))
    coloured = PointLight.at((0.3, 0.2, 2.0), (2.0, 0.5, 0.0))
    expected = render(material, one) * torch.tensor([2.0, 0.5, 0.0])[:, None, None]
    assert_close(render(material, coloured), expected)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_a_surface_turned_from_the_light_is_black(camera: Camera) -> None:
    flat = SVBRDF.constant(3, 3, roughness=0.2, specular=0.5)
    sideways = replace(
        flat, normal=functional.normalize(torch.tensor([1.0, 0, 0])[:, None, None] + 0 * flat.normal, dim=1)
    )
    assert (
        float(render(sideways, PointLight.at((0.0, 0.0, 2.0)), camera)[..., 1].abs().max()) == 0.0
    )  # n.l = 0
    assert float(render(flat, PointLight.at((0.0, 0.0, -2.0)), camera).abs().max()) == 0.0  # from behind


def test_fresnel_at_both_ends() -> None:
    # Grazing reflects all; straight on leaves 2^-12.5. In between Karis's fit follows Schlick.
    v_dot_h = torch.linspace(0.0, 1.0, 101, dtype=torch.float64)
    weight = schlick_weight(v_dot_h)
    assert float(weight[0]) == 1.0
    assert float(weight[-1]) == pytest.approx(2.0**-12.53789)
    assert_close(weight, (1.0 - v_dot_h) ** 5, atol=0.01)


# --- Symmetries -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("axis", "dimension"), [(0, -1), (1, -2)], ids=["left-right", "up-down"])
@pytest.mark.parametrize("kind", ["orthographic", "perspective", "collocated"])
@pytest.mark.parametrize("falloff", ["none", "inverse_square"])
def test_a_mirrored_world_gives_a_mirrored_picture(axis: int, dimension: int, kind, falloff) -> None:  # type: ignore[no-untyped-def]
    material = random_svbrdf(1, 4, 7, dtype=torch.float64)
    light = random_light(falloff=falloff, dtype=torch.float64)
    sign = torch.ones(3, dtype=torch.float64)
    sign[axis] = -1.0
    mirrored = material.map(lambda tensor: tensor.flip(dimension))
    mirrored = replace(mirrored, normal=mirrored.normal * sign[:, None, None])
    mirrored_light = replace(light, position=light.position * sign)
    picture = render(mirrored, mirrored_light, Camera(kind))
    assert_close(picture, render(material, light, Camera(kind)).flip(dimension))
    assert not torch.allclose(picture, render(material, light, Camera(kind)))


def test_the_light_is_where_its_coordinates_say() -> None:
    # x to the right, y up: a light at the upper right makes that corner of a matte patch brightest.
    matte = SVBRDF.constant(8, 8, roughness=1.0, specular=0.0)
    picture = render(matte, PointLight.at((0.8, 0.8, 0.5)))[0, 0]
    assert int(picture.argmax()) == 7  # row 0, the last column


def directions(count: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    vectors = torch.randn(1, 3, 1, count, generator=generator, dtype=torch.float64)
    vectors[:, 2] = vectors[:, 2].abs() + 0.05
    return functional.normalize(vectors, dim=1)


def geometry_of(light: Tensor, view: Tensor) -> Geometry:
    half = functional.normalize(light + view, dim=1)
    weight = schlick_weight((view * half).sum(dim=1, keepdim=True))
    return Geometry(light, view, half, weight, torch.full_like(light, math.pi))


def test_the_brdf_is_reciprocal() -> None:
    material = random_svbrdf(1, 1, 200, dtype=torch.float64)
    light, view = directions(200, 1), directions(200, 2)
    there = cook_torrance(material, geometry_of(light, view))
    assert_close(cook_torrance(material, geometry_of(view, light)), there)


def test_the_brdf_is_isotropic() -> None:
    flat = SVBRDF.constant(1, 50, roughness=0.3, dtype=torch.float64)
    light, view = directions(50, 1), directions(50, 2)
    c, s = math.cos(0.7), math.sin(0.7)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)

    def turned(vectors: Tensor) -> Tensor:
        return torch.einsum("ij,bjhw->bihw", turn, vectors)

    turned_value = cook_torrance(flat, geometry_of(turned(light), turned(view)))
    assert_close(turned_value, cook_torrance(flat, geometry_of(light, view)))


# --- Energy -----------------------------------------------------------------------------------------------


def hemisphere(rows: int, columns: int, power: float = 1.0) -> tuple[Tensor, Tensor]:
    """Return directions `[1, 3, rows, columns]` and solid angles; `power` crowds them at the pole."""
    edges = torch.linspace(0.0, 1.0, rows + 1, dtype=torch.float64) ** power * (math.pi / 2)
    theta = (edges[1:] + edges[:-1])[:, None] / 2
    phi = (torch.arange(columns, dtype=torch.float64)[None] + 0.5) * (2 * math.pi / columns)
    vectors = torch.stack(
        [
            torch.sin(theta) * torch.cos(phi),
            torch.sin(theta) * torch.sin(phi),
            torch.cos(theta).expand(rows, columns),
        ]
    )
    solid = (torch.cos(edges[:-1]) - torch.cos(edges[1:]))[:, None].expand(rows, columns) * (
        2 * math.pi / columns
    )
    return vectors[None], solid


@pytest.mark.parametrize("diffuse", [0.2, 1.0])
@pytest.mark.parametrize("specular", [0.0, 0.04, 0.5])
@pytest.mark.parametrize("angle", [0.0, 40.0, 75.0])
def test_the_diffuse_lobe_reflects_its_albedo(diffuse: float, specular: float, angle: float) -> None:
    light, solid = hemisphere(120, 60)
    view = torch.tensor(
        [math.sin(math.radians(angle)), 0.0, math.cos(math.radians(angle))], dtype=torch.float64
    )
    view = view[None, :, None, None].expand_as(light)
    material = SVBRDF.constant(120, 60, diffuse=diffuse, specular=specular, dtype=torch.float64)
    black = replace(material, diffuse=material.diffuse * 0.0)
    geometry = geometry_of(light, view)
    lobe = cook_torrance(material, geometry) - cook_torrance(black, geometry)
    reflected = float((lobe[0, 0] * light[0, 2] * solid).sum())
    assert reflected == pytest.approx(diffuse * (1.0 - specular), rel=1e-3)
    assert reflected <= 1.0 + 1e-3


@pytest.mark.parametrize("roughness", [0.03, 0.1, 0.3, 0.6, 1.0])
def test_the_ggx_lobe_is_normalised(roughness: float) -> None:
    # The integral of D n.h over all half vectors is 1. Light and view both at h: F = 1 for s = 1, G is known.
    half, solid = hemisphere(40_000, 1, power=4.0)
    material = SVBRDF.constant(40_000, 1, diffuse=0.0, roughness=roughness, specular=1.0, dtype=torch.float64)
    cosine, k = half[:, 2:], roughness**2 / 2
    smith = cosine * (1 - k) + k
    distribution = 4.0 * smith**2 * cook_torrance(material, geometry_of(half, half))[:, :1]
    assert float((distribution * cosine * solid).sum()) == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("roughness", [0.1, 0.4, 0.7, 1.0])
def test_a_mirror_seen_straight_on_reflects_no_more_than_it_receives(roughness: float) -> None:
    light, solid = hemisphere(20_000, 1, power=3.0)
    view = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)[None, :, None, None].expand_as(light)
    mirror = SVBRDF.constant(20_000, 1, diffuse=1.0, roughness=roughness, specular=1.0, dtype=torch.float64)
    reflected = float((cook_torrance(mirror, geometry_of(light, view))[0, 0] * light[0, 2] * solid).sum())
    assert 0.3 < reflected <= 1.0 + 1e-3
    if roughness == 1.0:  # D = 1/pi and G = 2/(1 + n.l): the integral has a closed form
        assert reflected == pytest.approx(1.0 - math.log(2.0), abs=1e-4)


# --- Gradients --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("falloff", ["none", "inverse_square"])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_gradients_in_maps_light_and_intensity(camera: Camera, falloff) -> None:  # type: ignore[no-untyped-def]
    start = Parameters.from_svbrdf(random_svbrdf(1, 1, 3, dtype=torch.float64))
    light = random_light(seed=2, dtype=torch.float64)

    def radiance(
        normal: Tensor, diffuse: Tensor, roughness: Tensor, specular: Tensor, *lit: Tensor
    ) -> Tensor:
        material = Parameters(normal, diffuse, roughness, specular).svbrdf()
        return render(material, PointLight(*lit, falloff=falloff), camera)

    gradcheck(radiance, *(getattr(start, name) for name in MAPS), light.position, light.intensity)


def test_gradients_in_the_raw_maps() -> None:
    material, light = random_svbrdf(1, 2, 3, dtype=torch.float64), random_light(dtype=torch.float64)

    def radiance(normal: Tensor, diffuse: Tensor, roughness: Tensor, specular: Tensor) -> Tensor:
        unit_normal = functional.normalize(normal, dim=1)
        return render(SVBRDF(unit_normal, diffuse, roughness, specular), light)

    gradcheck(radiance, *(getattr(material, name) for name in MAPS))


# --- Hard corners: finite values and gradients in float32 over the whole legal range ----------------------

CORNER_SIZE = (3, 4)
PIXEL = surface_points(*CORNER_SIZE)[:, 1, 2].tolist()

roughnesses = st.sampled_from([1e-3, 0.01, 0.03, 0.031, 0.1, 1.0]) | st.floats(1e-3, 1.0)
unit_interval = st.sampled_from([0.0, 0.04, 1.0]) | st.floats(0.0, 1.0)
normal_heights = st.sampled_from([0.0, 1e-7, 1e-4, 0.02, 0.5, 1.0]) | st.floats(0.0, 1.0)
light_heights = st.sampled_from([1e-3, 0.01, 0.2, 2.14, 50.0]) | st.floats(1e-3, 20.0)
light_sides = st.sampled_from([-1.0, 0.0, PIXEL[0], PIXEL[1], 1.0, 1.5]) | st.floats(-2.0, 2.0)


def assert_finite_everywhere(
    material: SVBRDF, light: PointLight, camera: Camera, rules: Conventions = PAPER
) -> None:
    material = material.map(lambda tensor: tensor.clone().requires_grad_(True))
    light = replace(
        light,
        position=light.position.clone().requires_grad_(True),
        intensity=light.intensity.clone().requires_grad_(True),
    )
    picture = render(material, light, camera, rules)
    assert bool(torch.isfinite(picture).all())
    assert float(picture.detach().min()) >= 0.0
    picture.sum().backward()
    for tensor in (*(getattr(material, name) for name in MAPS), light.position, light.intensity):
        assert tensor.grad is not None
        assert bool(torch.isfinite(tensor.grad).all())


@pytest.mark.parametrize("preset", PRESETS)
@settings(max_examples=80)
@given(
    roughness=roughnesses,
    diffuse=unit_interval,
    specular=unit_interval,
    z=normal_heights,
    azimuth=st.floats(0.0, 2 * math.pi),
    position=st.tuples(light_sides, light_sides, light_heights),
    camera=st.sampled_from(sorted(CAMERAS)),
    falloff=st.sampled_from(["none", "inverse_square"]),
)
@example(0.001, 1.0, 1.0, 1.0, 0.0, (PIXEL[0], PIXEL[1], 1e-3), "collocated", "inverse_square")
@example(0.001, 0.0, 1.0, 0.0, 0.0, (1.0, 0.0, 1e-3), "perspective", "inverse_square")
def test_no_nan_over_the_legal_range(  # type: ignore[no-untyped-def]
    preset, roughness, diffuse, specular, z, azimuth, position, camera, falloff
) -> None:
    flat = SVBRDF.constant(*CORNER_SIZE, diffuse=diffuse, roughness=roughness, specular=specular)
    side = math.sqrt(1.0 - z * z)
    normal = torch.tensor([side * math.cos(azimuth), side * math.sin(azimuth), z])[:, None, None]
    material = replace(flat, normal=functional.normalize(normal + 0.0 * flat.normal, dim=1))
    assert_finite_everywhere(
        material.validate(), PointLight.at(position, falloff=falloff), CAMERAS[camera], PRESETS[preset]
    )


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("roughness", [1e-3, 0.03, 0.3])
def test_half_vector_exactly_on_the_normal(preset: str, roughness: float) -> None:
    material = SVBRDF.constant(5, 5, roughness=roughness, specular=1.0)
    light = PointLight.at((0.0, 0.0, 2.14))
    rules = replace(PRESETS[preset], grid="centre")
    geometry = shading_geometry(surface_points(5, 5), light, Camera(), rules)
    assert torch.equal(geometry.half_vector[0, :, 2, 2], torch.tensor([0.0, 0.0, 1.0]))
    assert_finite_everywhere(material, light, Camera(), rules)
    alpha = max(roughness, rules.roughness_floor) ** 2
    k = alpha / 2
    peak = (alpha / max(alpha**2, rules.distribution_floor)) ** 2 / 4 / ((1 - k + k) ** 2)
    assert float(render(material, light, Camera(), rules)[0, 0, 2, 2]) == pytest.approx(peak, rel=1e-3)


@pytest.mark.parametrize("roughness", [0.03, 0.05, 0.1])
def test_a_sharp_lobe_keeps_its_digits_in_single_precision(roughness: float) -> None:
    material = random_svbrdf(1, 16, 16, tilt=0.01, dtype=torch.float64)
    material = replace(material, roughness=torch.full_like(material.roughness, roughness))
    light = PointLight.at((0.02, 0.01, 2.14), dtype=torch.float64)
    single = render(material.to(torch.float32), light.to(torch.float32))
    assert_close(single, render(material, light), rtol=2e-2, atol=1e-4)


CORNERS: dict[str, Callable[[], tuple[SVBRDF, PointLight]]] = {
    "a light on a pixel of the surface": lambda: (
        SVBRDF.constant(3, 4),
        PointLight.at((PIXEL[0], PIXEL[1], 0.0)),
    ),
    "a falling light on a pixel of the surface": lambda: (
        SVBRDF.constant(3, 4),
        PointLight.at((PIXEL[0], PIXEL[1], 0.0), falloff="inverse_square"),
    ),
    "a light in the plane beyond the edge": lambda: (SVBRDF.constant(3, 4), PointLight.at((2.0, 0.0, 0.0))),
    "a light below the surface": lambda: (SVBRDF.constant(3, 4), PointLight.at((0.3, 0.0, -1.0))),
    "a light straight opposite the camera": lambda: (SVBRDF.constant(1, 1), PointLight.at((0.0, 0.0, -2.14))),
    "a black light": lambda: (random_svbrdf(), PointLight.at((0.0, 0.0, 2.0), 0.0)),
    "one pixel": lambda: (SVBRDF.constant(1, 1, roughness=1e-3), PointLight.at((0.0, 0.0, 2.14))),
}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("corner", CORNERS)
def test_no_nan_in_places_lights_should_not_be(corner: str, camera: Camera) -> None:
    assert_finite_everywhere(*CORNERS[corner](), camera)
