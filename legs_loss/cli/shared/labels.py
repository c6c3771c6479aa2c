"""Text on a picture: escape file names that matplotlib would typeset as mathematics, or cannot draw."""

from __future__ import annotations

from legs_loss.system import printable

__all__ = ["label"]


def label(name: str) -> str:
    r"""Return a name escaped for matplotlib, which draws it literally.

    >>> print(label("a$b\x07.png"))
    a\$b\x07.png
    """
    return printable(name, lines=True).replace("$", r"\$")
