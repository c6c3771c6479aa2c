"""Weight the loss that a library holds, for training code that has no checkout to patch."""

from __future__ import annotations

import sys
from typing import Any, Dict, List, Tuple

from legs_loss.errors import LegsError
from legs_loss.system import plugins

__all__ = ["Applied", "apply_to"]

_applied: Dict[str, Applied] = {}


class Applied:
    """Functions of a library that were replaced; `undo` puts them back, as leaving a ``with`` block does."""

    def __init__(self) -> None:
        self._replaced: List[Tuple[Any, str, Any]] = []

    def replace(self, owner: Any, name: str, new: Any) -> None:
        """Set an attribute of a module or class, and in every module that imported the old one by name."""
        old = getattr(owner, name)
        places = [(owner, name)]
        if not isinstance(owner, type):
            modules = (module for module in list(sys.modules.values()) if module is not owner)
            held = ((module, dict(getattr(module, "__dict__", {}))) for module in modules)
            places += [(module, key) for module, names in held for key, value in names.items() if value is old]
        for place, key in places:
            self._replaced.append((place, key, old))
            setattr(place, key, new)

    def undo(self) -> None:
        """Put everything back; a second time there is nothing to do."""
        while self._replaced:
            setattr(*self._replaced.pop())
        for name in [name for name, applied in _applied.items() if applied is self]:
            del _applied[name]

    def __enter__(self) -> Applied:
        return self

    def __exit__(self, *_: Any) -> None:
        self.undo()


def apply_to(library: str) -> Applied:
    """Weight the photometric L1 that a library holds, in this process; ``legs_loss.apply_to_gsplat()`` is the same.

    Settings come from legs.toml and LEGS_* variables, or from :func:`legs_loss.configure`. Applied a second time it
    changes nothing and returns the same object.

    Args:
        library: "gsplat" (``gsplat.losses.l1_loss``) or "nerfstudio" (splatfacto's ``get_loss_dict``), and what other
            packages register in the entry point group ``legs_loss.upstreams``.

    Returns:
        What was replaced: ``.undo()``, or leaving it as a ``with`` block, puts it back.

    Raises:
        LegsError: no such library is known, it is not installed, or it does not hold the loss that is expected.

    Example:
        >>> apply_to("no_such_library")
        Traceback (most recent call last):
        ...
        legs_loss.errors.LegsError: nothing is known of 'no_such_library'; known are ...
    """
    if library in _applied:
        return _applied[library]
    known = plugins("legs_loss.upstreams")
    if library not in known:
        raise LegsError(f"nothing is known of {library!r}; known are {', '.join(sorted(known)) or 'none'}")
    applied = Applied()
    try:
        known[library]()(applied)
    except ModuleNotFoundError as error:
        if error.name == library:
            raise LegsError(f"{library} is not installed") from None
        if not (error.name or "").startswith(f"{library}."):
            raise
        raise LegsError(f"this {library} does not hold the loss that is expected: {error}") from None
    except AttributeError as error:
        raise LegsError(f"this {library} does not hold the loss that is expected: {error}") from None
    _applied[library] = applied
    return applied
