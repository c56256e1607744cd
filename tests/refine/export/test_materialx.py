"""MaterialX documents, read, validated and turned into shaders by MaterialX itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from nets.svbrdf import SVBRDF
from refine.export.bundle import Source
from refine.export.shading import split_specular
from refine.maps import MapFormat

mx = pytest.importorskip("MaterialX", reason="needs the extra [export]")

from refine.export.materialx import materialx  # noqa: E402


@pytest.fixture(scope="module")
def library() -> Any:
    """Return MaterialX's own node definitions."""
    found = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), found)
    return found


def read(source: Source, library: Any) -> Any:
    document = mx.createDocument()
    mx.readFromXmlString(document, materialx(source).files[f"{source.stem}.mtlx"])
    document.setDataLibrary(library)
    return document


def graph_of(document: Any) -> Any:
    """Return the one node graph that is not the library's."""
    (graph,) = (graph for graph in document.getNodeGraphs() if graph.getNode("specular_tint"))
    return graph


def files(document: Any) -> dict[str, Any]:
    graph = graph_of(document)
    return {node.getName(): node.getInput("file") for node in graph.getNodes("image")}


def test_the_document_is_valid(source: Source, library: Any) -> None:
    document = read(source, library)
    valid, message = document.validate()
    assert valid, message
    assert {node.getCategory() for node in document.getNodes() if node.getType() == "surfaceshader"} == {
        "standard_surface",
        "open_pbr_surface",
    }
    assert len(document.getMaterialNodes()) == 2


def test_pictures_are_there_and_tagged(source: Source, library: Any) -> None:
    bundle, images = materialx(source), files(read(source, library))
    assert {image.getValueString() for image in images.values()} == set(bundle.files) - {
        f"{source.stem}.mtlx"
    }
    spaces = {name: image.getColorSpace() for name, image in images.items()}
    assert (spaces["base_color"], spaces["specular_tint"]) == ("srgb_texture", "srgb_texture")
    assert {spaces[name] for name in ("roughness", "specular_level", "normal")} == {""}
    linear = files(read(replace(source, format=MapFormat("exr", 16)), library))
    assert linear["base_color"].getColorSpace() == "lin_rec709"
    assert linear["base_color"].getValueString().endswith(".exr")


def test_the_graph_computes_the_index_of_refraction(material: SVBRDF, source: Source, library: Any) -> None:
    """Its nodes, evaluated here one by one, invert F0 = ((n - 1) / (n + 1))^2."""
    document = read(source, library)
    graph = graph_of(document)
    level = 0.3
    operations = {
        "multiply": lambda a, b: a * b,
        "sqrt": lambda a: a**0.5,
        "add": lambda a, b: a + b,
        "subtract": lambda a, b: a - b,
        "divide": lambda a, b: a / b,
    }

    def evaluate(node: Any) -> float:
        if node.getCategory() == "image":
            assert node.getName() == "specular_level"
            return level
        arguments = [
            evaluate(each.getConnectedNode()) if each.getConnectedNode() else each.getValue()
            for each in node.getInputs()
        ]
        return float(operations[node.getCategory()](*arguments))

    ior = evaluate(graph.getNode(graph.getOutput("ior_out").getNodeName()))
    peak = split_specular(material.specular).peak
    assert ((ior - 1.0) / (ior + 1.0)) ** 2 == pytest.approx(level * peak, rel=1e-5)


def test_shaders_are_generated(source: Source, library: Any) -> None:
    """Both materials become GLSL that samples all their pictures."""
    shading = pytest.importorskip("MaterialX.PyMaterialXGenGlsl")
    generation = pytest.importorskip("MaterialX.PyMaterialXGenShader")
    document = read(source, library)
    generator = shading.GlslShaderGenerator.create()
    generator.registerTypeDefs(document)
    context = generation.GenContext(generator)
    context.registerSourceCodeSearchPath(mx.getDefaultDataSearchPath())
    for material in document.getMaterialNodes():
        (surface,) = mx.getShaderNodes(material)
        text = generator.generate("shader", surface, context).getSourceCode(generation.PIXEL_STAGE)
        for name in files(document):
            assert f"{name}_file" in text
