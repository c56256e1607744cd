"""Which files are photos of a batch, and where their results go."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from refine.batch.plan import find_photos, plan
from refine.errors import UserError


def touch(folder: Path, *names: str) -> list[Path]:
    paths = [folder / name for name in names]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return paths


def test_a_folder_is_its_photos_in_order(tmp_path: Path) -> None:
    touch(tmp_path, "b.JPG", "a.png", "IMG.heic", "notes.txt", ".hidden.jpg", "._a.png", "deeper/c.png")
    (tmp_path / "folder.png").mkdir()
    assert find_photos([tmp_path]) == [tmp_path / name for name in ("IMG.heic", "a.png", "b.JPG")]


def test_no_photo_is_taken_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touch(tmp_path, "a.png", "b.png", "odd.name")
    monkeypatch.chdir(tmp_path)
    given = [Path("b.png"), tmp_path, Path("./odd.name"), tmp_path / "b.png"]
    assert find_photos(given) == [Path("b.png"), tmp_path / "a.png", Path("odd.name")]


def test_what_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"none.png does not exist"):
        find_photos([tmp_path / "none.png"])
    with pytest.raises(UserError, match=r"holds no photos"):
        find_photos([tmp_path])


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["wall.jpg", "floor.jpg"], ["wall", "floor"]),
        (["a.jpg", "a.png", "b.png"], ["a.jpg", "a.png", "b"]),
        (["A.jpg", "a.png"], ["A.jpg", "a.png"]),
        (["index.html.jpg", "batch.json.png"], ["index.html.jpg", "batch.json.png"]),
        (["x/a.jpg", "y/a.jpg", "y/b.jpg"], ["x_a.jpg", "y_a.jpg", "b"]),
        (["a.jpg", "a.png", "a.jpg.png"], ["p_a.jpg", "a.png", "a.jpg.png"]),
    ],
)
def test_every_photo_has_a_folder_of_its_own(names: list[str], expected: list[str], tmp_path: Path) -> None:
    photos = [tmp_path / "p" / name for name in names]
    jobs = plan(photos, tmp_path / "out")
    assert [job.name for job in jobs] == expected
    assert [job.folder for job in jobs] == [tmp_path / "out" / name for name in expected]
    assert [job.stem for job in jobs] == [photo.stem for photo in photos]


def test_photos_of_one_name_in_folders_of_one_name_are_told_apart(tmp_path: Path) -> None:
    photos = [tmp_path / top / "p" / "a.jpg" for top in ("x", "y")]
    jobs = plan(photos, tmp_path)
    assert len({job.name for job in jobs}) == 2
    assert [job.name for job in plan(photos[::-1], tmp_path)] == [job.name for job in jobs[::-1]]


def test_jobs_can_be_done_in_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (job,) = plan([Path("photos/a.jpg")], Path("out"))
    assert job.source == os.path.join("photos", "a.jpg")
    assert (job.photo, job.folder) == (tmp_path / "photos/a.jpg", tmp_path / "out/a")
