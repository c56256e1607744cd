"""glTF 2.0 as one GLB: a textured plane with KHR_materials_specular and KHR_materials_ior.

The core's dielectric has F0 = 0.04; the extensions make it any colour. What lies below gets what the
strongest colour of F lets through: `layered_base_color`. glTF's Fresnel is Schlick's, whatever the index of
refraction, so one index for the brightest pixel and a texture of shares of it lose nothing but 8 bits' worth.
"""

from __future__ import annotations

import struct

import pygltflib as gltf
import torch

from refine.export.bundle import Bundle, Picture, Source, png_bytes
from refine.export.shading import from_layered, layered_base_color, loss, split_specular


def glb(source: Source) -> Bundle:
    """Return the GLB, its pictures inside as 8-bit PNG."""
    svbrdf = source.svbrdf
    split = split_specular(svbrdf.specular)
    base = layered_base_color(svbrdf)
    ones = torch.ones_like(svbrdf.roughness)
    pictures = {
        "base_color": Picture(base, color=True),
        "occlusion_roughness_metallic": Picture(torch.cat([ones, svbrdf.roughness, 0.0 * ones], dim=1)),
        "normal": Picture(svbrdf.normal * 0.5 + 0.5),
        "specular_color": Picture(split.level * split.tint, color=True),
    }
    wrap = gltf.REPEAT if source.repeats else gltf.CLAMP_TO_EDGE
    document = gltf.GLTF2(
        asset=gltf.Asset(version="2.0", generator="refine"),
        scene=0,
        scenes=[gltf.Scene(nodes=[0])],
        nodes=[gltf.Node(mesh=0, name=source.stem)],
        materials=[_material(source.stem, split.ior)],
        samplers=[
            gltf.Sampler(magFilter=gltf.LINEAR, minFilter=gltf.LINEAR_MIPMAP_LINEAR, wrapS=wrap, wrapT=wrap)
        ],
        textures=[gltf.Texture(sampler=0, source=index) for index in range(len(pictures))],
        extensionsUsed=["KHR_materials_specular", "KHR_materials_ior"],
    )
    binary = _plane(document, *source.half_size)
    for name, picture in pictures.items():
        view, binary = _append(document, binary, png_bytes(picture))
        document.images.append(gltf.Image(name=name, mimeType="image/png", bufferView=view))
    document.buffers = [gltf.Buffer(byteLength=len(binary))]
    document.set_binary_blob(binary)
    return Bundle(
        {f"{source.stem}.glb": b"".join(document.save_to_bytes())},
        {"ior": split.ior, "loss": loss(svbrdf, from_layered(svbrdf, base))},
    )


def _material(name: str, ior: float) -> gltf.Material:
    return gltf.Material(
        name=name,
        pbrMetallicRoughness=gltf.PbrMetallicRoughness(
            baseColorTexture=gltf.TextureInfo(index=0),
            metallicRoughnessTexture=gltf.TextureInfo(index=1),
            metallicFactor=0.0,
            roughnessFactor=1.0,
        ),
        normalTexture=gltf.NormalMaterialTexture(index=2),
        extensions={
            "KHR_materials_specular": {"specularColorTexture": {"index": 3}},
            "KHR_materials_ior": {"ior": ior},
        },
        alphaMode=gltf.OPAQUE,
        alphaCutoff=None,
        doubleSided=True,
    )


def _plane(document: gltf.GLTF2, x: float, y: float) -> bytes:
    """Add a plane that faces +z, with tangents; texture coordinates have (0, 0) at the upper left."""
    position = [(-x, -y, 0.0), (x, -y, 0.0), (x, y, 0.0), (-x, y, 0.0)]
    columns: dict[str, tuple[str, list[tuple[float, ...]]]] = {
        "POSITION": (gltf.VEC3, list(position)),
        "NORMAL": (gltf.VEC3, [(0.0, 0.0, 1.0)] * 4),
        "TANGENT": (gltf.VEC4, [(1.0, 0.0, 0.0, 1.0)] * 4),
        "TEXCOORD_0": (gltf.VEC2, [(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)]),
    }
    binary, attributes = b"", {}
    for name, (kind, rows) in columns.items():
        data = b"".join(struct.pack(f"<{len(row)}f", *row) for row in rows)
        view, binary = _append(document, binary, data, gltf.ARRAY_BUFFER)
        accessor = gltf.Accessor(bufferView=view, componentType=gltf.FLOAT, count=4, type=kind)
        if name == "POSITION":
            accessor.min, accessor.max = list(position[0]), list(position[2])
        attributes[name] = len(document.accessors)
        document.accessors.append(accessor)
    view, binary = _append(document, binary, struct.pack("<6H", 0, 1, 2, 0, 2, 3), gltf.ELEMENT_ARRAY_BUFFER)
    indices = len(document.accessors)
    document.accessors.append(
        gltf.Accessor(bufferView=view, componentType=gltf.UNSIGNED_SHORT, count=6, type=gltf.SCALAR)
    )
    primitive = gltf.Primitive(attributes=gltf.Attributes(**attributes), indices=indices, material=0)
    document.meshes = [gltf.Mesh(primitives=[primitive])]
    return binary


def _append(document: gltf.GLTF2, binary: bytes, data: bytes, target: int | None = None) -> tuple[int, bytes]:
    """Append data, aligned to four bytes, as a new view; return its index and the longer binary."""
    view = gltf.BufferView(buffer=0, byteOffset=len(binary), byteLength=len(data), target=target)
    document.bufferViews.append(view)
    return len(document.bufferViews) - 1, binary + data + b"\0" * (-len(data) % 4)
