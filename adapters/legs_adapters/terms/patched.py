"""Find terms that are weighted already, by an earlier patch or by hand."""

from __future__ import annotations

import ast
from typing import List, Sequence

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.terms.writing import PACKAGE

_PATCHED = (f"{PACKAGE}.l1_loss", f"{PACKAGE}.unweighted")


def patched_nodes(program: Program, function: Function, names: Sequence[str] = _PATCHED) -> List[ast.AST]:
    """Return the calls and assigned values in a function that refer to these names of legs_loss."""
    if not program.mentioning(PACKAGE):
        return []
    nodes: List[ast.AST] = [call.func for call in function.flow.calls]
    named = [d.value for d in function.flow.every_definition if d.kind == "assign"]
    nodes += [value for value in named if isinstance(value, ast.Attribute)]
    resolved = [(node, program.resolve(function, node)) for node in nodes]
    return [node for node, found in resolved if any(r.kind == "external" and r.target in names for r in found)]
