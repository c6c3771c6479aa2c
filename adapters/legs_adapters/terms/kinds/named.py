"""``diff = a - b``, then ``diff[mask].abs().mean()``: the difference is assigned to a name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, List, Optional

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import code
from legs_adapters.tensors.absolute import absolute_value, is_difference
from legs_adapters.terms.form import Form
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.text import Edit, Text, on_one_line, residue
from legs_adapters.terms.writing import Writing

__all__ = ["Named"]


@dataclass(frozen=True)
class Named(Form):
    """A difference with a name: the two images replace the name.

    Example:
        before: diff = image - gt_image; loss = diff.abs().mean()
        after: diff = image - gt_image; loss = legs_loss.l1_loss(image, gt_image)
    """

    order = 30
    is_named: ClassVar[bool] = True

    @classmethod
    def find(cls, functions: L1Functions, function: Function, call: cst.Call) -> Optional[Form]:
        """Find ``abs`` of a name, or of an index of it, whose value is a difference."""
        found = absolute_value(call)
        if found is None:
            return None
        argument, selection = found.argument, ""
        if isinstance(argument, cst.Subscript):
            selection = code(argument)[len(code(argument.value)) :].strip()
            argument = argument.value
        value = function.flow.value_of(argument)
        if not isinstance(value, cst.BinaryOperation) or not is_difference(value):
            return None
        sides = value.left, value.right
        return cls(call, found.call, *sides, difference=value, selection=selection, makes=found.makes)

    @classmethod
    def of(cls, form: Form, first: cst.BaseExpression, second: cst.BaseExpression, index: str) -> Named:
        """Return a form of masked images as one of whole images, the error map of which is indexed."""
        makes = "none" if form.is_map else "mean"
        return cls(form.node, form.call, first, second, form.callee, selection=index, makes=makes)

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Replace the whole term; the name and its difference stay for other reads."""
        carried = writing.selection[: len(writing.selection) - len(self.selection)]
        first, second = (on_one_line(text.argument(side, carried)) for side in (self.first, self.second))
        tail = writing.selection + (".mean()" if writing.selection and self.is_mean else "")
        call = writing.call(
            *writing.ordered(first, second), bool(writing.selection) or self.is_map, residue=residue(text.of(self.node))
        )
        return [text.replace(*text.span(self.node), call + tail)]
