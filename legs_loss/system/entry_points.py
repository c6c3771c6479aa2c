"""Find the extensions of other packages: entry points, by group and name.

- ``legs_loss.commands``: sub-commands of ``legs``, each a module like those in legs_loss/cli.
- ``legs_loss.upstreams``: libraries that hold a loss, each a function that weights it (:func:`legs_loss.apply_to`).
"""

from __future__ import annotations

import sys
from typing import Any, Callable, Dict


def plugins(group: str) -> Dict[str, Callable[[], Any]]:
    """Return the entry points of a group by name, as functions that import and return the object.

    >>> sorted(plugins("no.such.group"))
    []
    """
    if sys.version_info < (3, 8):
        import pkg_resources

        points: Any = pkg_resources.iter_entry_points(group)
    else:
        from importlib import metadata

        found: Any = metadata.entry_points()
        points = found.select(group=group) if hasattr(found, "select") else found.get(group, ())  # a dict before 3.10
    return {point.name: point.load for point in points}
