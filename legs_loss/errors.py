"""The one exception that this package raises for a user's mistake."""

from __future__ import annotations

__all__ = ["LegsError"]


class LegsError(ValueError):
    """Bad input: the message says what was wrong, where, and what to do."""
