"""Weight the loss of an installed library, for training code without a checkout to patch."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from typing import Any, Dict

from legs_loss.errors import LegsError
from legs_loss.system.entry_points import plugins

_applied: Dict[str, Applied] = {}


class Applied(ExitStack):
    """Replaced functions of a library; `undo`, or the end of a ``with`` block, restores them."""

    def replace(self, owner: Any, name: str, new: Any) -> None:
        """Set an attribute of a module or class, and in every module that imported the old value by name."""
        old = getattr(owner, name)
        places = [(owner, name)]
        if not isinstance(owner, type):
            modules = (module for module in list(sys.modules.values()) if module is not owner)
            held = ((module, dict(getattr(module, "__dict__", {}))) for module in modules)
            places += [(module, key) for module, names in held for key, value in names.items() if value is old]
        for place, key in places:
            self.callback(setattr, place, key, old)
            setattr(place, key, new)

    def undo(self) -> None:
        """Restore everything; a second call does nothing."""
        self.close()


def apply_to(library: str) -> Applied:
    """Weight the photometric L1 of a library, in this process; ``legs_loss.apply_to_gsplat()`` is the same.

    Settings come from legs.toml and LEGS_* variables, or from :func:`legs_loss.configure`. Applied a second time it
    changes nothing and returns the same object.

    Args:
        library: "gsplat" (``gsplat.losses.l1_loss``) or "nerfstudio" (splatfacto's ``get_loss_dict``), and what other
            packages register in the entry point group ``legs_loss.upstreams``.

    Returns:
        The replaced functions: ``.undo()``, or the end of a ``with`` block, restores them.

    Raises:
        LegsError: no such library is known, it is not installed, or it does not have the expected loss.

    Examples:
        >>> apply_to("no_such_library")
        Traceback (most recent call last):
        ...
        legs_loss.errors.LegsError: unknown library 'no_such_library'; known are ...
    """
    known = plugins("legs_loss.upstreams")
    if not isinstance(library, str) or library not in known:
        raise LegsError(f"unknown library {library!r}; known are {', '.join(sorted(known)) or 'none'}")
    if library in _applied:
        return _applied[library]
    applied = Applied()
    try:
        known[library]()(applied)
    except (ModuleNotFoundError, AttributeError) as error:
        missing = (error.name or "") if isinstance(error, ModuleNotFoundError) else f"{library}."
        if missing == library:
            raise LegsError(f"{library} is not installed") from None
        if not missing.startswith(f"{library}."):
            raise
        raise LegsError(f"this {library} does not have the expected loss: {error}") from None
    _applied[library] = applied
    applied.callback(_applied.pop, library, None)
    return applied
