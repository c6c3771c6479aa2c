"""`compiled` and `inlined`: numba's njit as the package uses it; the lock that parallel calls take."""

from __future__ import annotations

import threading
from typing import Any, Callable

import numba

# No NaN or infinity arises from checked input. Sums keep their order, and a * b + c is rounded twice unless the code
# says otherwise: if the compiler may choose, the process that compiles and a later one that loads the cached code can
# differ in the last bit.
FAST = {"nnan", "ninf", "nsz"}


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function on its first call, and keep the machine code on disk where a cache can be written."""
    options = {"fastmath": FAST, "error_model": "numpy", **options}

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:  # neither the package's folder nor the user's can be written
            return numba.njit(**options)(function)

    return decorate


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function into its callers, with their settings."""
    return numba.njit(inline="always")(function)


# Of numba's three ways to run threads, one ends the process when two of Python's threads use it at a time.
ONE_AT_A_TIME = threading.Lock()
