"""Folders of PBR textures (ambientCG, Poly Haven, cgbookcase, Substance, Blender bakes) to `SVBRDF`.

Finds each map by the end of its file name, and turns metallic or specular workflows into diffuse + F0.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from nets.color import srgb_to_linear
from nets.data.images import (
    ROUGHNESS_FLOOR,
    DataError,
    decode_normal,
    grey,
    read_image,
    resize,
    rgb,
    to_tensor,
    unit_normal,
)
from nets.svbrdf import SVBRDF

DIELECTRIC_F0 = 0.04
"""Reflectance at normal incidence of a common dielectric (index of refraction 1.5)."""

SPECULAR_LEVEL_F0 = 0.08
"""F0 of a Blender / Disney "specular" (IOR level) of one."""

ROLES: dict[str, tuple[str, ...]] = {
    "basecolor": ("basecolor", "basecolour", "albedo", "diffuse", "color", "colour", "diff", "col", "bc"),
    "normal": (
        *("normalgl", "normalopengl", "norgl", "nrmgl", "normal", "nor", "nrm", "norm", "normals"),
        *("normaldx", "normaldirectx", "nordx", "nrmdx"),
    ),
    "roughness": ("roughness", "rough", "rgh"),
    "glossiness": ("glossiness", "gloss", "smoothness"),
    "metallic": ("metallic", "metalness", "metallness", "mtl", "metal"),
    "specular": ("specular", "spec"),
    "height": ("height", "displacement", "disp", "bump"),
}
"""Ends of file names, lower case without separators, per map; earlier ones are preferred."""

SUFFIXES = (".exr", ".tif", ".tiff", ".png", ".tga", ".jpg", ".jpeg")
"""File types looked at; of two files of one map the earlier type is preferred (more bits)."""

_DECORATION = re.compile(r"\d+k|\d+x\d+|jpe?g|png|exr|tiff?|tga|8bit|16bit|2048|4096|1024|512")
_WORD = re.compile(r"\d+[kK](?![a-z])|[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


@dataclass(frozen=True)
class _Match:
    path: Path
    prefix: str
    name: str
    rank: tuple[int, int]


def find_maps(folder: Path) -> dict[str, Path]:
    """Find the maps of one material by the ends of its file names.

    Args:
        folder: holds the images directly; files that match nothing (previews, occlusion) are ignored.

    Returns:
        File per role, a subset of `ROLES`.

    Raises:
        DataError: the folder does not exist, or one role has files of more than one material.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"{folder} is not a folder")
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    matches: dict[str, list[_Match]] = {role: [] for role in ROLES}
    for path in files:
        found = _match(path)
        if found is not None:
            matches[found[0]].append(found[1])
    prefixes = {match.prefix for match in matches["basecolor"]}
    # `_metal` is Poly Haven's metalness, but `brushed_metal.png` is a preview: trust it beside a base colour.
    matches["metallic"] = [m for m in matches["metallic"] if m.name != "metal" or m.prefix in prefixes]

    chosen = {}
    for role, candidates in matches.items():
        if not candidates:
            continue
        best = min(candidates, key=lambda match: match.rank)
        rivals = {m.prefix for m in candidates if m.name == best.name}
        if len(rivals) > 1:
            raise DataError(f"{folder} holds more than one {role}: {', '.join(sorted(rivals))}")
        chosen[role] = best.path
    return chosen


def read_pbr_folder(
    path: Path,
    *,
    size: int | None = None,
    normal_convention: Literal["opengl", "directx"] = "opengl",
    normal_gamma: Literal["linear", "srgb"] = "linear",
    specular_workflow: Literal["ior_level", "f0"] = "ior_level",
) -> SVBRDF:
    """Read a folder of textures as one material.

    Base colour is decoded from sRGB (taken as linear in floating-point files); all other maps are linear
    data. Roughness is perceptual, as ours (alpha is its square); glossiness is one minus it.
    With metallic m, diffuse = base (1 - m) and F0 = dielectric F0 (1 - m) + base m.
    Maps of other sizes are resized to the base colour's.

    Args:
        path: the folder; see `find_maps`.
        size: pixels of the longer side to resize to; None keeps the base colour's size.
        normal_convention: green of normal maps whose name does not say it: up (`opengl`) or down.
            A name with `gl` or `dx` (`NormalDX`, `nor_dx`) overrules it.
        normal_gamma: `srgb` repairs normal maps that a converter encoded as if they were colours
            (a flat surface then reads 188 instead of 128).
        specular_workflow: what a file named specular holds: Blender's IOR level, so that the dielectric F0 is
            0.08 times its value, or (`f0`, of specular/glossiness materials) F0 itself, in sRGB.

    Returns:
        A batch of one, legal.

    Raises:
        DataError: base colour, normal, or both roughness and glossiness are missing; an image is damaged;
            the specular workflow `f0` lacks a specular file or meets a metallic one.
    """
    folder = Path(path)
    files = find_maps(folder)
    _require(folder, files, ("basecolor",))
    _require(folder, files, ("normal",))
    _require(folder, files, ("roughness", "glossiness"))

    base, linear = _read(files["basecolor"])
    base = rgb(base) if linear else srgb_to_linear(rgb(base))
    base = base.clamp(0.0, 1.0)
    height, width = base.shape[-2:]
    if size is not None:
        factor = size / max(height, width)
        height, width = max(1, round(height * factor)), max(1, round(width * factor))
        base = resize(base, height, width)

    def data(role: str) -> Float[Tensor, "1 channels h w"] | None:
        return resize(_read(files[role])[0].clamp(0.0, 1.0), height, width) if role in files else None

    roughness, glossiness, metallic = data("roughness"), data("glossiness"), data("metallic")
    if roughness is None:
        assert glossiness is not None
        roughness = 1.0 - glossiness
    diffuse, specular = _reflectances(
        folder, base, None if metallic is None else grey(metallic), data("specular"), specular_workflow
    )
    return SVBRDF(
        normal=_read_normal(files["normal"], height, width, normal_convention, normal_gamma),
        diffuse=diffuse.clamp(0.0, 1.0),
        roughness=grey(roughness).clamp(ROUGHNESS_FLOOR, 1.0),
        specular=specular.clamp(0.0, 1.0),
    )


def _reflectances(
    folder: Path,
    base: Float[Tensor, "1 3 h w"],
    metallic: Float[Tensor, "1 1 h w"] | None,
    specular: Float[Tensor, "1 channels h w"] | None,
    workflow: Literal["ior_level", "f0"],
) -> tuple[Float[Tensor, "1 3 h w"], Float[Tensor, "1 3 h w"]]:
    """Return diffuse albedo and F0, both linear, of a metallic or specular workflow."""
    if workflow == "f0":
        if specular is None:
            raise DataError(f"{folder} holds no specular map, which the f0 workflow needs")
        if metallic is not None:
            raise DataError(f"{folder} holds a metallic map, which the f0 workflow does not have")
        return base, srgb_to_linear(rgb(specular))
    dielectric = torch.tensor(DIELECTRIC_F0) if specular is None else SPECULAR_LEVEL_F0 * grey(specular)
    if metallic is None:
        return base, dielectric.expand_as(base).clone()
    return base * (1.0 - metallic), dielectric * (1.0 - metallic) + base * metallic


def _read_normal(
    path: Path,
    height: int,
    width: int,
    convention: Literal["opengl", "directx"],
    gamma: Literal["linear", "srgb"],
) -> Float[Tensor, "1 3 h w"]:
    match = _match(path)
    assert match is not None
    name = match[1].name
    if name.endswith(("dx", "directx")):
        convention = "directx"
    elif name.endswith(("gl", "opengl")):
        convention = "opengl"
    encoded, _ = _read(path)
    if encoded.shape[1] != 3:
        raise DataError(f"{path} is a normal map with a single channel")
    if gamma == "srgb":
        encoded = srgb_to_linear(encoded)
    return unit_normal(resize(decode_normal(encoded, flip_green=convention == "directx"), height, width))


def _read(path: Path) -> tuple[Float[Tensor, "1 channels h w"], bool]:
    pixels, is_float = read_image(path)
    return to_tensor(pixels), is_float


def _require(folder: Path, files: Iterable[str], roles: tuple[str, ...]) -> None:
    if not set(roles) & set(files):
        raise DataError(f"{folder} holds no {' or '.join(roles)} map")


def _match(path: Path) -> tuple[str, _Match] | None:
    """Return the role the end of a file name tells, if any: `Wood049_2K-JPG_NormalGL.jpg` is a normal."""
    words = [word.lower() for word in _WORD.findall(path.stem)]
    while words and _DECORATION.fullmatch(words[-1]):
        words.pop()
    for count in (3, 2, 1):
        if count > len(words):
            continue
        name = "".join(words[-count:])
        for role, names in ROLES.items():
            if name in names:
                rank = (names.index(name), SUFFIXES.index(path.suffix.lower()))
                return role, _Match(path, "_".join(words[:-count]), name, rank)
    return None
