"""Absolute values and means, as functions and as methods of a tensor."""

from __future__ import annotations

import ast
from typing import NamedTuple, Optional, Tuple

from legs_adapters.code.syntax import arguments, call_name, given
from legs_adapters.tensors.operations import CONSTANTS


class AbsoluteValue(NamedTuple):
    """An absolute value: the call that takes it, what of, and "mean" where the mean is taken of it, else "none"."""

    call: ast.Call
    argument: ast.expr
    makes: str


def absolute_value(node: ast.Call) -> Optional[AbsoluteValue]:
    """Return the absolute value that a call takes, or takes the mean of; None for any other call."""
    averaged = _argument(node, "mean")  # over all axes
    call = averaged if isinstance(averaged, ast.Call) else node
    argument = abs_argument(call)
    return None if argument is None else AbsoluteValue(call, argument, "none" if call is node else "mean")


def sides_of(node: Optional[ast.AST]) -> Optional[Tuple[ast.expr, ast.expr]]:
    """Return the two sides of a difference, ``a - b``, ``torch.sub(a, b)``, ``a.sub(b)``; None of anything else."""
    if isinstance(node, ast.BinOp):
        return (node.left, node.right) if isinstance(node.op, ast.Sub) else None
    if not isinstance(node, ast.Call) or call_name(node) not in ("sub", "subtract"):
        return None
    owner = node.func.value if isinstance(node.func, ast.Attribute) else None
    sides, keywords, is_starred = arguments(node)
    sides = [owner, *sides] if owner is not None and len(sides) == 1 else sides
    return (sides[0], sides[1]) if len(sides) == 2 and not keywords and not is_starred else None


def is_no_picture(node: ast.AST) -> bool:
    """Return whether an expression is ``abs(a - b)``, or one value for every pixel: ``torch.zeros_like(a)``."""
    is_constant = isinstance(node, ast.Call) and call_name(node) in CONSTANTS
    return is_constant or sides_of(abs_argument(node)) is not None


def abs_argument(node: ast.AST) -> Optional[ast.expr]:
    """Return the argument of an absolute value, ``abs(x)``, ``torch.abs(x)``, ``x.abs()``; None for any other node."""
    return _argument(node, "abs", "absolute", "abs_", "absolute_")


def _argument(node: ast.AST, *names: str) -> Optional[ast.expr]:
    """Return the only argument of a function or method of these names; None for any other node."""
    if not isinstance(node, ast.Call) or call_name(node) not in names:
        return None
    owner = node.func.value if isinstance(node.func, ast.Attribute) else None
    args = given(node)
    if owner is not None and not args:
        return owner
    is_function = owner is None or _is_module(owner)
    return args[0].value if is_function and len(args) == 1 and not args[0].star else None


def _is_module(node: ast.AST) -> bool:
    """Return whether the owner of ``abs`` or ``mean`` can be torch: a tensor's own methods take no tensor."""
    return isinstance(node, ast.Name) and node.id not in ("np", "numpy", "math", "jnp", "cp", "cupy", "tf")
