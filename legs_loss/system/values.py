"""Check values of JSON: each function returns whether a value fits.

Python reads JSON's integers of any length, its truths as integers, and 1e999 as infinity.
"""

from __future__ import annotations

from math import isfinite
from typing import Any

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
