"""Find the extensions of other packages: entry points, by group and name.

- ``legs_loss.commands``: sub-commands of ``legs``, each a module like those in legs_loss/cli.
- ``legs_loss.upstreams``: libraries that hold a loss, each a function that weights it (:func:`legs_loss.apply_to`).
"""

from __future__ import annotations

from typing import Any, Callable, Dict, Iterable


def plugins(group: str) -> Dict[str, Callable[[], Any]]:
    """Return the entry points of a group by name, as functions that import and return the object.

    >>> sorted(plugins("no.such.group"))
    []
    """
    return {point.name: point.load for point in _entry_points(group)}


def _entry_points(group: str) -> Iterable[Any]:
    try:
        from importlib import metadata
    except ImportError:  # Python 3.7
        try:
            import importlib_metadata as metadata  # type: ignore[no-redef]
        except ImportError:
            import pkg_resources

            return pkg_resources.iter_entry_points(group)
    found: Any = metadata.entry_points()
    return found.select(group=group) if hasattr(found, "select") else found.get(group, ())  # a dict before 3.10
