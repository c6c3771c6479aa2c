"""Absolute values and means, as functions and as methods of a tensor."""

from __future__ import annotations

from typing import NamedTuple, Optional, Tuple

import libcst as cst

from legs_adapters.code.syntax import call_name
from legs_adapters.tensors.operations import CONSTANTS


class AbsoluteValue(NamedTuple):
    """An absolute value: the call that takes it, what of, and "mean" where the mean is taken of it, else "none"."""

    call: cst.Call
    argument: cst.BaseExpression
    makes: str


def absolute_value(node: cst.Call) -> Optional[AbsoluteValue]:
    """Return the absolute value that a call takes, or takes the mean of; None for any other call."""
    averaged = _argument(node, "mean")  # over all axes
    call = averaged if isinstance(averaged, cst.Call) else node
    argument = abs_argument(call)
    return None if argument is None else AbsoluteValue(call, argument, "none" if call is node else "mean")


def sides_of(node: Optional[cst.CSTNode]) -> Optional[Tuple[cst.BaseExpression, cst.BaseExpression]]:
    """Return the two sides of a difference, ``a - b``, ``torch.sub(a, b)``, ``a.sub(b)``; None of anything else."""
    if isinstance(node, cst.BinaryOperation):
        return (node.left, node.right) if isinstance(node.operator, cst.Subtract) else None
    if not isinstance(node, cst.Call) or call_name(node) not in ("sub", "subtract"):
        return None
    owner = node.func.value if isinstance(node.func, cst.Attribute) else None
    sides = ([owner] if owner is not None and len(node.args) == 1 else []) + [arg.value for arg in node.args]
    is_plain = len(sides) == 2 and not any(arg.star or arg.keyword for arg in node.args)
    return (sides[0], sides[1]) if is_plain else None


def is_no_picture(node: cst.CSTNode) -> bool:
    """Return whether an expression is ``abs(a - b)``, or one value for every pixel: ``torch.zeros_like(a)``."""
    is_constant = isinstance(node, cst.Call) and call_name(node) in CONSTANTS
    return is_constant or sides_of(abs_argument(node)) is not None


def abs_argument(node: cst.CSTNode) -> Optional[cst.BaseExpression]:
    """Return the argument of an absolute value, ``abs(x)``, ``torch.abs(x)``, ``x.abs()``; None for any other node."""
    return _argument(node, "abs", "absolute", "abs_", "absolute_")


def _argument(node: cst.CSTNode, *names: str) -> Optional[cst.BaseExpression]:
    """Return the only argument of a function or method of these names; None for any other node."""
    if not isinstance(node, cst.Call) or call_name(node) not in names:
        return None
    owner = node.func.value if isinstance(node.func, cst.Attribute) else None
    if owner is not None and not node.args:
        return owner
    is_function = owner is None or _is_module(owner)
    return node.args[0].value if is_function and len(node.args) == 1 and not node.args[0].star else None


def _is_module(node: cst.CSTNode) -> bool:
    """Return whether the owner of ``abs`` or ``mean`` can be torch: a tensor's own methods take no tensor."""
    return isinstance(node, cst.Name) and node.value not in ("np", "numpy", "math", "jnp", "cp", "cupy", "tf")
