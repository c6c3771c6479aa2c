"""Check values of JSON: each function returns whether a value fits, or such a function.

Python reads JSON's integers of any length, its truths as integers, and 1e999 as infinity.
"""

from __future__ import annotations

from math import isfinite
from typing import Any, Callable

Fits = Callable[[Any], bool]
_LARGEST = 1 << 63


def is_number(value: Any) -> bool:
    """Return whether it is a number of at most 64 bits before the point, or a float that is infinite or NaN."""
    return type(value) in (int, float) and (abs(value) < _LARGEST or (type(value) is float and not isfinite(value)))


def is_count(value: Any) -> bool:
    """Return whether it is an integer of 64 bits, at least 0."""
    return type(value) is int and 0 <= value < _LARGEST


def is_text(value: Any) -> bool:
    """Return whether it is a text that can be a file's name."""
    return type(value) is str and "\0" not in value


def is_pair(value: Any) -> bool:
    """Return whether it is a list of two counts."""
    return each(is_count)(value) and len(value) == 2


def is_scores(value: Any) -> bool:
    """Return whether it has numbers by name."""
    return of_names(is_number)(value)


def optional(fits: Fits) -> Fits:
    """Accept None, too."""
    return lambda value: value is None or fits(value)


def each(fits: Fits) -> Fits:
    """Accept lists of what fits."""
    return lambda value: type(value) is list and all(map(fits, value))


def of_names(fits: Fits) -> Fits:
    """Accept objects whose values fit."""
    return lambda value: type(value) is dict and all(is_text(name) and fits(one) for name, one in value.items())


def with_names(fits: Fits, *names: str) -> Fits:
    """Accept what fits and has these names."""
    return lambda value: fits(value) and all(name in value for name in names)
