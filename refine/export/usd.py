"""USD: UsdPreviewSurface in its specular workflow, on a plane of the material's shape.

Its diffuse is `diffuseColor (1 - F)`, colour by colour, and its lobe is ours but for how Fresnel's blend is
written: nothing is converted, and nothing is lost.
"""

from __future__ import annotations

from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from refine.export.bundle import TEXTURES, Bundle, Source

_INPUTS = {
    "diffuseColor": "diffuse",
    "specularColor": "specular",
    "roughness": "roughness",
    "normal": "normal",
}
_TYPES = {"roughness": Sdf.ValueTypeNames.Float, "normal": Sdf.ValueTypeNames.Normal3f}
_NORMAL_SCALE, _NORMAL_BIAS = Gf.Vec4f(2.0, 2.0, 2.0, 1.0), Gf.Vec4f(-1.0, -1.0, -1.0, 0.0)


def usd(source: Source) -> Bundle:
    """Return the layer, as text, and its pictures."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, f"/{Tf.MakeValidIdentifier(source.identifier)}")
    root.GetPrim().SetDisplayName(source.stem)
    stage.SetDefaultPrim(root.GetPrim())
    mesh = _plane(stage, root.GetPath().AppendChild("Surface"), *source.half_size)
    material = _material(stage, root.GetPath().AppendChild("Material"), source)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    text = stage.GetRootLayer().ExportToString()
    return Bundle({f"{source.stem}.usda": text, **source.textures(*_INPUTS.values())})


def _plane(stage: Usd.Stage, path: Sdf.Path, x: float, y: float) -> UsdGeom.Mesh:
    """Define a plane that faces +z; its texture coordinates have (0, 0) at the lower left, USD's way."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    corners = Vt.Vec3fArray([Gf.Vec3f(*point, 0.0) for point in ((-x, -y), (x, -y), (x, y), (-x, y))])
    mesh.CreatePointsAttr(corners)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray([4]))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray([0, 1, 2, 3]))
    mesh.CreateExtentAttr(Vt.Vec3fArray([corners[0], corners[2]]))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateNormalsAttr(Vt.Vec3fArray(4, Gf.Vec3f(0.0, 0.0, 1.0)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    coordinates = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
    )
    coordinates.Set(Vt.Vec2fArray([Gf.Vec2f(*point) for point in ((0, 0), (1, 0), (1, 1), (0, 1))]))
    return mesh


def _material(stage: Usd.Stage, path: Sdf.Path, source: Source) -> UsdShade.Material:
    material = UsdShade.Material.Define(stage, path)
    surface = UsdShade.Shader.Define(stage, path.AppendChild("Surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("useSpecularWorkflow", Sdf.ValueTypeNames.Int).Set(1)
    reader = UsdShade.Shader.Define(stage, path.AppendChild("TextureCoordinates"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    coordinates = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    for name, picture in _INPUTS.items():
        texture = _texture(stage, path.AppendChild(picture.capitalize()), source, picture)
        texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
        scalar = name == "roughness"
        output = texture.CreateOutput(
            "r" if scalar else "rgb", Sdf.ValueTypeNames.Float if scalar else Sdf.ValueTypeNames.Float3
        )
        kind = _TYPES.get(name, Sdf.ValueTypeNames.Color3f)
        surface.CreateInput(name, kind).ConnectToSource(output)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material


def _texture(stage: Usd.Stage, path: Sdf.Path, source: Source, name: str) -> UsdShade.Shader:
    texture = UsdShade.Shader.Define(stage, path)
    texture.CreateIdAttr("UsdUVTexture")
    encoded = TEXTURES[name].color and not source.format.linear
    wrap = "repeat" if source.repeats else "clamp"
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(f"./{source.file(name)}"))
    texture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB" if encoded else "raw")
    for direction in ("wrapS", "wrapT"):
        texture.CreateInput(direction, Sdf.ValueTypeNames.Token).Set(wrap)
    if name == "normal":
        texture.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(_NORMAL_SCALE)
        texture.CreateInput("bias", Sdf.ValueTypeNames.Float4).Set(_NORMAL_BIAS)
    return texture
