"""`python -m eval.benchmarks.reliability`: `docs/reliability.md` from what the long runs measured.

What is promised is text, in `docs/results/reliability/template.md`. Figures stand there as `{fuzz.corpus}`;
they are taken from the JSON of the runs beside it, `fuzz.json` and so on.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from refine.files import write_text_atomically

DOCS = Path("docs")


def figures(folder: Path) -> dict[str, str]:
    """Return every figure of every run, as text, by `run.name`."""
    found: dict[str, str] = {}
    for path in sorted(folder.glob("*.json")):
        for name, value in _derived(json.loads(path.read_text(encoding="utf-8"))).items():
            found[f"{path.stem}.{name}"] = _text(value)
    return found


def _derived(content: Mapping[str, Any]) -> dict[str, Any]:
    """Flatten a run's record, with the lengths of its lists and the middles of its samples."""
    flat: dict[str, Any] = {}
    for name, value in content.items():
        if isinstance(value, dict):
            flat[f"{name}.count"] = len(value)
            flat |= {f"{name}.{inner}": each for inner, each in _derived(value).items()}
        elif isinstance(value, list):
            flat[f"{name}.count"] = len(value)
            if value and all(isinstance(each, int | float) for each in value):
                ordered = sorted(value)
                flat[f"{name}.median"] = ordered[len(ordered) // 2]
                flat[f"{name}.largest"] = ordered[-1]
        else:
            flat[name] = value
    return flat


def _text(value: Any) -> str:
    if isinstance(value, float) and value and abs(value) < 0.01:
        return f"{value:.1e}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def fill(text: str, known: Mapping[str, str]) -> str:
    """Return text with every `{run.name}` replaced by its figure.

    Paragraphs that begin with `{?run}` are of a run that is there, those with `{!run}` of one that is not.

    Raises:
        KeyError: there is no such figure.
    """
    runs = {name.partition(".")[0] for name in known}
    kept = []
    for paragraph in text.split("\n\n"):
        condition = re.match(r"\{([?!])(\w+)\}", paragraph)
        if condition is None or (condition[1] == "?") == (condition[2] in runs):
            kept.append(paragraph[condition.end() :].lstrip() if condition else paragraph)
    return re.sub(r"\{([a-z_]+\.[\w. -]+)\}", lambda match: known[match[1]], "\n\n".join(kept))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; with `--check`, return 1 if the page is not what the runs say."""
    parser = argparse.ArgumentParser(prog="python -m eval.benchmarks.reliability", description=__doc__)
    parser.add_argument("--docs", type=Path, default=DOCS)
    parser.add_argument("--check", action="store_true", help="compare only")
    options = parser.parse_args(arguments)
    runs = options.docs / "results" / "reliability"
    page = fill((runs / "template.md").read_text(encoding="utf-8"), figures(runs))
    path = options.docs / "reliability.md"
    if options.check:
        return int(path.read_text(encoding="utf-8") != page)
    write_text_atomically(path, page)
    return 0


if __name__ == "__main__":
    sys.exit(main())
