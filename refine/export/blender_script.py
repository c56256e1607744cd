"""Build this material in Blender 4.0 or newer: run the script in the text editor, or `blender --python` it.

Written by `refine export`. It needs no add-on, only the pictures beside it. Run, it adds the material and a
plane of the surface's shape that wears it, 2 m along its longer side; imported, it only defines functions.
"""

from pathlib import Path
from typing import Any

import bpy

SETTINGS: dict[str, Any] = {}


def material() -> bpy.types.Material:
    """Return the material, its nodes built anew."""
    made = bpy.data.materials.get(SETTINGS["name"]) or bpy.data.materials.new(SETTINGS["name"])
    if bpy.app.version < (5, 0):
        made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()
    output = _node(tree, "ShaderNodeOutputMaterial", 600, 300)
    shader = _node(tree, "ShaderNodeBsdfPrincipled", 300, 300)
    shader.distribution = "GGX"
    shader.inputs["Metallic"].default_value = 0.0
    shader.inputs["IOR"].default_value = SETTINGS["ior"]
    tree.links.new(shader.outputs["BSDF"], output.inputs["Surface"])
    colors = {name: _picture(tree, name, row) for row, name in enumerate(SETTINGS["pictures"])}
    for name, socket in (
        ("base_color", "Base Color"), ("specular_tint", "Specular Tint"), ("roughness", "Roughness"),
    ):  # fmt: skip
        tree.links.new(colors[name], shader.inputs[socket])
    # An IOR level of 0.5 leaves the F0 of the index of refraction as it is.
    half = _node(tree, "ShaderNodeMath", 0, -300)
    half.operation = "MULTIPLY"
    half.inputs[1].default_value = 0.5
    tree.links.new(colors["specular_level"], half.inputs[0])
    tree.links.new(half.outputs["Value"], shader.inputs["Specular IOR Level"])
    normal = _node(tree, "ShaderNodeNormalMap", 0, -900)
    tree.links.new(colors["normal"], normal.inputs["Color"])
    tree.links.new(normal.outputs["Normal"], shader.inputs["Normal"])
    return made


def plane() -> bpy.types.Object:
    """Return a plane of the surface's shape that faces +z, in the current collection."""
    x, y = SETTINGS["half_size"]
    mesh = bpy.data.meshes.new(SETTINGS["name"])
    mesh.from_pydata([(-x, -y, 0.0), (x, -y, 0.0), (x, y, 0.0), (-x, y, 0.0)], [], [(0, 1, 2, 3)])
    coordinates = mesh.uv_layers.new(name="UVMap")
    for loop, point in zip(coordinates.data, ((0, 0), (1, 0), (1, 1), (0, 1)), strict=True):
        loop.uv = point
    mesh.materials.append(material())
    made = bpy.data.objects.new(SETTINGS["name"], mesh)
    bpy.context.collection.objects.link(made)
    return made


def _node(tree: bpy.types.NodeTree, kind: str, x: float, y: float) -> Any:
    node = tree.nodes.new(kind)
    node.location = (x, y)
    return node


def _picture(tree: bpy.types.NodeTree, name: str, row: int) -> Any:
    file, color_space = SETTINGS["pictures"][name]
    node = _node(tree, "ShaderNodeTexImage", -400, 300 - 300 * row)
    node.label = name
    node.extension = SETTINGS["extension"]
    node.image = bpy.data.images.load(str(_folder() / file), check_existing=True)
    node.image.colorspace_settings.name = color_space
    if bpy.data.filepath:
        node.image.filepath = bpy.path.relpath(node.image.filepath)
    return node.outputs["Color"]


def _folder() -> Path:
    """Where this script is, whether Blender runs it as a file or as a text of its editor."""
    text = bpy.data.texts.get(Path(__file__).name)
    if text is not None and text.filepath:
        return Path(bpy.path.abspath(text.filepath)).resolve().parent
    return Path(__file__).resolve().parent


if __name__ == "__main__":
    if bpy.app.version < (4, 0):
        raise SystemExit(f"This script needs Blender 4.0 or newer; this is {bpy.app.version_string}.")
    plane()
