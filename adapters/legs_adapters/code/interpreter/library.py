"""The replacement of a checkout's imports in an evaluation, and the exceptions that end one."""

from __future__ import annotations

from typing import Any, Callable

import libcst as cst

from legs_adapters.code.module import Function

__all__ = ["Library", "Raised", "Unknown", "Unsupported"]


class Unknown(Exception):
    """The evaluation reached a node that it does not support.

    Attributes:
        function, node: where.
    """

    def __init__(self, function: Function, node: cst.CSTNode) -> None:
        super().__init__("not followed")
        self.function = function
        self.node = node


class Unsupported(Exception):
    """The library does not support an operation."""


class Raised(Exception):
    """The code that is evaluated raises an error there."""


class Library:
    """The replacement of the libraries that a checkout imports, and of their values."""

    def external(self, name: str) -> Any:
        """Return a function or a constant of a library, or a builtin, by its dotted name."""
        raise Unsupported(name)

    def attribute(self, value: Any, name: str) -> Any:
        """Return an attribute or a method of a value of the library."""
        raise Unsupported(name)

    def operate(self, function: Callable[[Any, Any], Any], left: Any, right: Any) -> Any:
        """Return the result of an operator on two values, at least one of them the library's."""
        raise Unsupported("an operator")

    def index(self, value: Any, key: Any) -> Any:
        """Return ``value[key]``."""
        raise Unsupported("an index")
