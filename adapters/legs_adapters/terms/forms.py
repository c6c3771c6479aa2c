"""Find the L1 expressions of a function: each of its calls is given to every kind in ``terms/kinds``."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from typing import Dict, List, Optional, Set, Type

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import call_name, walk_expressions
from legs_adapters.tensors.absolute import is_abs
from legs_adapters.tensors.operations import TRANSFORMS
from legs_adapters.terms import kinds
from legs_adapters.terms.form import Form
from legs_adapters.terms.functions import L1Functions

__all__ = ["Forms"]


class Forms:
    """The forms of each function of one program, cached."""

    def __init__(self, functions: L1Functions) -> None:
        self.functions = functions
        self._kinds = _kinds()
        self._known: Dict[Function, List[Form]] = {}

    def of(self, function: Function) -> List[Form]:
        """Return the L1 expressions in a function's own body, in source order; the widest where they nest."""
        if function not in self._known:
            self._known[function] = self._find(function)
        return self._known[function]

    def _find(self, function: Function) -> List[Form]:
        found: List[Form] = []
        inside = _transformed(function)
        for node in function.flow.expressions:
            if id(node) in inside or not isinstance(node, cst.Call):
                continue
            form = self._recognise(function, node)
            if form is not None:
                found.append(form)
                inside.add(id(form.call))
                if form.difference is None or form.callee is None:
                    inside.update(id(n) for n in walk_expressions(form.node) if isinstance(n, cst.Call) and is_abs(n))
        return found

    def _recognise(self, function: Function, call: cst.Call) -> Optional[Form]:
        forms = (kind.find(self.functions, function, call) for kind in self._kinds)
        return next((form for form in forms if form is not None), None)


def _kinds() -> List[Type[Form]]:
    """Return the kinds of L1 that are found in calls, in their order."""
    modules = [
        importlib.import_module(f"{kinds.__name__}.{info.name}") for info in pkgutil.iter_modules(kinds.__path__)
    ]
    classes = {value for module in modules for value in vars(module).values() if inspect.isclass(value)}
    found = [
        kind for kind in classes if issubclass(kind, Form) and "find" in vars(kind) and kind is not Form and kind.weighs
    ]
    return sorted(found, key=lambda kind: kind.order)


def _transformed(function: Function) -> Set[int]:
    """Return the ids of the calls whose values are squared or transformed (log, exp): they are not an L1."""
    found: Set[int] = set()
    for node in function.flow.expressions:
        parts: List[cst.CSTNode] = []
        if isinstance(node, cst.BinaryOperation) and isinstance(node.operator, cst.Power):
            parts = [node.left]
        elif isinstance(node, cst.Call) and call_name(node) in TRANSFORMS:
            parts = [node.func, *node.args]
        for part in parts:
            found.update(id(n) for n in walk_expressions(part) if isinstance(n, cst.Call) and n is not node)
    return found
