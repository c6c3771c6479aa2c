"""``robust(residual, config)`` of ``residual = image - gt``: a function takes the difference's absolute value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Optional

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import arguments, code, one_line
from legs_adapters.tensors.absolute import abs_argument, is_difference
from legs_adapters.terms.form import Form
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.writing import Writing

__all__ = ["Taken"]


@dataclass(frozen=True)
class Taken(Form):
    """A difference whose absolute value a function takes; the difference is weighted by hand.

    Example:
        before: residual = image - gt_image; loss = robust(residual, 0.1)
        advice: robust(legs_loss.weight_map(gt_image) * residual, 0.1)
    """

    order = 60
    is_named: ClassVar[bool] = True

    @classmethod
    def find(cls, functions: L1Functions, function: Function, call: cst.Call) -> Optional[Form]:
        """Find a call of a named difference, where the function takes the absolute value of that parameter."""
        given = arguments(call)[0][:1]
        value = function.flow.value_of(given[0]) if given else None
        if not isinstance(value, cst.BinaryOperation) or not is_difference(value):
            return None
        references = functions.program.resolve(function, call.func)
        takers = [r.target for r in references if r.kind == "function" and not r.guess]
        known = [taker for taker in takers if isinstance(taker, Function) and _takes_absolute(taker)]
        if len(takers) != 1 or not known:
            return None
        return cls(call, call, value.left, value.right, call.func, tuple(call.args[1:]), value)

    def why_by_hand(self) -> str:
        """Say which function takes the absolute value."""
        assert self.callee is not None
        return f"{one_line(self.callee)} takes the absolute value of the difference"

    def _advice(self, writing: Writing, prediction: str, target: str, rows: bool) -> str:
        first = self.call.args[0]
        product = cst.parse_expression(f"{writing.weight_map(target)} * {one_line(first.value)}")
        weighted = self.call.with_changes(args=(first.with_changes(value=product), *self.call.args[1:]))
        return one_line(weighted)


def _takes_absolute(function: Function) -> bool:
    """Return whether a function takes the absolute value of its first parameter, as it is."""
    taken = [abs_argument(call) for call in function.flow.calls if function.parameters]
    return any(function.is_parameter(part) and code(part) == function.parameters[0] for part in taken if part)
