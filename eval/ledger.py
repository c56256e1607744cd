"""What was scored already: one line of JSON per result, keyed by everything the result depends on.

Lines are only ever appended, so that an interrupted run loses what was being computed and nothing else.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class Ledger:
    """Results in a file."""

    def __init__(self, path: Path) -> None:
        """Read what is there. A line that is no result (the last one of a killed run) is passed over."""
        self.path = path
        self._found: dict[str, dict[str, Any]] = {}
        for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
            try:
                entry = json.loads(line)
                self._found[_text(entry["key"])] = entry["result"]
            except (ValueError, KeyError, TypeError):
                continue

    def find(self, key: Mapping[str, Any]) -> dict[str, Any] | None:
        """Return the result of this key, or None."""
        return self._found.get(_text(key))

    def add(self, key: Mapping[str, Any], result: dict[str, Any]) -> None:
        """Append a result to the file."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a+b") as file:
            if file.tell():
                file.seek(-1, 2)
                if file.read(1) != b"\n":
                    file.write(b"\n")  # ends a torn line
            file.write(json.dumps({"key": key, "result": result}, sort_keys=True).encode() + b"\n")
        self._found[_text(key)] = result


def _text(key: Mapping[str, Any]) -> str:
    return json.dumps(key, sort_keys=True)
