"""The exception for errors of the user, and proposals for mistyped names."""

from __future__ import annotations

import difflib
from typing import Iterable

__all__ = ["LegsError", "did_you_mean"]


class LegsError(ValueError):
    """Invalid input: the message says what is wrong, where, and what to do; further arguments are quoted lines."""

    def __str__(self) -> str:
        return "\n".join(map(str, self.args))


def did_you_mean(name: object, names: Iterable[str]) -> str:
    """Return the end of an error message that proposes the known name nearest to a mistyped one, "" if none is near.

    Examples:
        >>> did_you_mean("legz", ["3dgs", "eggs", "legs"]), did_you_mean("best", ["3dgs", "eggs", "legs"])
        ("; did you mean 'legs'?", '')
    """
    wanted = str(name).lower()
    known = {one.lower(): one for one in names}
    near = difflib.get_close_matches(wanted, [one for one in known if one != wanted], 1, 0.6)
    if wanted in known:  # in another case
        near = [wanted]
    return f"; did you mean {known[near[0]]!r}?" if near else ""
