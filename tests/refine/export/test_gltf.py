"""GLB files, read by pygltflib and by trimesh, and decoded by the formulas of the glTF extensions."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from nets.svbrdf import SVBRDF
from refine.export.bundle import Source

pygltflib = pytest.importorskip("pygltflib", reason="needs the extra [export]")

from refine.export.gltf import glb  # noqa: E402


@pytest.fixture
def data(source: Source) -> bytes:
    found = glb(source).files[f"{source.stem}.glb"]
    assert isinstance(found, bytes)
    return found


def picture(document: Any, texture: int, tmp_path: Any) -> np.ndarray:
    """Return a texture as stored, values in [0, 1]."""
    view = document.bufferViews[document.images[document.textures[texture].source].bufferView]
    path = tmp_path / f"{texture}.png"
    path.write_bytes(document.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength])
    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT))


def linear(encoded: np.ndarray) -> np.ndarray:
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def test_the_material_is_found_again(data: bytes, material: SVBRDF, tmp_path: Any) -> None:
    """KHR_materials_specular and _ior: F0 = ((n - 1) / (n + 1))^2 colour, and base (1 - max F0) below it."""
    document = pygltflib.GLTF2().load_from_bytes(data)
    (described,) = document.materials
    pbr = described.pbrMetallicRoughness
    ior = described.extensions["KHR_materials_ior"]["ior"]
    specular_texture = described.extensions["KHR_materials_specular"]["specularColorTexture"]["index"]
    f0 = ((ior - 1.0) / (ior + 1.0)) ** 2 * linear(picture(document, specular_texture, tmp_path))
    expected = material.specular[0].permute(1, 2, 0).numpy()
    assert np.abs(f0 - expected).max() < 0.01
    base = linear(picture(document, pbr.baseColorTexture.index, tmp_path))
    diffuse = base * (1.0 - f0.max(axis=-1, keepdims=True))
    reflectance = (material.diffuse * (1.0 - material.specular))[0].permute(1, 2, 0).numpy()
    unclipped = base < 1.0
    assert np.abs(diffuse - reflectance)[unclipped].max() < 0.01
    assert unclipped.mean() > 0.9
    packed = picture(document, pbr.metallicRoughnessTexture.index, tmp_path)
    assert np.abs(packed[..., 1] - material.roughness[0, 0].numpy()).max() < 0.51 / 255
    assert (packed[..., 0] == 1.0).all()
    assert (pbr.metallicFactor, pbr.roughnessFactor) == (0.0, 1.0)
    normal = picture(document, described.normalTexture.index, tmp_path) * 2.0 - 1.0
    assert np.abs(normal - material.normal[0].permute(1, 2, 0).numpy()).max() < 1.01 / 255


def test_extensions_are_declared(data: bytes) -> None:
    document = pygltflib.GLTF2().load_from_bytes(data)
    assert set(document.extensionsUsed) == set(document.materials[0].extensions)
    assert document.asset.version == "2.0"
    for view in document.bufferViews:
        assert view.byteOffset % 4 == 0
        assert view.byteOffset + view.byteLength <= document.buffers[0].byteLength


def test_a_second_reader_sees_the_plane(data: bytes, source: Source, material: SVBRDF) -> None:
    trimesh = pytest.importorskip("trimesh", reason="needs the extra [test]")
    scene = trimesh.load(io.BytesIO(data), file_type="glb", process=False)
    (mesh,) = scene.geometry.values()
    np.testing.assert_allclose(mesh.bounds, [[-1.0, -0.75, 0.0], [1.0, 0.75, 0.0]])
    assert mesh.face_normals.tolist() == [[0.0, 0.0, 1.0]] * 2
    assert mesh.area == pytest.approx(3.0)
    upper_left = int(np.argmax(mesh.vertices @ [-1.0, 1.0, 0.0]))
    # trimesh turns v over: for it (0, 0) is at the lower left
    np.testing.assert_allclose(mesh.visual.uv[upper_left], [0.0, 1.0])
    seen = mesh.visual.material
    assert seen.name == source.stem
    assert seen.baseColorTexture.size == (64, 48)
    assert seen.normalTexture.size == (64, 48)
    stored = np.asarray(seen.metallicRoughnessTexture)[..., 1] / 255.0
    assert np.abs(stored - material.roughness[0, 0].numpy()).max() < 0.51 / 255


def test_the_same_bytes_twice(source: Source, data: bytes) -> None:
    assert glb(source).files[f"{source.stem}.glb"] == data


def test_a_tile_repeats(source: Source) -> None:
    from dataclasses import replace

    document = pygltflib.GLTF2().load_from_bytes(
        glb(replace(source, repeats=True)).files[f"{source.stem}.glb"]
    )
    assert document.samplers[0].wrapS == pygltflib.REPEAT


def test_a_mirror_can_be_said(source: Source) -> None:
    mirror = Source(SVBRDF.constant(8, 8, diffuse=0.0, specular=1.0), "mirror")
    found = glb(mirror)
    assert math.isfinite(found.notes["ior"])
    assert torch.tensor(found.notes["loss"]["rendering"]) < 0.02
