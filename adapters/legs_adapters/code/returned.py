"""Find what functions return as one expression, and the keys of the dictionaries that they return."""

from __future__ import annotations

import ast
import copy
from typing import Any, Dict, Optional

from legs_adapters.code.module import Function
from legs_adapters.code.reaching import Definition
from legs_adapters.code.syntax import constant, index_of


def returned(function: Function) -> Optional[ast.expr]:
    """Return what straight-line code returns, its local names filled in; None where that is not one expression."""
    names: Dict[str, ast.expr] = {}
    for statement in function.body:
        if isinstance(statement, ast.Return):
            return _filled(statement.value, names) if statement.value is not None else None
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            names[statement.targets[0].id] = _filled(statement.value, names)
        elif not isinstance(statement, (ast.Assert, ast.Pass)) and not _is_text(statement):
            return None
    return None


def _is_text(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(constant(statement.value), str)


def _filled(node: Any, names: Dict[str, ast.expr]) -> Any:
    """Return an expression with the values of local names in their place."""
    if isinstance(node, ast.Name):
        return names.get(node.id, node)
    if isinstance(node, list):
        return [_filled(part, names) for part in node]
    if not isinstance(node, ast.AST) or not names:
        return node
    filled = copy.copy(node)
    for name in node._fields:
        setattr(filled, name, _filled(getattr(node, name, None), names))
    return filled


def formatted_key(node: ast.Subscript) -> Optional[str]:
    """Return the literal part of the key of ``outputs[f"image_{i}"]``."""
    value = index_of(node)
    parts = map(constant, value.values) if isinstance(value, ast.JoinedStr) else ()
    return "_".join(part for part in parts if isinstance(part, str)) or None


def default_key(function: Function, node: ast.Subscript) -> object:
    """Return ``"rgb"`` for ``preds[key]`` of a function with the parameter ``key="rgb"``."""
    index = index_of(node)
    found = function.flow.reaching(index) if isinstance(index, ast.Name) else None
    return constant(found.value) if isinstance(found, Definition) and found.kind == "parameter" else None
