"""USD layers, opened and validated by USD itself, and shaded by the formulas of its preview surface."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from nets.render import Camera, PointLight, shading_geometry, surface_points
from nets.svbrdf import SVBRDF
from refine.export.bundle import Source
from refine.export.targets import export_material
from refine.maps import MapFormat
from tests.helpers import assert_close

pytest.importorskip("pxr", reason="needs the extra [export]")

from pxr import Usd, UsdGeom, UsdShade, UsdValidation

from refine.export.usd import usd


def stage_of(source: Source, folder: Path) -> Any:
    export_material(source.svbrdf, folder, source.stem, ["usd"], format=source.format, tile=source.repeats)
    return Usd.Stage.Open(str(folder / f"{source.stem}.usda"))


@pytest.mark.parametrize("format", [MapFormat(), MapFormat("png", 8), MapFormat("exr", 16)], ids=str)
def test_every_validator_of_usd_is_content(source: Source, tmp_path: Path, format: MapFormat) -> None:
    stage = stage_of(replace(source, format=format), tmp_path)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in found] == []


def test_a_missing_picture_would_be_noticed(source: Source, tmp_path: Path) -> None:
    stage = stage_of(source, tmp_path)
    (tmp_path / source.file("normal")).unlink()
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert UsdValidation.ValidationContext(validators).Validate(stage)


def test_inputs_are_connected_to_their_pictures(source: Source, tmp_path: Path) -> None:
    stage = stage_of(source, tmp_path)
    root = stage.GetDefaultPrim()
    assert root.GetDisplayName() == source.stem
    (mesh,) = (prim for prim in root.GetChildren() if prim.IsA(UsdGeom.Mesh))
    material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    surface, _, _ = material.ComputeSurfaceSource()
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    assert surface.GetInput("useSpecularWorkflow").Get() == 1
    found = {}
    for name in ("diffuseColor", "specularColor", "roughness", "normal"):
        texture = UsdShade.Shader(surface.GetInput(name).GetConnectedSources()[0][0].source.GetPrim())
        file = texture.GetInput("file").Get()
        assert Path(file.resolvedPath).parent == tmp_path
        found[name] = (Path(file.path).name, texture.GetInput("sourceColorSpace").Get())
    assert found == {
        "diffuseColor": (source.file("diffuse"), "sRGB"),
        "specularColor": (source.file("specular"), "sRGB"),
        "roughness": (source.file("roughness"), "raw"),
        "normal": (source.file("normal"), "raw"),
    }
    corners = UsdGeom.Mesh(mesh).GetPointsAttr().Get()
    assert [tuple(corner) for corner in corners][2] == (1.0, 0.75, 0.0)


def test_the_diffuse_of_the_preview_surface_is_ours(material: SVBRDF) -> None:
    """`diffuseColor (1 - mix(F0, 1, (1 - v.h)^5)) / pi` (OpenUSD, previewSurface.glslfx), near the normal."""
    points = surface_points(*material.size)
    geometry = shading_geometry(points, PointLight.at((0.0, 0.0, 2.14)), Camera())
    v_dot_h = (geometry.view * geometry.half_vector).sum(dim=1, keepdim=True)
    white = (1.0 - v_dot_h) ** 5
    shown = material.diffuse * (1.0 - (material.specular + (1.0 - material.specular) * white))
    assert_close(shown, material.diffuse * (1.0 - material.specular), atol=1e-5)


def test_a_tile_repeats(source: Source) -> None:
    assert '"repeat"' in usd(replace(source, repeats=True)).files[f"{source.stem}.usda"]
    assert '"clamp"' in usd(source).files[f"{source.stem}.usda"]


def test_shading_is_in_range(source: Source) -> None:
    for content in usd(source).files.values():
        if not isinstance(content, str | bytes):
            assert bool(torch.isfinite(content.pixels).all())
            assert 0.0 <= float(content.pixels.min()) <= float(content.pixels.max()) <= 1.0
