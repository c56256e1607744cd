"""Blender: a script that builds the material, which is `blender_script.py` with its settings filled in.

The Principled BSDF lays a lobe with a white edge over a diffuse that gets what the lobe's strongest colour
lets through: `layered_base_color`. Its F0 is that of the index of refraction, times twice the level, times
the tint.
"""

from __future__ import annotations

from importlib.resources import files
from pprint import pformat

from refine.export.bundle import TEXTURES, Bundle, Source
from refine.export.shading import from_layered, layered_base_color, loss, split_specular

PICTURES = ("base_color", "specular_tint", "roughness", "specular_level", "normal")

_PLACEHOLDER = "SETTINGS: dict[str, Any] = {}\n"


def blender(source: Source) -> Bundle:
    """Return the script and its pictures."""
    split = split_specular(source.svbrdf.specular)
    settings = {
        "name": source.stem,
        "ior": split.ior,
        "half_size": source.half_size,
        "extension": "REPEAT" if source.repeats else "EXTEND",
        "pictures": {name: (source.file(name), _color_space(source, name)) for name in PICTURES},
    }
    template = files("refine.export").joinpath("blender_script.py").read_text(encoding="utf-8")
    if _PLACEHOLDER not in template:
        raise RuntimeError("the Blender script has no place for its settings")
    filled = f"SETTINGS: dict[str, Any] = {pformat(settings, sort_dicts=False, width=100)}\n"
    shown = from_layered(source.svbrdf, layered_base_color(source.svbrdf))
    return Bundle(
        {
            f"{source.stem}_blender.py": template.replace(_PLACEHOLDER, filled),
            **source.textures(*PICTURES),
        },
        {"ior": split.ior, "loss": loss(source.svbrdf, shown)},
    )


def _color_space(source: Source, name: str) -> str:
    """Name a colour space as Blender does."""
    if not TEXTURES[name].color:
        return "Non-Color"
    return "Linear Rec.709" if source.format.linear else "sRGB"
