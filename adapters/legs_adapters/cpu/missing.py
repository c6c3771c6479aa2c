"""The one error for what has no stand-in on the CPU."""

from __future__ import annotations

from typing import Any

from legs_loss import LegsError

__all__ = ["MissingStandIn", "attribute_guard"]


class MissingStandIn(LegsError, ImportError):
    """A CUDA feature that cannot be had on the CPU; the message names its module and function.

    It is an ImportError too, so that a script that only tries whether a module has something goes on without it.
    """

    def __init__(self, module: str, function: str, reason: str = "") -> None:
        what = f"{module}.{function}" if function else module
        super().__init__(f"{what} has no stand-in on the CPU" + (f": {reason}" if reason else ""))


def attribute_guard(module: str) -> Any:
    """Return a module's ``__getattr__``: what it lacks is a `MissingStandIn` that names it."""

    def __getattr__(name: str) -> Any:
        if name.startswith("__") and name.endswith("__"):
            raise AttributeError(name)
        raise MissingStandIn(module, name)

    return __getattr__
