"""``torch.abs((a - b) * w)``: the difference is multiplied before its absolute value is taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import List, Optional

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.tensors.absolute import absolute_value, is_difference
from legs_adapters.terms.form import Form
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.text import Edit, Text, names_for_two, on_one_line, residue
from legs_adapters.terms.writing import Writing

__all__ = ["Wrapped"]


@dataclass(frozen=True)
class Wrapped(Form):
    """An expression around the difference, which is kept as a function of the two sides.

    Example:
        before: loss = abs((image - gt_image) * 2).mean()
        after: loss = legs_loss.l1_loss(image, gt_image, own=lambda a, b: abs((a - b) * 2)).mean()
    """

    order = 20

    @classmethod
    def find(cls, functions: L1Functions, function: Function, call: cst.Call) -> Optional[Form]:
        """Find ``abs`` of a product or quotient with a difference in it."""
        found = absolute_value(call)
        argument = None if found is None else found.argument
        if not isinstance(argument, cst.BinaryOperation):
            return None
        sides = {cst.Multiply: [argument.left, argument.right], cst.Divide: [argument.left]}
        for side in sides.get(type(argument.operator), ()):
            if isinstance(side, cst.BinaryOperation) and is_difference(side):
                assert found is not None
                return cls(found.call, found.call, side.left, side.right, difference=side)
        return None

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Make the expression a lambda of prediction and target, and pass it as ``own=``."""
        difference = self.difference
        assert difference is not None
        start, end = text.span(self.node)
        left, right = text.span(difference.left, True), text.span(difference.right, True)
        pieces = [text.between(start, left[0]), text.between(left[1], right[0]), text.between(right[1], end)]
        index = writing.selection  # applied inside own: the weight is of whole images
        a, b = names_for_two(on_one_line("\n".join([*pieces, index])))
        names = ", ".join(writing.ordered(a, b))
        own = on_one_line(f"lambda {names}: {pieces[0]}{a}{index}{pieces[1]}{b}{index}{pieces[2]}")
        sides = writing.ordered(text.argument(difference.left, index), text.argument(difference.right, index))
        return [text.replace(start, end, writing.call(*sides, own=own, residue=residue("".join(pieces))))]
