"""The one exception that this package raises for a user's mistake, and what helps its messages."""

from __future__ import annotations

from difflib import get_close_matches
from typing import Iterable

__all__ = ["LegsError", "did_you_mean"]


class LegsError(ValueError):
    """Bad input: the message says what was wrong, where, and what to do."""


def did_you_mean(word: object, known: Iterable[str]) -> str:
    """Return `` (did you mean 'legs'?)`` where a known word is near, for a message about a mistyped one; else nothing.

    >>> did_you_mean("legz", ["3dgs", "legs"])
    " (did you mean 'legs'?)"
    >>> did_you_mean("best", ["3dgs", "legs"])
    ''
    """
    near = get_close_matches(str(word), list(known), n=1, cutoff=0.7)
    return f" (did you mean {near[0]!r}?)" if near else ""
