"""Find what functions return as one expression, and the keys of the dictionaries that they return."""

from __future__ import annotations

from typing import Dict, List, Optional

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.reaching import Definition
from legs_adapters.code.syntax import constant, index_of


def returned(function: Function) -> Optional[cst.CSTNode]:
    """Return what straight-line code returns, its local names filled in; None where that is not one expression."""
    names: Dict[str, cst.BaseExpression] = {}
    work: List[cst.CSTNode] = list(function.body.body)
    while work:
        statement = work.pop(0)
        if isinstance(statement, cst.SimpleStatementLine):
            work[:0] = statement.body
        elif isinstance(statement, cst.Return):
            return _filled(function, statement.value, names) if statement.value is not None else None
        elif isinstance(statement, cst.Assign) and isinstance(statement.targets[0].target, cst.Name):
            names[statement.targets[0].target.value] = _filled(function, statement.value, names)
        elif not isinstance(statement, (cst.Assert, cst.Pass)) and not _is_text(statement):
            return None
    return None


def _is_text(statement: cst.CSTNode) -> bool:
    return isinstance(statement, cst.Expr) and isinstance(statement.value, (cst.SimpleString, cst.ConcatenatedString))


def _filled(function: Function, node: cst.BaseExpression, names: Dict[str, cst.BaseExpression]) -> cst.BaseExpression:
    """Return an expression with the values of local names in their place."""
    reads = set(map(id, function.flow.reads_in(node)))

    class Fill(cst.CSTTransformer):
        def leave_Name(self, original_node: cst.Name, updated_node: cst.Name) -> cst.BaseExpression:
            return names.get(original_node.value, updated_node) if id(original_node) in reads else updated_node

    filled = node.visit(Fill()) if names else node
    assert isinstance(filled, cst.BaseExpression)
    return filled


def formatted_key(node: cst.Subscript) -> Optional[str]:
    """Return the literal part of the key of ``outputs[f"image_{i}"]``."""
    value = index_of(node)
    parts = value.parts if isinstance(value, cst.FormattedString) else ()
    return "_".join(part.value for part in parts if isinstance(part, cst.FormattedStringText)) or None


def default_key(function: Function, node: cst.Subscript) -> object:
    """Return ``"rgb"`` for ``preds[key]`` of a function with the parameter ``key="rgb"``."""
    index = index_of(node)
    found = function.flow.reaching(index) if isinstance(index, cst.Name) else None
    return constant(found.value) if isinstance(found, Definition) and found.kind == "parameter" else None
