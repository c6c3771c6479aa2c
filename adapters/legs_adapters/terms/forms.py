"""Find the L1 expressions of a function: each of its calls is given to every kind that is found in calls."""

from __future__ import annotations

import ast
from typing import List, Set, Tuple, Type, Union

from legs_adapters.code.limits import remembered
from legs_adapters.code.module import Function
from legs_adapters.code.syntax import call_name, walk_expressions
from legs_adapters.tensors.absolute import abs_argument
from legs_adapters.tensors.operations import TRANSFORMS
from legs_adapters.terms.form import Form
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.kinds.absolute import Absolute
from legs_adapters.terms.kinds.called import Called
from legs_adapters.terms.kinds.indirect import Indirect

KINDS: Tuple[Type[Union[Absolute, Indirect, Called]], ...] = (Absolute, Indirect, Called)  # the first that finds it


class Forms:
    """The forms of each function of one program, cached."""

    def __init__(self, functions: L1Functions) -> None:
        self.functions = functions

    @remembered
    def in_function(self, function: Function) -> List[Form]:
        """Return the L1 expressions in a function's own body, in source order; the widest where they nest."""
        found: List[Form] = []
        inside = _transformed(function)
        for call in function.flow.calls:
            forms = (kind.find(self.functions, function, call) for kind in KINDS if id(call) not in inside)
            form = next(filter(None, forms), None)
            if form is not None:
                found.append(form)
                inside.add(id(form.call))
                inside.update(id(n) for n in walk_expressions(form.node) if abs_argument(n))
        return found


def _transformed(function: Function) -> Set[int]:
    """Return the ids of the calls whose values are squared or transformed (log, exp): they are not an L1."""
    found: Set[int] = set()
    for node in function.flow.expressions:
        parts: List[ast.AST] = []
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
            parts = [node.left]
        elif isinstance(node, ast.Call) and call_name(node) in TRANSFORMS:
            parts = [node.func, *node.args, *node.keywords]
        for part in parts:
            found.update(id(n) for n in walk_expressions(part) if isinstance(n, ast.Call) and n is not node)
    return found
