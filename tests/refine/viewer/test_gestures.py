"""What a mouse and fingers do to the picture, sent to headless Chromium as its own input."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from refine.viewer import build_page

from .conftest import HEIGHT, WIDTH, WriteResult
from .devtools import Tab, needs_browser, open_tab

pytestmark = needs_browser

MARGIN = 2.0
"""Pixels by which an edge may be elsewhere: it is filtered."""


@dataclass
class Stage:
    """The page's part with the surface, in pixels of the tab."""

    tab: Tab
    left: int
    top: int
    width: int
    height: int

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Return a place of the tab from one of the stage, both coordinates in [0, 1]."""
        return self.left + x * self.width, self.top + y * self.height

    def picture(self) -> np.ndarray:  # float [h, w, 3]
        """Return what the stage shows."""
        return self.tab.shot()[self.top : self.top + self.height, self.left : self.left + self.width]

    def edges(self) -> np.ndarray:  # float [4]
        """Return the surface's left, top, right and bottom edge, in pixels of the tab."""
        picture = self.picture()
        surface = np.abs(picture - picture[0, 0]).max(axis=2) > 1.0
        columns, rows = np.flatnonzero(surface.any(axis=0)), np.flatnonzero(surface.any(axis=1))
        edges = [columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]
        return np.asarray(edges, np.float32) + np.tile([self.left, self.top], 2)


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with open_tab(tmp_path_factory.mktemp("browser")) as tab:
        yield tab


@pytest.fixture
def stage(tab: Tab, tmp_path: Path, write_result: WriteResult) -> Stage:
    """Return a fresh page with the light above the middle, seen from straight above."""
    light = {"position": [0.0, 0.0, 0.6], "intensity": [1.0, 1.0, 1.0], "falloff": "inverse_square"}
    camera = {"kind": "orthographic", "position": [0.0, 0.0, 1.0]}
    write_result(tmp_path, "wall", light=light, camera=camera)
    page = tmp_path / "page.html"
    page.write_text(build_page([tmp_path]), encoding="utf-8")
    tab.open(page.as_uri())
    box = tab.value("(({x, y, width, height}) => [x, y, width, height])(stage.getBoundingClientRect())")
    return Stage(tab, *map(round, box))


def halves(picture: np.ndarray) -> tuple[float, float]:
    """Return the mean of the left and of the right half."""
    middle = picture.shape[1] // 2
    return float(picture[:, :middle].mean()), float(picture[:, middle:].mean())


def test_a_page_opens_with_the_surface_as_large_as_fits_and_in_the_middle(stage: Stage) -> None:
    left, top, right, bottom = stage.edges()
    assert (right - left) / (bottom - top) == pytest.approx(WIDTH / HEIGHT, abs=0.02)
    assert max((right - left) / stage.width, (bottom - top) / stage.height) > 0.9
    assert [(left + right) / 2, (top + bottom) / 2] == pytest.approx(list(stage.at(0.5, 0.5)), abs=MARGIN)


@pytest.mark.parametrize("pointer", ["mouse", "finger"])
def test_dragging_moves_the_light(pointer: str, stage: Stage) -> None:
    tab, before = stage.tab, stage.picture()
    way = [stage.at(0.5 + 0.05 * step, 0.5) for step in range(8)]
    if pointer == "mouse":
        tab.mouse("mouseMoved", *way[0])
        assert np.array_equal(stage.picture(), before)  # nothing is pressed
        tab.mouse("mousePressed", *way[0], button="left", buttons=1, clickCount=1)
        for x, y in way:
            tab.mouse("mouseMoved", x, y, button="left", buttons=1)
        tab.mouse("mouseReleased", *way[-1], button="left", clickCount=1)
    else:
        tab.touch("touchStart", way[0])
        for place in way:
            tab.touch("touchMove", place)
        tab.touch("touchEnd")
    after = stage.picture()
    assert np.array_equal(after[0, 0], before[0, 0])  # the ring is for those who came by keys
    (left_before, right_before), (left_after, right_after) = halves(before), halves(after)
    assert left_after < left_before - 5.0
    assert right_after > right_before - 5.0
    assert right_after - left_after > right_before - left_before + 20.0
    tab.mouse("mouseMoved", *stage.at(0.2, 0.2))
    assert np.array_equal(stage.picture(), after)  # nor is it any more
    marker = tab.value(
        "(({x, y, width}) => [x + width / 2, y + width / 2])($$('light').getBoundingClientRect())"
    )
    assert marker == pytest.approx(list(way[-1]), abs=MARGIN)


def test_the_wheel_zooms_about_the_pointer(stage: Stage) -> None:
    before, pointer = stage.edges(), stage.at(0.3, 0.4)
    for _ in range(2):
        stage.tab.mouse("mouseWheel", *pointer, deltaX=0, deltaY=200)
    fixed = np.tile(pointer, 2)
    assert stage.edges() == pytest.approx(fixed + (before - fixed) * np.exp(-0.6), abs=MARGIN)
    for _ in range(2):
        stage.tab.mouse("mouseWheel", *pointer, deltaX=0, deltaY=-200)
    assert stage.edges() == pytest.approx(before, abs=MARGIN)


def test_two_fingers_zoom_and_move(stage: Stage) -> None:
    before, tab = stage.edges(), stage.tab
    (x, y), apart, shift = stage.at(0.5, 0.5), 200.0, 30.0
    tab.touch("touchStart", (x - apart / 2, y))
    tab.touch("touchStart", (x - apart / 2, y), (x + apart / 2, y))
    for step in range(1, 11):
        half, moved = apart / 2 * (1 - 0.05 * step), shift * step / 10
        tab.touch("touchMove", (x - half, y + moved), (x + half, y + moved))
    tab.touch("touchEnd")
    middle = np.tile([x, y], 2)
    assert stage.edges() == pytest.approx(middle + (before - middle) * 0.5 + [0, shift, 0, shift], abs=MARGIN)


def test_the_divider_begins_in_the_middle_and_follows_the_pointer(
    tab: Tab, photo_beside: tuple[Path, str], tmp_path: Path, write_result: WriteResult
) -> None:
    path, digest = photo_beside
    write_result(tmp_path, "wall", photo={"source": path.name, "sha256": digest})
    page = tmp_path / "page.html"
    page.write_text(build_page([tmp_path]), encoding="utf-8")
    tab.open(f"{page.as_uri()}#compare=photo")
    box = tab.value("(({x, y, width, height}) => [x, y, width, height])(stage.getBoundingClientRect())")
    stage = Stage(tab, *map(round, box))
    middle = tab.value("$$('divider').getBoundingClientRect().x + 16")
    assert middle == pytest.approx(stage.at(0.5, 0.5)[0], abs=1.0)
    before = stage.picture()
    tab.mouse("mousePressed", *stage.at(0.5, 0.5), button="left", buttons=1, clickCount=1)
    for share in (0.45, 0.35, 0.25):
        tab.mouse("mouseMoved", *stage.at(share, 0.5), button="left", buttons=1)
    tab.mouse("mouseReleased", *stage.at(0.25, 0.5), button="left", clickCount=1)
    after = stage.picture()
    assert tab.value("$$('divider').getBoundingClientRect().x + 16") == pytest.approx(
        stage.at(0.25, 0)[0], abs=1
    )
    changed = np.abs(after - before).max(axis=2) > 8.0
    columns = changed[stage.height * 5 // 8 : stage.height * 6 // 8].mean(axis=0)
    quarter, half = stage.width // 4, stage.width // 2
    assert columns[quarter + 20 : half - 20].mean() > 0.5  # what was photo is rendering
    assert columns[: quarter - 20].max() == 0.0
    assert columns[half + 20 :].max() == 0.0
