"""ppisp, which FasterGS imports and by default does not use: it can be imported, and no more."""

from __future__ import annotations

import types

from legs_adapters.shims.inria.survey import Interface
from legs_adapters.shims.missing import complete

__all__ = ["module"]

REAL_FIRST = True


def module(name: str, interface: Interface) -> types.ModuleType:
    """Return ``ppisp`` with ``report``."""
    return complete(name, __doc__, complete(f"{name}.report", None, deferred=True), deferred=True)
