"""A stand-in for a checkout's imports while a function is evaluated, and the ways in which that can end."""

from __future__ import annotations

from typing import Any, Callable

import libcst as cst

from legs_adapters.code.module import Function

__all__ = ["Library", "Raised", "Unknown", "Unsupported"]


class Unknown(Exception):
    """An evaluation met what it cannot evaluate.

    Attributes:
        function, node: where.
    """

    def __init__(self, function: Function, node: cst.CSTNode) -> None:
        super().__init__("not followed")
        self.function = function
        self.node = node


class Unsupported(Exception):
    """A library cannot answer."""


class Raised(Exception):
    """The code that is evaluated raises an error there."""


class Library:
    """A stand-in for the libraries that a checkout imports, and for the values that they make."""

    def external(self, name: str) -> Any:
        """Return a function or a constant of a library, or a builtin, by its dotted name."""
        raise Unsupported(name)

    def attribute(self, value: Any, name: str) -> Any:
        """Return an attribute or a method of a value of the library."""
        raise Unsupported(name)

    def operate(self, function: Callable[[Any, Any], Any], left: Any, right: Any) -> Any:
        """Return what an operator makes of two values, of which at least one is the library's."""
        raise Unsupported("an operator")

    def index(self, value: Any, key: Any) -> Any:
        """Return ``value[key]``."""
        raise Unsupported("an index")
