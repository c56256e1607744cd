"""The procedural materials: every family keeps the conventions, and its maps agree with one another."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import pytest

from nets.data import procedural
from nets.data.procedural import (
    FAMILIES,
    HELD_OUT_FAMILIES,
    MaterialMaps,
    generate,
    random_material,
    relief,
)
from nets.data.procedural.compose import cavity
from nets.data.procedural.noise import grid

SIZE = 96
SEEDS = (0, 1, 2, 3)
each_family = pytest.mark.parametrize("family", sorted(FAMILIES))


@functools.cache
def material(family: str, seed: int = 0) -> MaterialMaps:
    return generate(family, SIZE, seed)


def arrays(maps: MaterialMaps) -> tuple[np.ndarray, ...]:
    return maps.height, maps.diffuse, maps.roughness, maps.specular


@each_family
@pytest.mark.parametrize("seed", SEEDS)
def test_shapes_types_and_ranges(family: str, seed: int) -> None:
    maps = material(family, seed)
    assert maps.height.shape == maps.roughness.shape == (SIZE, SIZE)
    assert maps.diffuse.shape == maps.specular.shape == maps.normal.shape == (SIZE, SIZE, 3)
    for array in (*arrays(maps), maps.normal):
        assert array.dtype == np.float32
        assert np.isfinite(array).all()
    assert maps.diffuse.min() >= 0
    assert maps.diffuse.max() <= 1
    assert maps.roughness.min() > 0
    assert maps.roughness.max() <= 1
    assert maps.specular.min() > 0
    assert maps.specular.max() <= 1


@each_family
def test_normals_are_unit_and_face_the_viewer(family: str) -> None:
    normal = material(family).normal
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-5)
    assert normal[..., 2].min() > 0


@each_family
def test_normals_agree_with_finite_differences_of_the_height(family: str) -> None:
    """x is right and y is up, so row r + 1 lies one spacing *below* row r."""
    maps = material(family)
    height, normal, spacing = maps.height.astype(np.float64), maps.normal[1:-1, 1:-1], 2 / SIZE
    along_x = (height[1:-1, 2:] - height[1:-1, :-2]) / (2 * spacing)
    along_y = (height[:-2, 1:-1] - height[2:, 1:-1]) / (2 * spacing)
    np.testing.assert_allclose(-normal[..., 0] / normal[..., 2], along_x, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(-normal[..., 1] / normal[..., 2], along_y, rtol=1e-3, atol=1e-3)


def test_a_slope_facing_up_has_a_normal_pointing_up() -> None:
    y = 1 - (2 * np.arange(32, dtype=np.float32) + 1) / 32
    falling_upwards = np.repeat(-0.5 * y[:, None], 32, axis=1)
    expected = np.array([0, 0.5, 1]) / np.sqrt(1.25)
    np.testing.assert_allclose(procedural.normal_from_height(falling_upwards)[16, 16], expected, atol=1e-5)


@each_family
def test_the_same_seed_gives_the_same_bytes(family: str) -> None:
    for first, second in zip(arrays(material(family)), arrays(generate(family, SIZE, 0)), strict=True):
        assert first.tobytes() == second.tobytes()


@each_family
def test_another_seed_gives_another_material(family: str) -> None:
    for first, second in zip(arrays(material(family, 0)), arrays(material(family, 1)), strict=True):
        assert np.abs(first - second).mean() > 1e-4


@each_family
def test_a_material_is_plausible(family: str) -> None:
    """Over a few seeds: neither black holes nor snow, neither flat nor spikes, and roughness that varies."""
    some = [material(family, seed) for seed in SEEDS]
    reflectance = np.array([np.maximum(m.diffuse, m.specular).mean() for m in some])
    tilt = np.array([np.degrees(np.arccos(np.minimum(m.normal[..., 2], 1))).mean() for m in some])
    assert reflectance.min() > 0.02
    assert reflectance.max() < 0.95
    assert tilt.min() > 0.5
    assert tilt.max() < 40
    assert min(m.roughness.std() for m in some) > 0.005
    assert len({round(float(m.roughness.mean()), 3) for m in some}) > 1


@each_family
def test_there_is_detail_at_the_finest_scale(family: str) -> None:
    """Neighbouring pixels differ in height slope, colour and roughness nearly everywhere."""
    maps = material(family)
    for array in (maps.normal[..., 0], maps.diffuse.mean(-1), maps.roughness):
        assert (np.abs(np.diff(array, axis=1)) > 1e-5).mean() > 0.5


@pytest.mark.parametrize(
    "family",
    ["brick", "diamond_plate", "parquet", "woven_fabric", "riveted_panel", "setts", "quilted_leather"],
)
@pytest.mark.parametrize("size", [16, 65, 256])
def test_any_size(family: str, size: int) -> None:
    assert generate(family, size, 5).diffuse.shape == (size, size, 3)


def test_bricks_stand_above_their_mortar_and_mortar_is_rougher() -> None:
    maps = material("brick")
    low, high = np.quantile(maps.height, [0.1, 0.6])
    assert maps.roughness[maps.height < low].mean() > maps.roughness[maps.height > high].mean() + 0.05


RELIEFS = {
    "sheet": (
        "tread_plate",
        "stamped_sheet",
        "knurled_metal",
        "wire_mesh",
        "corrugated_sheet",
        "pressed_tin",
    ),
    "stones": ("setts", "rounded_cobbles", "pillowed_tile"),
    "padding": ("tufted_leather", "quilted_leather"),
    "panels": ("riveted_panel",),
}
each_relief = pytest.mark.parametrize("family", [name for group in RELIEFS.values() for name in group])


@each_relief
def test_reliefs_have_steep_edges_and_no_cliffs(family: str) -> None:
    """Bevels of tens of degrees are what a flash shows; hardly a pixel stands steeper than 75."""
    tilts = [
        np.degrees(np.arccos(np.minimum(generate(family, 192, seed).normal[..., 2], 1))) for seed in SEEDS
    ]
    steep = [float(np.quantile(tilt, 0.99)) for tilt in tilts]
    assert min(steep) > 10
    assert 25 < max(steep) < 75


@pytest.mark.parametrize("family", [*RELIEFS["stones"], *RELIEFS["padding"]])
def test_stones_and_padding_are_rougher_and_mostly_darker_where_they_are_deep(family: str) -> None:
    lightness, roughness = [], []
    for seed in SEEDS:
        maps = generate(family, 128, seed)
        deep = cavity(maps.height, 0.1) > 1
        lightness.append(np.log(maps.diffuse[deep].mean() / maps.diffuse[~deep].mean()))
        roughness.append(maps.roughness[deep].mean() - maps.roughness[~deep].mean())
    if family != "pillowed_tile":  # grout is often paler than tiles
        assert np.median(lightness) < -0.03
    assert np.median(roughness) > 0.01


def test_shoulders_rise_at_the_angle_asked_for_and_level_off() -> None:
    distance = np.linspace(-0.1, 0.3, 4001)
    for power in (1.0, 2.0, 3.0):
        height = relief.shoulder(distance, 0.2, 50, power)
        climb = np.degrees(np.arctan(np.gradient(height.astype(np.float64), distance[1] - distance[0])))
        assert climb.max() == pytest.approx(50, abs=0.5)
        assert height.min() == 0
        assert height[-1] == pytest.approx(0.2 * np.tan(np.radians(50)) / power, rel=1e-5)
    swelling = relief.swell(distance, 0.2, 50).astype(np.float64)
    middle = np.degrees(np.arctan(np.gradient(swelling, distance[1] - distance[0]))).max()
    assert middle == pytest.approx(50, abs=0.5)


@pytest.mark.parametrize("places", [relief.hexagons, relief.scales])
def test_distances_to_the_borders_of_hexagons_and_scales_are_distances(
    places: Callable[..., tuple[relief.Lattice, np.ndarray]],
) -> None:
    """Never negative, zero somewhere on each border, and nowhere steeper than 1."""
    x, y = grid(256)
    lattice, edge = places(x, y, 0.5)
    assert edge.min() > -1e-5
    border = lattice.index[:, 1:] != lattice.index[:, :-1]
    assert np.minimum(edge[:, 1:], edge[:, :-1])[border].max() < 2 / 256 + 1e-5
    assert np.abs(np.diff(edge, axis=1)).max() < 2 / 256 + 1e-5


@pytest.mark.parametrize("family", ["brushed_metal", "scratched_metal", "galvanized"])
def test_bare_metals_reflect_specularly(family: str) -> None:
    maps = material(family)
    assert maps.specular.mean() > 0.25
    assert maps.diffuse.mean() < 0.12


@pytest.mark.parametrize("family", ["brick", "wood_planks", "carpet", "marble", "paper"])
def test_dielectrics_have_a_grey_f0_near_four_percent(family: str) -> None:
    specular = material(family).specular
    assert 0.02 < specular.mean() < 0.08
    np.testing.assert_array_equal(specular[..., 0], specular[..., 2])


def test_there_are_many_families_and_four_are_held_out() -> None:
    assert len(FAMILIES) >= 20
    assert len(HELD_OUT_FAMILIES) == 4
    assert set(FAMILIES) > HELD_OUT_FAMILIES


def test_random_material_never_draws_a_held_out_family(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = material("paper")
    monkeypatch.setattr(procedural, "generate", lambda family, size, seed: maps)
    drawn = {random_material(SIZE, seed)[0] for seed in range(1500)}
    assert drawn == set(FAMILIES) - HELD_OUT_FAMILIES


def test_random_material_is_the_generated_one_and_heeds_the_families_asked_for() -> None:
    asked = sorted(HELD_OUT_FAMILIES)
    family, maps = random_material(SIZE, 11, asked)
    assert family in asked
    assert maps.diffuse.tobytes() == generate(family, SIZE, 11).diffuse.tobytes()
    assert {random_material(16, seed, asked)[0] for seed in range(40)} == set(asked)


def test_errors_name_what_is_wrong() -> None:
    with pytest.raises(ValueError, match="unknown family 'cheese'"):
        generate("cheese", SIZE, 0)
    with pytest.raises(ValueError, match="at least 16 pixels, got 8"):
        generate("brick", 8, 0)
    with pytest.raises(ValueError, match="no families"):
        random_material(SIZE, 0, [])
