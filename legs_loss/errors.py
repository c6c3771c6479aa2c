"""The exception for errors of the user, and proposals for mistyped names."""

from __future__ import annotations

import difflib
import importlib
from typing import Iterable


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
    near = difflib.get_close_matches(wanted, known, 1, 0.6)
    return f"; did you mean {known[near[0]]!r}?" if near else ""


def require(what: str, extra: str, *packages: str) -> None:
    """Check that the packages of an extra can be imported.

    Raises:
        LegsError: the first that cannot, and how to install it: by its name, or all of the extra from a checkout.
    """
    for package in packages:
        try:
            importlib.import_module(package)
        except ImportError:
            how = f"pip install {package}, or, in the checkout of legs-loss, pip install '.[{extra}]'"
            raise LegsError(f"{what} needs {package}: {how}") from None
