"""The index without a browser: everything escaped, every link to a file, nothing from a network."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from refine.batch.index import build_index
from refine.batch.plan import Job, plan

NASTY = '<img src=x onerror="alert(1)">&\'#?%.jpg'


class Elements(HTMLParser):
    """Collects tags with their attributes, and the text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


def with_result(job: Job, *, report: bool = True, **rmse: Any) -> Job:
    kinds = ["rendering.png", "thumbnail.jpg", *(["report.png"] if report else [])]
    files = {kind.partition(".")[0]: f"{job.stem}_{kind}" for kind in kinds}
    record = {
        "maps": {"width": 64, "height": 40, "files": {**files, "json": f"{job.stem}.json"}},
        "rmse": {"initialization": 0.1, "refined": 0.02, **rmse},
    }
    job.folder.mkdir(parents=True)
    (job.folder / f"{job.stem}.json").write_text(json.dumps(record))
    for name in files.values():
        (job.folder / name).touch()
    return job


@pytest.fixture
def jobs(tmp_path: Path) -> list[Job]:
    return plan(
        [tmp_path / name for name in ("wall.jpg", "floor.jpg", "door.jpg", "roof.jpg")], tmp_path / "out"
    )


def test_what_is_done_is_shown_and_linked(jobs: list[Job]) -> None:
    wall, floor, door, _ = jobs
    with_result(wall)
    with_result(floor, report=False, refined=None)
    page = Elements(build_index(jobs, {wall: None, floor: None, door: "it is too dark"}))
    links = [attributes["href"] for tag, attributes in page.tags if tag == "a"]
    pictures = [attributes["src"] for tag, attributes in page.tags if tag == "img"]
    assert pictures == ["wall/wall_thumbnail.jpg", "floor/floor_thumbnail.jpg"]
    assert links == [
        "wall/wall_report.png", "wall/wall_report.png", "wall/wall_rendering.png", "wall/wall.json",
        "floor/floor_rendering.png", "floor/floor_rendering.png", "floor/floor.json",
    ]  # fmt: skip
    assert "0.1000 → 0.0200" in page.text
    assert "0.1000 → unknown" in page.text
    assert "2 done · 1 failed · 1 to do" in page.text
    assert "it is too dark" in page.text


def test_names_and_reasons_are_text(tmp_path: Path) -> None:
    done, failed = plan([tmp_path / NASTY, tmp_path / f"2{NASTY}"], tmp_path / "out")
    with_result(done)
    page = Elements(build_index([done, failed], {done: None, failed: NASTY}))
    plain = Elements(build_index([], {}))
    assert len([tag for tag, _ in page.tags if tag == "img"]) == 1
    assert {tag for tag, _ in page.tags} <= {tag for tag, _ in plain.tags} | {
        "a", "img", "article", "h2", "p", "nav", "section", "dl", "dt", "dd",
    }  # fmt: skip
    assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)
    assert page.text.count("onerror") >= 2
    links = [attributes["href"] or "" for tag, attributes in page.tags if tag == "a"]
    assert all(re.fullmatch(r"[\w%./-]+", link) for link in links)


def test_the_policy_lets_in_nothing_but_style_and_pictures(jobs: list[Job]) -> None:
    page = build_index(jobs, {})
    (policy,) = [a["content"] or "" for _, a in Elements(page).tags if a.get("http-equiv")]
    assert "default-src 'none'" in policy
    assert "script" not in policy
    assert "http" not in policy
    style = page.partition("<style>")[2].partition("</style>")[0]
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    assert f"'sha256-{digest}'" in policy
    assert "prefers-color-scheme: dark" in style
    assert "http" not in re.sub(r"http-equiv", "", page)


def test_an_empty_batch_says_so() -> None:
    assert "no photos" in build_index([], {})
