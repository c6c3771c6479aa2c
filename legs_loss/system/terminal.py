"""Print what may be printed: names and lines of a stranger's files can hold what a terminal obeys."""

from __future__ import annotations

import re
import sys
from typing import Optional, TextIO

__all__ = ["never_fail_to_print", "printable", "say", "say_error"]

# Control characters but tab and line feed; the marks that turn the direction of text, and halves of characters.
_OBEYED = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str, lines: bool = False) -> str:
    r"""Return a text with what a terminal would obey, and no file can hold, written as an escape.

    Args:
        text: what is to be printed.
        lines: it has several lines. Elsewhere a line feed is one of a name, which could pass for a line of a report.

    Example:
        >>> print(printable("train\x1b[2J\nall is well.py"))
        train\x1b[2J\nall is well.py
    """
    shown = _OBEYED.sub(lambda found: ascii(found.group())[1:-1], text)
    return shown if lines else shown.replace("\n", "\\n")


def never_fail_to_print() -> None:
    """Let the process print what its terminal's encoding lacks, as escapes: a name is no reason to end."""
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)  # what stands in for them in tests and notebooks has none
        if reconfigure is not None:
            reconfigure(errors="backslashreplace")


def say(text: object, stream: Optional[TextIO] = None, end: str = "\n", lines: bool = False) -> None:
    """Print to stdout, or another stream, what a terminal may be shown (:func:`printable`); at once."""
    print(printable(str(text), lines), file=stream, end=end, flush=True)


def say_error(command: str, error: Exception) -> None:
    """Print on stderr that a command ends with an error: its message on one line, then what it quotes, if anything."""
    message, *quoted = error.args or ("",)
    say(f"{command}: error: {message}", sys.stderr)
    for text in quoted:
        say(text, sys.stderr, lines=True)
