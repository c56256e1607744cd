"""Long runs that can be stopped: what they found so far, in a file that is replaced as a whole."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from refine.files import write_text_atomically

PROVENANCE = ("commit", "machine")


def read_progress(path: Path, format: str, *, seed: int) -> dict[str, Any] | None:
    """Return what an earlier run of the same seed left, or None if there is none.

    Raises:
        ValueError: the file is of something else, or of another seed.
    """
    if not path.is_file():
        return None
    content = json.loads(path.read_text(encoding="utf-8"))
    if content.pop("format", None) != format:
        raise ValueError(f"{path} is not a {format}; give another --out")
    if content.get("seed") != seed:
        raise ValueError(f"{path} is of seed {content.get('seed')}; give another --out or --seed")
    return {key: value for key, value in content.items() if key not in PROVENANCE}


def write_progress(path: Path, format: str, found: Mapping[str, Any], made_by: Mapping[str, str]) -> None:
    """Replace the file by what is found now.

    Raises:
        refine.errors.UserError: it cannot be written; what it was is kept.
    """
    content = {"format": format, **made_by, **found}
    write_text_atomically(path, json.dumps(content, indent=1, allow_nan=False) + "\n")
