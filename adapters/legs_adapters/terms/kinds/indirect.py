"""``torch.abs((a - b) * w)``, ``delta = a - b``, ``delta = delta[mask]``, ``delta.abs()``: by hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterator, Optional

import libcst as cst

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

    difference: Optional[cst.CSTNode] = None

    @classmethod
    def find(cls, functions: L1Functions, function: Function, call: cst.Call) -> Optional[Form]:
        """Find ``abs`` of what is made of a difference, in the expression or by its definitions."""
        found = absolute_value(call)
        made = next(_differences(function, found.argument, 0), None) if found is not None else None
        sides = sides_of(made)
        if found is None or sides is None:
            return None
        return cls(call, found.call, *sides, makes=found.makes, difference=made)


def _differences(function: Function, node: cst.CSTNode, depth: int) -> Iterator[cst.CSTNode]:
    """Yield the differences that an expression is a multiple, a quotient or a part of."""
    if sides_of(node):
        yield node
    elif isinstance(node, cst.BinaryOperation) and isinstance(node.operator, (cst.Multiply, cst.Divide)):
        yield from _differences(function, node.left, depth)
        yield from _differences(function, node.right, depth)
    elif isinstance(node, cst.Subscript):
        yield from _differences(function, node.value, depth)
    elif isinstance(node, cst.Name) and depth < _DEPTH:
        for value in function.flow.assigned(node):
            yield from _differences(function, value, depth + 1)
