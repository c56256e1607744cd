"""Text from outside, made fit for one line of a terminal or a log."""

from __future__ import annotations

import json
from typing import Any


def printable(text: str) -> str:
    r"""Return text with everything that is not printable written as an escape: line ends, terminal codes.

    >>> printable("a\nb\x1b[2J.png")
    'a\\nb\\x1b[2J.png'
    """
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in text)


def parse_json(text: str | bytes) -> Any:
    """Return what JSON says.

    Raises:
        ValueError: it is no JSON, or nested so deeply that reading it would overflow the stack.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
