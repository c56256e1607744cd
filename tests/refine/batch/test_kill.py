"""After a kill at any moment of writing, a record stands only beside files of its own run."""

from __future__ import annotations

from pathlib import Path

import pytest

import refine.files
from refine.files import write_together


@pytest.mark.parametrize("moment", range(4))
def test_the_last_file_stands_for_all(moment: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [tmp_path / name for name in ("normal.png", "diffuse.png", "record.json")]

    def write(text: str) -> None:
        with write_together(paths) as temporaries:
            for temporary in temporaries:
                temporary.write_text(text)

    def contents() -> list[str | None]:
        return [path.read_text() if path.exists() else None for path in paths]

    write("old")
    seen: list[list[str | None]] = []
    replace = refine.files.os.replace

    def watched(source: Path, target: Path) -> None:
        seen.append(contents())
        replace(source, target)

    monkeypatch.setattr(refine.files.os, "replace", watched)
    write("new")
    seen.append(contents())
    found = seen[moment]
    assert found[-1] is None or len(set(found)) == 1, found
    assert found[-1] == ("new" if moment == 3 else None)
