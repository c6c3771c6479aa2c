"""Find where gradients are cut: by ``torch.no_grad()`` and its like around an expression, by ``detach()`` in it."""

from __future__ import annotations

import ast
from typing import Optional, Tuple

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import attribute_chain, call_name
from legs_adapters.tensors.operations import ENDS_GRADIENT, NO_GRAD


def no_grad_around(function: Function, *nodes: ast.AST) -> Optional[Tuple[Function, ast.AST]]:
    """Return the ``no_grad`` around expressions, with its function: the block's call, or the decorator."""
    for node in nodes:
        for context in function.flow.contexts.get(id(node), ()):
            if isinstance(context, ast.Call) and call_name(context) in NO_GRAD:
                return function, context
    for decorator, name in zip(getattr(function.node, "decorator_list", ()), function.decorators):
        if name in NO_GRAD:
            return function.parent or function, decorator
    return no_grad_around(function.parent, function.node) if function.parent is not None else None


def is_detached(node: ast.AST) -> bool:
    """Return whether a chain of attributes and calls cuts the gradient."""
    return any(isinstance(part, ast.Call) and call_name(part) in ENDS_GRADIENT for part in attribute_chain(node))
