"""Text from outside, made fit for one line of a terminal or a log."""

from __future__ import annotations


def printable(text: str) -> str:
    r"""Return text with everything that is not printable written as an escape: line ends, terminal codes.

    >>> printable("a\nb\x1b[2J.png")
    'a\\nb\\x1b[2J.png'
    """
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in text)
