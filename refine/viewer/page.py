"""One self-contained page from the files beside this module; it may load nothing and send nothing.

Whatever comes from outside (names, paths, records) reaches the page as JSON in a block that is not run, and
the document only as text. The policy lets only this script and this style sheet in, by their digests.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from nets.render import PAPER
from refine.errors import UserError
from refine.export.source import result_names
from refine.viewer.material import describe_material

SCRIPTS = ("geometry.js", "renderer.js", "controls.js")
"""Parts of the one script, in order."""

SHADERS = ("material.vert", "material.frag", "surface.vert", "surface.frag")


def build_page(folders: Sequence[Path]) -> str:
    """Return the HTML of a viewer of all results in some folders.

    Raises:
        UserError: no folder is given, or a result in it cannot be read.
    """
    if not folders:
        raise UserError("No folder is given; name at least one that refine wrote.")
    materials = [describe_material(folder, stem) for folder in folders for stem in result_names(folder)]
    return assemble(materials)


def assemble(materials: Sequence[dict[str, Any]]) -> str:
    """Return the page of materials as `describe_material` returns them."""
    script = "\n".join(_text(name) for name in SCRIPTS)
    style = _text("style.css")
    shaders = {name: _text(name) for name in SHADERS}
    shaders["material.frag"] = shaders["material.frag"].replace("//CONVENTIONS", _conventions())
    names = ", ".join(material["name"] for material in materials)
    page = Template(_text("page.html")).substitute(
        policy=content_security_policy(script, style),
        title=html.escape(f"{names[:80]} - refine"),
        style=style,
        data=_json_block({"shaders": shaders, "materials": list(materials)}),
        script=script,
    )
    return page.encode("utf-8", "replace").decode("utf-8")  # names of files need not be valid text


def content_security_policy(script: str, style: str) -> str:
    """Return the policy under which nothing but this script and this style sheet has any effect."""
    return (
        f"default-src 'none'; script-src '{_digest(script)}'; style-src '{_digest(style)}'; "
        "base-uri 'none'; form-action 'none'"
    )


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")


def _conventions() -> str:
    """The floors of `nets.render`, for the shader."""
    floors = {name: value for name, value in asdict(PAPER).items() if isinstance(value, float)}
    return "\n".join(f"const float {name.upper()} = {value:.9e};" for name, value in floors.items())


def _json_block(data: Any) -> str:
    """JSON that cannot end the element it stands in."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _text(name: str) -> str:
    return (files("refine.viewer") / name).read_text(encoding="utf-8")
