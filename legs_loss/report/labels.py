"""Text on a picture: names of a stranger's files hold what matplotlib would set as mathematics, or cannot draw."""

from __future__ import annotations

from legs_loss.system import printable

__all__ = ["label"]


def label(name: str) -> str:
    r"""Return a name as matplotlib is to draw it, letter by letter.

    >>> print(label("a$b\x07.png"))
    a\$b\x07.png
    """
    return printable(name, lines=True).replace("$", r"\$")
