"""Check values of JSON, lists and objects of them: each function returns whether a value fits, or such a function."""

from __future__ import annotations

from typing import Any, Callable

from legs_loss.system.values import is_count, is_number, is_text

Fits = Callable[[Any], bool]


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
