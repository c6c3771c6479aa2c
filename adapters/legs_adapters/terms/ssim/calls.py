"""Decide whether the call of an SSIM function computes 3DGS's SSIM."""

from __future__ import annotations

from typing import Dict, Optional

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import constant, every_parameter
from legs_adapters.terms.form import Form
from legs_adapters.terms.ssim.forms import FORMS, form_of

__all__ = ["SsimCalls"]

_NO_LITERAL = object()


class SsimCalls:
    """Answer for one program."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self._known: Dict[Function, bool] = {}

    def proven(self, function: Function, form: Form) -> Optional[Function]:
        """Return the function of a call, where it is 3DGS's SSIM and the further arguments are its defaults."""
        assert form.callee is not None
        references = self.program.resolve(function, form.callee)
        target = references[0].target if len(references) == 1 else None
        if not isinstance(target, Function) or not self.is_ssim(target):
            return None
        return target if all(_is_default(arg, form.call, target) for arg in form.extras) else None

    def is_ssim(self, function: Function) -> bool:
        """Return whether a function is 3DGS's SSIM as it stands."""
        if function not in self._known:
            self._known[function] = len(function.parameters) >= 2 and form_of(self.program, function) in FORMS
        return self._known[function]


def _is_default(arg: cst.Arg, call: cst.Call, function: Function) -> bool:
    """Return whether an argument of a call is the default of its parameter."""
    assert isinstance(function.node, cst.FunctionDef)
    position = call.args.index(arg)
    name = function.parameters[position] if position < len(function.parameters) else ""
    name = arg.keyword.value if arg.keyword is not None else name
    defaults = {param.name.value: param.default for param in every_parameter(function.node.params)}
    value, default = constant(arg.value, _NO_LITERAL), constant(defaults.get(name), _NO_LITERAL)
    return value is not _NO_LITERAL and (type(value), value) == (type(default), default)
