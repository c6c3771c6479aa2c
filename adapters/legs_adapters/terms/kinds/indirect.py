"""``torch.abs((a - b) * w)``, ``delta = a - b``, ``delta = delta[mask]``, ``delta.abs()``: by hand."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from typing import Iterator, Optional

from legs_adapters.code.module import Function
from legs_adapters.tensors.absolute import absolute_value, sides_of
from legs_adapters.terms.form import Form
from legs_adapters.terms.functions import L1Functions

_DEPTH = 4


@dataclass(frozen=True)
class Indirect(Form):
    """The absolute value of a difference that has a name, or that was changed before: filtered, scaled, weighted.

    Examples:
        before: diff = image - gt_image; diff = diff[diff ** 2 < 0.1]; loss = diff.abs().mean()
        advice: as one absolute difference times the photograph's weight map, with each mask and threshold as it is

    Attributes:
        difference: the ``a - b``.
    """

    difference: Optional[ast.AST] = None

    @classmethod
    def find(cls, functions: L1Functions, function: Function, call: ast.Call) -> Optional[Form]:
        """Find ``abs`` of what is made of a difference, in the expression or by its definitions."""
        found = absolute_value(call)
        made = next(_differences(function, found.argument, 0), None) if found is not None else None
        sides = sides_of(made)
        if found is None or sides is None:
            return None
        return cls(call, found.call, *sides, makes=found.makes, difference=made)


def _differences(function: Function, node: ast.AST, depth: int) -> Iterator[ast.AST]:
    """Yield the differences that an expression is a multiple, a quotient or a part of."""
    if sides_of(node):
        yield node
    elif isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Mult, ast.Div)):
        yield from _differences(function, node.left, depth)
        yield from _differences(function, node.right, depth)
    elif isinstance(node, ast.Subscript):
        yield from _differences(function, node.value, depth)
    elif isinstance(node, ast.Name) and depth < _DEPTH:
        for value in function.flow.assigned(node):
            yield from _differences(function, value, depth + 1)
