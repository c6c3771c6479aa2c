"""``torch.abs(a - b).mean()``, and the map ``(a - b).abs()``."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from typing import List, Optional

from legs_adapters.code.module import Function
from legs_adapters.tensors.absolute import absolute_value, sides_of
from legs_adapters.terms.form import Form
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.text import Edit, Text, residue
from legs_adapters.terms.writing import PACKAGE, Writing


@dataclass(frozen=True)
class Absolute(Form):
    """An absolute difference: the text around it is replaced, and the difference becomes two arguments.

    Examples:
        before: loss = torch.abs(image - gt_image).mean()
        after: loss = legs_loss.l1_loss(image, gt_image)
    """

    @classmethod
    def find(cls, functions: L1Functions, function: Function, call: ast.Call) -> Optional[Form]:
        """Find ``abs`` of a difference that is not of numbers."""
        found = absolute_value(call)
        sides = sides_of(found.argument) if found is not None else None
        return cls(call, found.call, *sides, makes=found.makes) if found is not None and sides is not None else None

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Replace what stands before, between and after the two sides, comments kept."""
        start, end = text.span(self.node)
        left, right = text.span(self.first, True), text.span(self.second, True)
        sides = writing.ordered(*(text.argument(side, writing.selection) for side in (self.first, self.second)))
        middle = residue(text.between(left[1], right[0])) or " "
        settings = writing.settings(as_map=bool(writing.selection) or self.makes == "none")
        tail = writing.selection + (".mean()" if writing.selection and self.makes == "mean" else "")
        before, after = residue(text.between(start, left[0])), residue(text.between(right[1], end))
        name = f"{' ' * text.between(start - 1, start).isalnum()}{PACKAGE}.l1_loss"  # return(image - gt_image).abs()
        return [text.replace(start, end, f"{name}({before}{sides[0]},{middle}{sides[1]}{settings}{after}){tail}")]
