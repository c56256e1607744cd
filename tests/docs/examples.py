"""The examples of a page of the documentation: code blocks, and what the comment above each says of its test.

<!-- run with
runs/pool => tiny_pool
-->            the test replaces the text on the left by that on the right, wherever the example has it
<!-- not run: takes a GPU -->            the test leaves the example out, for this reason
"""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

_EXAMPLE = re.compile(
    r"^(?:<!-- (?P<verb>run with|not run:)(?P<said>.*?)-->\n)?"
    r"^```(?P<language>sh|python)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Example:
    """A code block.

    Attributes:
        language: `sh` or `python`.
        text: to run, replacements made.
        left_out: why it is not run; None if it is.
    """

    language: str
    text: str
    left_out: str | None = None


def read_examples(page: str) -> list[Example]:
    """Return a page's examples in order.

    Raises:
        ValueError: a comment without a reason, or a replacement of what the example does not have.
    """
    examples = []
    for found in _EXAMPLE.finditer(page):
        language, text, said = found["language"], found["text"], (found["said"] or "").strip()
        if found["verb"] is not None and not said:
            raise ValueError(f"the comment above {text!r} says nothing")
        if found["verb"] == "not run:":
            examples.append(Example(language, text, left_out=said))
            continue
        examples.append(Example(language, _replace(text, said.splitlines())))
    return examples


def _replace(text: str, lines: list[str]) -> str:
    """Replace in one pass, and where several may begin, the longest."""
    replacements = dict(line.split(" => ") for line in lines)
    if stale := [old for old in replacements if old not in text]:
        raise ValueError(f"{stale[0]!r} is to be replaced, but is not in {text!r}")
    longest_first = sorted(map(re.escape, replacements), key=len, reverse=True)
    return re.sub("|".join(longest_first), lambda found: replacements[found[0]], text) if lines else text


def commands(text: str) -> list[list[str]]:
    """Return the words of every command of a shell example, comments dropped."""
    lines = text.replace("\\\n", " ").splitlines()
    split = [shlex.split(part, comments=True) for line in lines for part in line.split("&&")]
    return [words for words in split if words]


def spoken_commands(page: str) -> list[list[str]]:
    """Return the commands that a page has in its text, between single backquotes."""
    prose = re.sub(r"^```.*?^```", "", page, flags=re.MULTILINE | re.DOTALL)
    return [words for code in re.findall(r"`([^`]+)`", prose) for words in commands(" ".join(code.split()))]
