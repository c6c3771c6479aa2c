"""Decide whether calls of SSIM functions compute 3DGS's SSIM, with the evidence."""

from __future__ import annotations

from typing import Any, Dict, List, NamedTuple, Optional

import libcst as cst

from legs_adapters.code.module import Class, Function
from legs_adapters.code.program import Program, Reference
from legs_adapters.code.syntax import constant
from legs_adapters.terms.findings import Decider
from legs_adapters.terms.form import Form
from legs_adapters.terms.structural.functions import SsimFunctions

__all__ = ["Proof", "SsimCalls"]

_MISSING = object()


class Proof(NamedTuple):
    """The verdict on the value of a call.

    Attributes:
        lack: why it is not 3DGS's SSIM, or not provably: "library" (the function is not of this checkout), "settings"
            (of this call), "value" (it computes something else), "unproven"; empty where it is.
        deciders: the evidence.
        function: the function that is 3DGS's SSIM.
    """

    lack: str
    deciders: List[Decider]
    function: Optional[Function] = None

    @property
    def reason(self) -> str:
        """Return the report's text where it is 3DGS's SSIM."""
        where = f"{self.function.module.path}:{self.function.line}" if self.function is not None else ""
        return f"{where} is the SSIM of 3DGS"


class SsimCalls:
    """Answer for one program."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.functions: SsimFunctions = SsimFunctions(program)

    def proof(self, function: Function, form: Form) -> Proof:
        """Return what a call in a function computes, with the evidence."""
        assert form.callee is not None
        here: Decider = (function, form.call)
        references = self.program.resolve(function, form.callee)
        elsewhere = [r for r in references if r.kind in ("external", "made by")]
        if elsewhere:
            return Proof("library", [self._import(function, form.callee) or here])
        if len(references) != 1 or references[0].guess or not isinstance(references[0].target, Function):
            return Proof("unproven", [_class_of(references) or here])
        target = references[0].target
        extras: List[Any] = []
        keywords: Dict[str, Any] = {}
        for arg in form.extras:
            value = constant(arg.value, _MISSING)
            if value is _MISSING:
                return Proof("settings", [(function, arg.value)])
            if arg.keyword is None:
                extras.append(value)
            else:
                keywords[arg.keyword.value] = value
        answer = self.functions.answer(target, tuple(extras), keywords)
        if answer.is_ssim:
            return Proof("", [], target)
        if form.extras and self.functions.answer(target).is_ssim:
            return Proof("settings", [(function, form.extras[0].value)])
        if answer.is_ssim is None:
            return Proof("unproven", [answer.decider or here])
        return Proof("value", [(target, target.node)])

    def is_own(self, function: Function) -> bool:
        """Return whether a function is 3DGS's SSIM as it stands."""
        return len(function.parameters) >= 2 and bool(self.functions.answer(function).is_ssim)

    def _import(self, function: Function, callee: cst.BaseExpression) -> Optional[Decider]:
        """Return the import, or the object, that a called name refers to."""
        name: cst.CSTNode = callee
        while isinstance(name, (cst.Attribute, cst.Call)):
            name = name.value if isinstance(name, cst.Attribute) else name.func
        for node in (callee, name):
            for where, definition in self.program.lookup(function, node) or ():
                if definition.kind in ("import", "assign") and definition.value is not None:
                    return where, definition.value
        return None


def _class_of(references: List[Reference]) -> Optional[Decider]:
    """Return the class whose object is called, if it is of the checkout."""
    for reference in references:
        if isinstance(reference.target, Class):
            return reference.target.parent, reference.target.node.name
        if isinstance(reference.target, Function) and not reference.guess:
            return reference.target, reference.target.node
    return None
