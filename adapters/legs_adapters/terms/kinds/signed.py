"""``difference = relative(image, gt)``, then its absolute value: a function returns a weighted difference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import arguments, code, one_line
from legs_adapters.tensors.absolute import abs_argument, absolute_value
from legs_adapters.terms.form import Form
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.writing import Writing

__all__ = ["Signed"]


@dataclass(frozen=True)
class Signed(Form):
    """The absolute value of a weighted difference; l1_loss would drop the weight, so it is edited by hand.

    Example:
        before: diff = relative(image, gt_image); loss = torch.abs(diff).mean()
        advice: torch.abs(legs_loss.weight_map(gt_image) * diff).mean()
    """

    order = 40

    @classmethod
    def find(cls, functions: L1Functions, function: Function, call: cst.Call) -> Optional[Form]:
        """Find ``abs`` of a name that is ``weight * (a - b)`` of a function's first two arguments."""
        found = absolute_value(call)
        value = None if found is None else function.flow.value_of(found.argument)
        if not isinstance(value, cst.Call) or not _returns_difference(functions.program, function, value):
            return None
        assert found is not None
        first, second = arguments(value)[0][:2]
        return cls(call, found.call, first, second)

    def why_by_hand(self) -> str:
        """Return that the difference is weighted already."""
        return f"the difference {self._difference()} already has a weight, which l1_loss would drop"

    def _advice(self, writing: Writing, prediction: str, target: str, rows: bool) -> str:
        mean = ".mean()" if self.node is not self.call else ""
        return f"torch.abs({writing.weight_map(target)} * {self._difference()}){mean}"

    def _difference(self) -> str:
        difference = abs_argument(self.call)
        assert difference is not None
        return one_line(difference)


def _returns_difference(program: Program, function: Function, call: cst.Call) -> bool:
    """Return whether a call's function returns ``weight * (a - b)`` of its first two parameters."""
    made = program.resolve(function, call.func)
    if len(made) != 1 or made[0].guess or not isinstance(made[0].target, Function) or len(arguments(call)[0]) < 2:
        return False
    maker = made[0].target
    if len(maker.flow.returns) != 1 or len(maker.parameters) < 2:
        return False
    value: Optional[cst.CSTNode] = maker.flow.returns[0]
    if isinstance(value, cst.Name):
        value = maker.flow.value_of(value)
    if not isinstance(value, cst.BinaryOperation) or not isinstance(value.operator, (cst.Multiply, cst.Divide)):
        return False
    sides = [side for side in (value.left, value.right) if isinstance(side, cst.BinaryOperation)]
    compared = [{code(side.left), code(side.right)} for side in sides if isinstance(side.operator, cst.Subtract)]
    return set(maker.parameters[:2]) in compared
