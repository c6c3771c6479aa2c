"""What may be printed: names and lines of a stranger's files can hold what a terminal obeys."""

from __future__ import annotations

import re

__all__ = ["printable"]

# Control characters but tab and line feed, the marks that turn the direction of text, and halves of characters.
_OBEYED = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    r"""Return a text with what a terminal would obey, and no file can hold, written as an escape.

    Example:
        >>> print(printable("train\x1b[2J.py\n"), end="")
        train\x1b[2J.py
    """
    return _OBEYED.sub(lambda found: ascii(found.group())[1:-1], text)
