"""Pictures for game engines: the metallic workflow, several maps in the channels of one, height, tiles."""

from __future__ import annotations

import torch

from refine.export.bundle import Bundle, Picture, Source
from refine.export.height import height_from_normals, relief
from refine.export.shading import loss, metallic_roughness
from refine.export.tile import make_seamless
from refine.maps import MAP_NAMES


def orm(source: Source) -> Bundle:
    """Pack occlusion (1: none is known), roughness and metallic into red, green and blue, as for Unreal."""
    converted = metallic_roughness(source.svbrdf)
    roughness = source.svbrdf.roughness
    packed = torch.cat([torch.ones_like(roughness), roughness, converted.metallic], dim=1)
    files = {
        source.file("metallic_base_color"): Picture(converted.base_color, color=True),
        source.file("orm"): Picture(packed),
        **source.textures("normal", "normal_directx"),
    }
    return Bundle(files, {"loss": loss(source.svbrdf, converted.shown(source.svbrdf))})


def unity(source: Source) -> Bundle:
    """Pack metallic, occlusion, detail and smoothness into four channels, the mask map of Unity's HDRP."""
    converted = metallic_roughness(source.svbrdf)
    smoothness = 1.0 - source.svbrdf.roughness
    ones = torch.ones_like(smoothness)
    packed = torch.cat([converted.metallic, ones, torch.zeros_like(ones), smoothness], dim=1)
    files = {
        source.file("metallic_base_color"): Picture(converted.base_color, color=True),
        source.file("mask"): Picture(packed),
        **source.textures("normal"),
    }
    return Bundle(files, {"loss": loss(source.svbrdf, converted.shown(source.svbrdf))})


def height(source: Source) -> Bundle:
    """Integrate the normals; the notes say what 0 and 1 mean, in units in which the longer side is 2."""
    found = relief(height_from_normals(source.svbrdf.normal, repeats=source.repeats))
    pixels = torch.from_numpy(found.picture)[None, None]
    return Bundle(
        {source.file("height"): Picture(pixels)},
        {"low": found.low, "high": found.high, "unit": "half of the longer side"},
    )


def tile(source: Source) -> Bundle:
    """Write the four maps, seamless, encoded as `refine` does."""
    svbrdf = source.svbrdf if source.repeats else make_seamless(source.svbrdf)
    seamless = Source(svbrdf, f"{source.stem}_tile", source.format, repeats=True)
    rows, columns = svbrdf.size
    return Bundle(seamless.textures(*MAP_NAMES), {"width": columns, "height": rows})
