"""The viewer's page without a browser: what is in it, and what it may do."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nets.color import srgb_to_linear
from nets.render import PAPER
from nets.svbrdf import SVBRDF
from refine.errors import UserError
from refine.files import decode_image
from refine.maps import MAP_NAMES
from refine.shrinking import shrink, within
from refine.viewer import build_page
from refine.viewer.material import LONGEST_SIDE

from .conftest import HEIGHT, WIDTH, WriteResult

NASTY = "<img src=x onerror=alert(1)>"
NASTIER = "</script><script>alert(1)</script>.png"


class Page(HTMLParser):
    """Elements with their attributes and text."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None], list[str]]] = []
        self.inside = False
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs), []))
        self.inside = True

    def handle_endtag(self, tag: str) -> None:
        self.inside = False

    def handle_data(self, data: str) -> None:
        if self.inside:
            self.elements[-1][2].append(data)

    def texts(self, tag: str) -> list[str]:
        return ["".join(text) for name, _, text in self.elements if name == tag]

    @property
    def data(self) -> dict[str, Any]:
        return json.loads(self.texts("script")[0])

    @property
    def policy(self) -> str:
        (content,) = [
            a["content"] for _, a, _ in self.elements if a.get("http-equiv") == "Content-Security-Policy"
        ]
        assert content is not None
        return content


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory, write_result: WriteResult) -> str:
    folder = tmp_path_factory.mktemp("result")
    write_result(folder, "wall")
    return build_page([folder])


def picture(base64_png: str, folder: Path) -> np.ndarray:
    path = folder / "picture.png"
    path.write_bytes(base64.b64decode(base64_png))
    return np.rint(decode_image(path).pixels * 255.0)


def test_every_map_comes_through_with_sixteen_bits(page: str, svbrdf: SVBRDF, tmp_path: Path) -> None:
    (material,) = Page(page).data["materials"]
    assert (material["width"], material["height"]) == (WIDTH, HEIGHT)
    assert set(material["maps"]) == set(MAP_NAMES)
    for name in MAP_NAMES:
        halves = picture(material["maps"][name], tmp_path)
        stored = torch.from_numpy((halves[:HEIGHT] * 256 + halves[HEIGHT:]) / 65535.0).permute(2, 0, 1)[None]
        truth = getattr(svbrdf, name).double()
        if name == "normal":
            assert (stored * 2 - 1 - truth).abs().max() < 4 / 65535
        elif name == "roughness":
            assert (stored - truth).abs().max() < 1 / 65535
        else:
            assert (srgb_to_linear(stored) - truth).abs().max() < 3 / 65535


def test_only_its_own_script_and_style_have_any_effect(page: str) -> None:
    parsed = Page(page)
    _, script = parsed.texts("script")
    (style,) = parsed.texts("style")
    rules = dict(rule.strip().partition(" ")[::2] for rule in parsed.policy.split(";"))

    def digest(text: str) -> str:
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    assert rules == {
        "default-src": "'none'",
        "script-src": digest(script),
        "style-src": digest(style),
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    kinds = [attributes.get("type") for tag, attributes, _ in parsed.elements if tag == "script"]
    assert kinds == ["application/json", None]


def test_the_page_names_nothing_outside_itself(page: str) -> None:
    for _, attributes, _ in Page(page).elements:
        assert not {"src", "href", "srcset", "action", "style"} & set(attributes)
        assert not [name for name in attributes if name.startswith("on")]
    assert (
        re.findall(r"(?:https?:)?//[\w-]+\.\w+|@import|url\(|\bfetch\(|XMLHttpRequest|import\(", page) == []
    )
    script = Page(page).texts("script")[1]
    assert not re.search(
        r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function", script
    )


def test_every_element_the_script_asks_for_is_there(page: str) -> None:
    parsed = Page(page)
    asked = set(re.findall(r"\$\$\(\"([\w-]+)\"\)", parsed.texts("script")[1]))
    assert len(asked) > 15
    assert asked <= {attributes.get("id") for _, attributes, _ in parsed.elements}


def test_the_shader_has_the_renderers_floors_and_constants(page: str) -> None:
    shader = Page(page).data["shaders"]["material.frag"]
    floors = dict(re.findall(r"const float (\w+_FLOOR) = ([-\d.e]+);", shader))
    assert {name: float(value) for name, value in floors.items()} == pytest.approx(
        {
            "ROUGHNESS_FLOOR": PAPER.roughness_floor,
            "VISIBILITY_FLOOR": PAPER.visibility_floor,
            "DISTRIBUTION_FLOOR": PAPER.distribution_floor,
            "LENGTH_FLOOR": PAPER.length_floor,
        }
    )
    assert all(shader.count(name) > 1 for name in floors)
    assert "exp2((-5.55473 * vDotH - 6.98316) * vDotH)" in shader


def test_names_and_paths_are_never_markup(tmp_path: Path, write_result: WriteResult) -> None:
    write_result(tmp_path, NASTY, photo={"source": NASTIER, "sha256": None}, recipe={"name": NASTIER})
    text = build_page([tmp_path])
    parsed = Page(text)
    assert parsed.texts("title") == [f"{NASTY} - refine"]
    assert "img" not in [tag for tag, _, _ in parsed.elements]
    assert len(parsed.texts("script")) == 2
    (material,) = parsed.data["materials"]
    assert (material["name"], material["source"], material["recipe"]) == (NASTY, NASTIER, NASTIER)


def test_names_that_are_not_text_do_not_stop_it(tmp_path: Path, write_result: WriteResult) -> None:
    write_result(tmp_path, "wall", photo={"source": "wall\udcff.png", "sha256": None})
    assert build_page([tmp_path]).encode("utf-8")


def test_the_photo_is_shown_only_if_it_is_still_the_same(
    tmp_path: Path, write_result: WriteResult, photo_beside: tuple[Path, str]
) -> None:
    path, digest = photo_beside

    def shown(sha256: str | None) -> str | None:
        write_result(tmp_path / "out", "wall", photo={"source": str(path), "sha256": sha256})
        (material,) = Page(build_page([tmp_path / "out"])).data["materials"]
        return material["photo"]

    embedded = shown(digest)
    assert embedded is not None
    assert np.abs(picture(embedded, tmp_path) - np.rint(decode_image(path).pixels * 255)).max() <= 1
    assert shown("0" * 64) is None
    assert shown(None) is None
    path.unlink()
    assert shown(digest) is None


def test_several_folders_and_several_results_make_a_gallery(
    tmp_path: Path, write_result: WriteResult
) -> None:
    for folder, stem in (("one", "b"), ("one", "a"), ("two", "c")):
        write_result(tmp_path / folder, stem)
    page = Page(build_page([tmp_path / "two", tmp_path / "one"]))
    assert [material["name"] for material in page.data["materials"]] == ["c", "a", "b"]


def test_the_same_results_make_the_same_bytes(tmp_path: Path, write_result: WriteResult) -> None:
    write_result(tmp_path, "wall")
    assert build_page([tmp_path]) == build_page([tmp_path])


@pytest.mark.parametrize(
    "damage",
    [
        {"light": {"position": [0, 0, float("nan")], "intensity": [1, 1, 1], "falloff": "none"}},
        {"light": {"position": [0, 0], "intensity": [1, 1, 1], "falloff": "none"}},
        {"light": {"position": [0, 0, 1], "intensity": [1, 1, 1], "falloff": "cubic"}},
        {"light": None},
        {"camera": {"kind": "fisheye", "position": [0, 0, 1]}},
        {"rmse": {"initialization": float("inf"), "refined": 0.1}},
        {"photo": []},
    ],
)
def test_damaged_records_are_named(tmp_path: Path, write_result: WriteResult, damage: dict[str, Any]) -> None:
    write_result(tmp_path, "wall", **damage)
    with pytest.raises(UserError, match=r"wall\.json does not say how its photo was lit"):
        build_page([tmp_path])


def test_folders_without_results_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="There is no"):
        build_page([tmp_path])
    with pytest.raises(UserError, match="is not a folder"):
        build_page([tmp_path / "nowhere"])


def test_large_maps_are_averaged_to_legal_ones() -> None:
    height, width = 40, 2 * LONGEST_SIDE
    large = SVBRDF(
        normal=torch.tensor([0.6, 0.0, 0.8])[None, :, None, None].expand(1, 3, height, width),
        diffuse=torch.linspace(0, 1, width).expand(1, 3, height, width),
        roughness=torch.full((1, 1, height, width), 0.4),
        specular=torch.full((1, 3, height, width), 0.1),
    )
    shrunk = shrink(large, *within(large.size, LONGEST_SIDE))
    assert shrunk.size == (20, LONGEST_SIDE)
    assert (shrunk.normal - large.normal[..., :20, :LONGEST_SIDE]).abs().max() < 1e-6
    assert (shrunk.diffuse[0, 0, 0, 0] - 0.5 / (width - 1)).abs() < 1e-6
