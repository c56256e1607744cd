"""What our material is in other models: by the formulas of their specifications, written out again."""

from __future__ import annotations

import math

import pytest
import torch

from nets.svbrdf import SVBRDF
from refine.export.shading import (
    DIELECTRIC_F0,
    LARGEST_F0,
    MetallicRoughness,
    diffuse_reflectance,
    f0_of_ior,
    from_layered,
    ior_of_f0,
    layered_base_color,
    loss,
    metallic_roughness,
    split_specular,
)
from tests.helpers import assert_close, random_svbrdf


def grey_specular(material: SVBRDF) -> SVBRDF:
    grey = material.specular[:, :1].expand_as(material.specular)
    return SVBRDF(material.normal, material.diffuse, material.roughness, grey)


def test_below_a_grey_layer_base_color_is_our_diffuse() -> None:
    material = grey_specular(random_svbrdf(dtype=torch.float64))
    assert_close(layered_base_color(material), material.diffuse)


def test_what_leaves_a_layer_is_our_diffuse_reflectance() -> None:
    material = random_svbrdf(dtype=torch.float64)
    base = layered_base_color(material)
    strongest = torch.maximum(
        torch.maximum(material.specular[:, 0], material.specular[:, 1]), material.specular[:, 2]
    )
    shown = base * (1.0 - strongest[:, None])
    unclipped = base < 1.0
    assert bool(unclipped.any())
    assert not bool(unclipped.all())
    assert_close(shown[unclipped], (material.diffuse * (1.0 - material.specular))[unclipped])
    assert bool((shown <= material.diffuse * (1.0 - material.specular) + 1e-12).all())


def test_a_mirror_has_a_base_color() -> None:
    assert bool(torch.isfinite(layered_base_color(SVBRDF.constant(2, 2, specular=1.0))).all())


def test_index_of_refraction() -> None:
    assert ior_of_f0(0.04) == pytest.approx(1.5)
    assert f0_of_ior(1.5) == pytest.approx(0.04)
    assert f0_of_ior(ior_of_f0(0.37)) == pytest.approx(0.37)
    assert ior_of_f0(LARGEST_F0) == pytest.approx(199.0, rel=0.01)


def test_split_specular_is_put_together_again() -> None:
    specular = random_svbrdf(dtype=torch.float64).specular * 0.9
    split = split_specular(specular)
    assert split.peak == pytest.approx(float(specular.max()))
    assert_close(split.peak * split.level * split.tint, specular)
    assert_close(split.tint.amax(dim=1), torch.ones_like(split.tint[:, 0]))
    assert float(split.level.max()) == pytest.approx(1.0)


@pytest.mark.parametrize(("f0", "peak"), [(0.0, DIELECTRIC_F0), (0.02, DIELECTRIC_F0), (1.0, LARGEST_F0)])
def test_split_of_constants(f0: float, peak: float) -> None:
    split = split_specular(SVBRDF.constant(2, 2, specular=f0).specular)
    assert split.peak == peak
    assert_close(split.tint, torch.ones(1, 3, 2, 2))
    assert_close(split.peak * split.level, torch.full((1, 1, 2, 2), min(f0, peak)))


def of_the_workflow(base: torch.Tensor, metallic: torch.Tensor) -> SVBRDF:
    """Return a material the metallic workflow can say: glTF 2.0, appendix B."""
    f0 = 0.04 * (1.0 - metallic) + base * metallic
    flat = SVBRDF.constant(*base.shape[-2:], dtype=base.dtype)
    return SVBRDF(flat.normal, base * (1.0 - metallic) / (1.0 - f0), flat.roughness, f0)


def test_a_metallic_material_is_found_again() -> None:
    base = 0.1 + 0.3 * torch.rand(1, 1, 6, 7, dtype=torch.float64).expand(1, 3, 6, 7)
    metallic = 0.9 * torch.rand(1, 1, 6, 7, dtype=torch.float64)
    material = of_the_workflow(base, metallic)
    found = metallic_roughness(material)
    assert_close(found.metallic, metallic)
    assert_close(found.base_color, base)
    assert max(loss(material, found.shown(material)).values()) < 1e-9


def test_bare_metal_and_plain_dielectric() -> None:
    gold = torch.tensor([1.0, 0.77, 0.34])[None, :, None, None].expand(1, 3, 2, 2)
    flat = SVBRDF.constant(2, 2, diffuse=0.0)
    metal = metallic_roughness(SVBRDF(flat.normal, flat.diffuse, flat.roughness, gold))
    assert_close(metal.metallic, torch.ones(1, 1, 2, 2))
    assert_close(metal.base_color, gold)
    plain = SVBRDF.constant(2, 2, diffuse=0.5, specular=0.04)
    found = metallic_roughness(plain)
    assert_close(found.metallic, torch.zeros(1, 1, 2, 2))
    assert_close(found.base_color, diffuse_reflectance(plain))


def test_the_loss_of_the_metallic_workflow_is_what_it_cannot_say() -> None:
    material = SVBRDF.constant(4, 4, diffuse=0.5, specular=0.02)  # darker than any dielectric it knows
    found = metallic_roughness(material)
    measured = loss(material, found.shown(material))
    assert measured["specular"] == pytest.approx(0.02, rel=1e-4)
    assert measured["diffuse"] < 1e-6
    assert 0.0 < measured["rendering"] < 0.1


def test_loss_is_a_root_mean_square() -> None:
    dark, bright = (SVBRDF.constant(4, 4, diffuse=d, specular=0.0, roughness=1.0) for d in (0.2, 0.3))
    assert loss(dark, bright)["diffuse"] == pytest.approx(0.1, rel=1e-5)
    assert loss(dark, dark) == {"diffuse": 0.0, "specular": 0.0, "rendering": 0.0}


def test_random_materials_stay_legal() -> None:
    material = random_svbrdf(height=9, width=8, seed=3)
    found = metallic_roughness(material)
    for tensor in (found.base_color, found.metallic, layered_base_color(material)):
        assert math.isfinite(float(tensor.sum()))
        assert 0.0 <= float(tensor.min()) <= float(tensor.max()) <= 1.0
    found.shown(material).validate()
    from_layered(material, layered_base_color(material)).validate()
    assert isinstance(found, MetallicRoughness)
