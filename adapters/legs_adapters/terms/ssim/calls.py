"""Decide whether the call of an SSIM function computes 3DGS's SSIM."""

from __future__ import annotations

from typing import Optional

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import constant, every_parameter
from legs_adapters.terms.form import Form
from legs_adapters.terms.ssim.forms import FORMS, form_of

_NO_LITERAL = object()


def proven_ssim(program: Program, function: Function, form: Form) -> Optional[Function]:
    """Return the function of a call, where it is 3DGS's SSIM and the further arguments are its defaults."""
    assert form.callee is not None
    references = program.resolve(function, form.callee)
    target = references[0].target if len(references) == 1 else None
    if not isinstance(target, Function) or not isinstance(target.node, cst.FunctionDef):
        return None
    others = list(every_parameter(target.node.params))[2:]
    given = [(target.given(form.call, other.name.value), other.default) for other in others]
    is_proven = all(value is None or _are_equal(value, default) for value, default in given)
    return target if is_proven and len(target.parameters) >= 2 and form_of(program, target) in FORMS else None


def _are_equal(value: cst.BaseExpression, default: Optional[cst.BaseExpression]) -> bool:
    """Return whether an argument is the literal that its parameter has as its default."""
    first, second = constant(value, _NO_LITERAL), constant(default, _NO_LITERAL)
    return first is not _NO_LITERAL and (type(first), first) == (type(second), second)
