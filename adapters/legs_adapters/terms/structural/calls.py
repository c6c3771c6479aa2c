"""Decide whether calls of SSIM functions compute 3DGS's SSIM, with the evidence."""

from __future__ import annotations

from typing import Dict, List, NamedTuple, Optional

import libcst as cst

from legs_adapters.code.module import Class, Function
from legs_adapters.code.program import Program, Reference
from legs_adapters.code.syntax import constant, every_parameter
from legs_adapters.terms.findings import Decider
from legs_adapters.terms.form import Form
from legs_adapters.terms.structural.forms import FORMS, form_of

__all__ = ["Proof", "SsimCalls"]

_MISSING = object()


class Proof(NamedTuple):
    """The verdict on the value of a call.

    Attributes:
        lack: why it is not 3DGS's SSIM, or not provably: "library" (the function is not of this checkout), "settings"
            (of this call), "unproven"; empty where it is.
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
        self._known: Dict[Function, bool] = {}

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
        settings = [arg for arg in form.extras if not _is_default(arg, form, target)]
        dynamic = [arg for arg in settings if constant(arg.value, _MISSING) is _MISSING]
        if dynamic or (settings and self.is_ssim(target)):
            return Proof("settings", [(function, (dynamic or settings)[0].value)])
        return Proof("", [], target) if self.is_ssim(target) else Proof("unproven", [(target, target.node)])

    def is_ssim(self, function: Function) -> bool:
        """Return whether a function is 3DGS's SSIM as it stands."""
        if function not in self._known:
            self._known[function] = len(function.parameters) >= 2 and form_of(self.program, function) in FORMS
        return self._known[function]

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


def _is_default(arg: cst.Arg, form: Form, function: Function) -> bool:
    """Return whether an argument of a call is the default of its parameter."""
    assert isinstance(form.call, cst.Call) and isinstance(function.node, cst.FunctionDef)
    name = arg.keyword.value if arg.keyword is not None else ""
    position = form.call.args.index(arg)
    if not name and position < len(function.parameters):
        name = function.parameters[position]
    defaults = {param.name.value: param.default for param in every_parameter(function.node.params)}
    value, default = constant(arg.value, _MISSING), constant(defaults.get(name), _MISSING)
    return value is not _MISSING and (type(value), value) == (type(default), default)


def _class_of(references: List[Reference]) -> Optional[Decider]:
    """Return the class whose object is called, if it is of the checkout."""
    for reference in references:
        if isinstance(reference.target, Class):
            return reference.target.parent, reference.target.node.name
        if isinstance(reference.target, Function) and not reference.guess:
            return reference.target, reference.target.node
    return None
