"""MaterialX: one document with the material as Autodesk's standard_surface and as OpenPBR.

Both lay a dielectric over a diffuse, which gets what the dielectric lets through: `layered_base_color`. F0 is
an index of refraction per pixel and a tint: OpenPBR scales the F0 of a constant index by `specular_weight`,
for standard_surface the graph computes the index. (A dark tint alone would darken the rim, too.)
"""

from __future__ import annotations

import re

import MaterialX as mx

from refine.export.bundle import TEXTURES, Bundle, Source
from refine.export.shading import from_layered, layered_base_color, loss, split_specular

_TYPES = {
    "base_color": "color3",
    "specular_tint": "color3",
    "specular_level": "float",
    "roughness": "float",
    "normal": "vector3",
}


def materialx(source: Source) -> Bundle:
    """Return the document and its pictures."""
    split = split_specular(source.svbrdf.specular)
    document = mx.createDocument()
    document.setColorSpace("lin_rec709")
    graph = document.addNodeGraph(f"NG_{source.identifier}")
    outputs = {name: _image(graph, source, name) for name in _TYPES}
    outputs["normal"] = _node(graph, "normalmap", "tangent_normal", "vector3", {"in": outputs["normal"]})
    root = _node(graph, "multiply", "f0", "float", {"in1": outputs["specular_level"], "in2": split.peak})
    root = _node(graph, "sqrt", "f0_root", "float", {"in": root})
    above = _node(graph, "add", "f0_root_above", "float", {"in1": root, "in2": 1.0})
    below = _node(graph, "subtract", "f0_root_below", "float", {"in1": 1.0, "in2": root})
    outputs["ior"] = _node(graph, "divide", "ior", "float", {"in1": above, "in2": below})
    for name, node in outputs.items():
        graph.addOutput(f"{name}_out", node.getType()).setNodeName(node.getName())
    shared = {
        "base_color": "base_color",
        "specular_color": "specular_tint",
        "specular_roughness": "roughness",
    }
    _material(
        document, graph, source, "standard_surface",
        {**shared, "specular_IOR": "ior", "normal": "normal"},
        {"base": 1.0, "specular": 1.0},
    )  # fmt: skip
    _material(
        document, graph, source, "open_pbr_surface",
        {**shared, "specular_weight": "specular_level", "geometry_normal": "normal"},
        {"base_weight": 1.0, "specular_ior": split.ior},
    )  # fmt: skip
    shown = from_layered(source.svbrdf, layered_base_color(source.svbrdf))
    return Bundle(
        {f"{source.stem}.mtlx": _xml(document), **source.textures(*_TYPES)},
        {"ior": split.ior, "loss": loss(source.svbrdf, shown)},
    )


def _xml(document: mx.Document) -> str:
    """Return the document as XML; MaterialX leaves `<` in attributes, which other readers do not take."""
    text: str = mx.writeToXmlString(document)
    return re.sub(r'="[^"]*"', lambda attribute: attribute[0].replace("<", "&lt;"), text)


def _image(graph: mx.NodeGraph, source: Source, name: str) -> mx.Node:
    node = graph.addNode("image", name, _TYPES[name])
    file = node.addInput("file", "filename")
    file.setValueString(source.file(name))
    if TEXTURES[name].color:
        file.setColorSpace("lin_rec709" if source.format.linear else "srgb_texture")
    for direction in ("uaddressmode", "vaddressmode"):
        node.addInput(direction, "string").setValueString("periodic" if source.repeats else "clamp")
    return node


def _node(
    graph: mx.NodeGraph, category: str, name: str, kind: str, inputs: dict[str, mx.Node | float]
) -> mx.Node:
    node = graph.addNode(category, name, kind)
    for key, value in inputs.items():
        if isinstance(value, mx.Node):
            node.addInput(key, value.getType()).setNodeName(value.getName())
        else:
            node.addInput(key, "float").setValue(float(value))
    return node


def _material(
    document: mx.Document,
    graph: mx.NodeGraph,
    source: Source,
    category: str,
    connected: dict[str, str],
    constant: dict[str, float],
) -> None:
    """Add a surface shader of that category, its inputs from the graph's outputs, and a material."""
    shader = document.addNode(category, f"SR_{source.identifier}_{category}", "surfaceshader")
    for name, value in constant.items():
        shader.addInput(name, "float").setValue(float(value))
    for name, output in connected.items():
        kind = graph.getOutput(f"{output}_out").getType()
        link = shader.addInput(name, kind)
        link.setNodeGraphString(graph.getName())
        link.setOutputString(f"{output}_out")
    material = document.addNode("surfacematerial", f"{source.identifier}_{category}", "material")
    material.addInput("surfaceshader", "surfaceshader").setNodeName(shader.getName())
