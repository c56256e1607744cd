"""Photos whose names would be markup or code, from the photo to every output: harmless, and whole.

`<script>alert(1)</script>.png` has a slash, so it is `script>.png` in a folder of the rest; what it is called
in records, pages and exports is all of it. The other name has whatever else ends a string somewhere.
"""

from __future__ import annotations

import ast
import json
import os
import shutil
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import av
import MaterialX as mx
import pygltflib
import pytest
from pxr import Sdf, Usd, UsdUtils

import refine.cli
from refine.export.targets import TARGETS
from refine.files import decode_image
from refine.maps import read_maps

SCRIPT = "<script>alert(1)</script>.png"
QUOTES = """"'--><img src=x onerror=alert(1)>${x}$%s\\{0}@#&?.png"""
PHOTOS = {"script": SCRIPT, "quotes": QUOTES}
QUICK = ("--resolution", "64", "--iters", "1", "--threads", "1", "--quiet")


@dataclass(frozen=True)
class Trace:
    """A photo that was refined.

    Attributes:
        source: as it was given.
        folder: of the result.
        checkpoint: a tiny network.
    """

    source: str
    folder: Path
    checkpoint: Path

    @property
    def stem(self) -> str:
        """What the result's files begin with."""
        return Path(self.source).stem

    @property
    def exported(self) -> str:
        """The same for other programs, some of which take a backslash for a slash."""
        return self.stem.replace("\\", "_")


@pytest.fixture(scope="module", params=PHOTOS.values(), ids=PHOTOS)
def trace(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, photo: Path, checkpoint: Path
) -> Trace:
    """Refine and export a photo of a bad name, from the folder that it is in."""
    here = tmp_path_factory.mktemp("here")
    source = here / request.param
    source.parent.mkdir(exist_ok=True)
    shutil.copy(photo, source)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        common = ("--init", str(checkpoint), *QUICK, "--out", "out")
        assert refine.cli.run([request.param, *common, "--export", ",".join(TARGETS)]) == 0
    return Trace(request.param, here / "out", checkpoint)


class Page(HTMLParser):
    """The elements of a page with their attributes, and what is told to no parser: the text of scripts."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def tags(self) -> list[str]:
        """Return the names of its elements, in order."""
        return [tag for tag, _ in self.elements]

    def require_harmless(self) -> None:
        """Assert that no element does anything by itself, but the page's own script."""
        assert not {"iframe", "object", "embed", "base"} & set(self.tags())
        for tag, attributes in self.elements:
            assert not any(name.startswith("on") for name in attributes), (tag, attributes)
            for name in ("src", "href"):
                assert not (attributes.get(name) or "").lower().startswith(("javascript:", "http"))
        policies = [a["content"] for tag, a in self.elements if a.get("http-equiv")]
        assert len(policies) == 1
        assert "default-src 'none'" in (policies[0] or "")
        assert "unsafe" not in (policies[0] or "")


def innocent(trace: Trace, folder: Path) -> Path:
    """Copy a result to a name that needs no care."""
    folder.mkdir()
    for path in trace.folder.glob("*.*"):
        shutil.copy(path, folder / path.name.replace(trace.stem, "wall"))
    record = (trace.folder / f"{trace.stem}.json").read_text(encoding="utf-8")
    plain = record.replace(json.dumps(trace.source)[1:-1], "wall.png")
    (folder / "wall.json").write_text(plain.replace(json.dumps(trace.stem)[1:-1], "wall"), encoding="utf-8")
    return folder


def test_the_result_is_whole_and_says_the_name_as_data(trace: Trace) -> None:
    record = json.loads((trace.folder / f"{trace.stem}.json").read_text(encoding="utf-8"))
    assert record["photo"]["source"] == trace.source
    expected = {*record["maps"]["files"].values(), "export"}
    assert set(os.listdir(trace.folder)) == expected
    assert all(name == "export" or name.startswith(trace.stem) for name in expected)
    read_maps(trace.folder, trace.stem).validate()
    assert min(decode_image(trace.folder / f"{trace.stem}_report.png").size) > 100


def test_pages_of_the_viewer_are_those_of_an_innocent_name(trace: Trace, tmp_path: Path) -> None:
    """Alone and as a gallery: the same elements, whatever the name."""
    plain = innocent(trace, tmp_path / "plain")
    pages = {}
    for name, folders in {"bad": [trace.folder], "good": [plain], "gallery": [trace.folder, plain]}.items():
        path = tmp_path / f"{name}.html"
        assert refine.cli.run(["view", *map(str, folders), "--html", str(path), "--quiet"]) == 0
        pages[name] = Page(path)
        pages[name].require_harmless()
    assert pages["bad"].tags() == pages["good"].tags() == pages["gallery"].tags()
    assert pages["bad"].tags().count("script") == 2
    assert trace.stem in pages["bad"].text  # of the title


def test_the_index_of_a_batch_links_to_files_that_are_there(trace: Trace, tmp_path: Path) -> None:
    photos = trace.folder.parent
    (photos / "broken<b>.png").write_text("no picture")
    given = [str(photos / trace.source), str(photos / "broken<b>.png")]
    options = ("--init", str(trace.checkpoint), *QUICK, "--out", str(tmp_path / "mats"), "--workers", "1")
    assert refine.cli.run([*given, *options]) == 3
    page = Page(tmp_path / "mats" / "index.html")
    page.require_harmless()
    assert not {"script", "b"} & set(page.tags())
    assert page.tags().count("img") == 1
    addresses = [a.get("href") or a.get("src") for tag, a in page.elements if tag in ("a", "img")]
    assert len(addresses) == 5
    for address in addresses:
        assert address is not None
        assert (tmp_path / "mats" / unquote(address)).is_file()
    assert trace.stem in page.text
    assert "broken<b>.png" in page.text


def pictures(trace: Trace) -> set[str]:
    return {path.name for path in (trace.folder / "export").iterdir() if path.suffix == ".png"}


def test_all_files_of_all_targets_are_there(trace: Trace) -> None:
    folder = trace.folder / "export"
    record = json.loads((folder / f"{trace.stem}_export.json").read_text(encoding="utf-8"))
    assert record["of"] == {"name": trace.stem, "photo": trace.source}
    named = {file for target in record["targets"].values() for file in target["files"]}
    assert record["targets"].keys() == TARGETS.keys()
    assert named | {f"{trace.stem}_export.json"} == set(os.listdir(folder))


def test_materialx_is_one_sound_document(trace: Trace) -> None:
    path = trace.folder / "export" / f"{trace.exported}.mtlx"
    files = {e.get("value") for e in ElementTree.parse(path).iter("input") if e.get("type") == "filename"}
    document = mx.createDocument()
    mx.readFromXmlFile(document, str(path))
    assert document.validate()[0]
    assert len(document.getMaterialNodes()) == 2
    assert files <= pictures(trace)
    assert len(files) == 5


def test_gltf_keeps_the_name_as_text(trace: Trace) -> None:
    document = pygltflib.GLTF2().load(trace.folder / "export" / f"{trace.exported}.glb")
    assert document is not None
    assert [node.name for node in document.nodes] == [trace.exported]
    assert [material.name for material in document.materials] == [trace.exported]
    assert [image.uri for image in document.images] == [None] * 4  # inside


def test_usd_opens_and_finds_its_pictures(trace: Trace) -> None:
    path = trace.folder / "export" / f"{trace.exported}.usda"
    stage = Usd.Stage.Open(Sdf.Layer.FindOrOpen(str(path)))
    root = stage.GetDefaultPrim()
    assert Sdf.Path.IsValidIdentifier(root.GetName())
    assert root.GetDisplayName() == trace.exported
    assert [prim.GetName() for prim in root.GetChildren()] == ["Surface", "Material"]
    inputs = [prim.GetAttribute("inputs:file") for prim in stage.Traverse()]
    resolved = {Path(each.Get().resolvedPath).name for each in inputs if each}
    assert len(resolved) == 4
    assert resolved <= pictures(trace)
    _, files, missing = UsdUtils.ComputeAllDependencies(str(path))
    assert missing == []
    assert len(files) == 4


def test_the_blender_script_has_the_name_as_a_literal(trace: Trace) -> None:
    path = trace.folder / "export" / f"{trace.exported}_blender.py"
    module = ast.parse(path.read_text(encoding="utf-8"))
    (given,) = [
        node.value
        for node in module.body
        if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == "SETTINGS"
    ]
    settings = ast.literal_eval(given)  # raises on anything that is not data
    assert settings["name"] == trace.exported
    assert {file for file, _ in settings["pictures"].values()} <= pictures(trace)
    template = Path(refine.cli.__file__).with_name("export") / "blender_script.py"
    kinds = [type(node) for node in ast.parse(template.read_text(encoding="utf-8")).body]
    assert [type(node) for node in module.body] == kinds


@pytest.mark.parametrize("extension", ["mp4", "gif", "webp"])
def test_videos_are_written_under_the_name(trace: Trace, extension: str, tmp_path: Path) -> None:
    path = tmp_path / f"{trace.stem}.{extension}"
    quick = ("--seconds", "0.2", "--fps", "10", "--size", "32", "--quiet")
    assert refine.cli.run(["video", str(trace.folder), "--to", str(path), *quick]) == 0
    assert os.listdir(tmp_path) == [path.name]
    if extension == "webp":
        assert path.read_bytes()[8:12] == b"WEBP"
        return
    with path.open("rb") as file, av.open(file) as video:
        assert len(list(video.decode(video=0))) == 2
