"""``F.l1_loss(a, b)``, or a call of the codebase's own L1 function."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from typing import List, Optional

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import arguments, call_name, constant, given
from legs_adapters.lexicon.names import TORCH_L1, has_perceptual_name, is_l1_name
from legs_adapters.terms.form import Form
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.text import Edit, Text, residue
from legs_adapters.terms.writing import PACKAGE, Writing


@dataclass(frozen=True)
class Called(Form):
    """A call of an L1 function with two images.

    Examples:
        before: loss = l1_loss(image, gt_image)
        after: loss = legs_loss.l1_loss(image, gt_image)
    """

    @classmethod
    def find(cls, functions: L1Functions, function: Function, call: ast.Call) -> Optional[Form]:
        """Find a call of an L1 function, by the function's body, or by its name where the body is not available."""
        args = given(call)
        if len(args) < 2 or arguments(call)[2]:
            return None
        references = functions.program.resolve(function, call.func)
        if not (references or is_l1_name(call_name(call))) or has_perceptual_name(call_name(call)):
            return None  # a method of an object of unknown class: its name alone proves nothing
        shapes = {functions.shape_of_reference(reference) for reference in references} or {"own"}
        names = {p for r in references if isinstance(r.target, Function) for p in r.target.parameters[:2]}
        keywords = [arg.keyword for arg in args[:2] if arg.keyword]
        if None in shapes or not set(keywords) <= {"input", "target"} | names:
            return None
        makes = shapes.pop() if len(shapes) == 1 else "own"
        first, second, extras = args[0].value, args[1].value, tuple(args[2:])
        settings = {arg.keyword: constant(arg.value) for arg in extras if arg.keyword}
        if len(extras) == 1 and any(TORCH_L1.search(str(r.target)) for r in references):
            makes = "none" if settings == {"reduction": "none"} else makes
            extras = () if settings in ({"reduction": "none"}, {"reduction": "mean"}) else extras
        elif makes in ("mean", "none"):
            extras = ()  # they settled the shape; the call no longer needs them
        return cls(call, call, first, second, call.func, extras, makes=makes or "own")

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Replace the function, order the two images, and replace the further arguments by the settings."""
        function, call = text.span(self.call.func), text.span(self.call)
        first, second, last = (text.argument_span(self.call, at) for at in (0, 1, -1))
        sides = writing.ordered(*(text.argument(side, writing.selection) for side in (self.first, self.second)))
        tail = writing.selection if self.makes != "own" else ""
        own = writing.own(self.call.func, self.extras) if self.makes == "own" else ""
        settings = writing.settings(self.makes == "none" or bool(tail), own)
        tail += ".mean()" if tail and self.makes == "mean" else ""
        before = text.between(function[1], first[0]) + residue(text.between(*function))
        after = residue(text.between(second[1], last[1])) + text.between(last[1], call[1])
        arguments = f"{before}{sides[0]}{text.between(first[1], second[0])}{sides[1]}{settings}{after}"
        return [text.replace(function[0], call[1], f"{PACKAGE}.l1_loss{arguments}{tail}")]
