"""What every table has in common: scores, settings, where they come from, Markdown, plain data for JSON."""

from __future__ import annotations

import math
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch

Scored = TypeVar("Scored")


@dataclass
class Results(Generic[Scored]):
    """Everything a table is made of.

    Attributes:
        scored: dataclasses, the evidence: one entry per method and scene, or per photo.
        skipped: name of an unreadable scene to the reason.
        settings: of the run, as printed in the caption and saved.
    """

    scored: list[Scored] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)

    def rows(self) -> list[dict[str, Any]]:
        """Return the table's rows."""
        raise NotImplementedError

    def as_json(self) -> dict[str, Any]:
        """Return settings, table rows, every score and the skipped scenes as plain data; NaN is None."""
        content = {
            "settings": self.settings,
            "rows": self.rows(),
            "scenes": [asdict(entry) for entry in self.scored],  # type: ignore[call-overload]
            "skipped": self.skipped,
        }
        return {key: plain(value) for key, value in content.items()}


def provenance() -> dict[str, str]:
    """Return the commit and the kind of machine that figures were made with."""
    here = Path(__file__).parent
    try:
        git = subprocess.run(
            ["git", "rev-parse", "--short=10", "HEAD"], cwd=here, capture_output=True, text=True, check=True
        )
        commit = git.stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = "unknown"
    machine = f"{platform.machine()}, {torch.get_num_threads()} threads, torch {torch.__version__}"
    return {"commit": commit, "machine": machine}


def origin(settings: Mapping[str, Any]) -> str:
    """Return the end of a caption: what `provenance` put into the settings."""
    return f"commit {settings.get('commit', '?')}; {settings.get('machine', '?')}"


def number(value: float | None, digits: int) -> str:
    """Return a number as a table's cell; a dash for none and NaN."""
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[str]], texts: int) -> list[str]:
    """Return the lines of a Markdown table whose first `texts` columns are text, the others numbers."""
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * texts + "---:|" * (len(heads) - texts)]
    return lines + [f"| {' | '.join(cells)} |" for cells in rows]


def skipped_lines(skipped: Mapping[str, str]) -> list[str]:
    """Return the list of scenes that were left out, and why, as lines that follow a table."""
    if not skipped:
        return []
    return ["", "Skipped:", "", *(f"- {name}: {reason}" for name, reason in skipped.items())]


def plain(value: Any) -> Any:
    """Return plain data with None in place of NaN, which JSON has not."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value
