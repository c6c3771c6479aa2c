"""Where gradients are cut: ``torch.no_grad()`` and its like around an expression, ``detach()`` in it."""

from __future__ import annotations

from typing import Optional

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import attribute_chain, call_name, constant, walk_expressions

__all__ = ["detaches", "is_detached", "is_without_grad", "under_no_grad"]

_NO_GRAD = {"no_grad", "inference_mode", "set_grad_enabled"}


def under_no_grad(function: Function, node: cst.CSTNode) -> bool:
    """Return whether a node stands in a ``with torch.no_grad():`` of its function."""
    return any(map(_stops_gradients, function.flow.contexts.get(id(node), ())))


def is_without_grad(function: Function, *nodes: cst.CSTNode) -> bool:
    """Return whether expressions stand where no gradient is kept: in a block, or by a decorator of a function."""
    scope: Optional[Function] = function
    if any(under_no_grad(function, node) for node in nodes):
        return True
    while scope is not None:
        if set(scope.decorators) & {"no_grad", "inference_mode"}:
            return True
        if scope.parent is not None and under_no_grad(scope.parent, scope.node):
            return True
        scope = scope.parent
    return False


def is_detached(node: cst.CSTNode) -> bool:
    """Whether no gradient goes that way."""
    return any(isinstance(part, cst.Call) and call_name(part) in ("detach", "item") for part in attribute_chain(node))


def detaches(node: cst.CSTNode) -> bool:
    """Whether a gradient is cut off somewhere in an expression."""
    return any(isinstance(part, cst.Call) and call_name(part) == "detach" for part in walk_expressions(node))


def _stops_gradients(node: cst.CSTNode) -> bool:
    if isinstance(node, cst.Call) and call_name(node) in _NO_GRAD:
        if call_name(node) == "no_grad":
            return True
        value = constant(node.args[0].value) if node.args else True
        return bool(value) if call_name(node) == "inference_mode" else value is False
    return False
