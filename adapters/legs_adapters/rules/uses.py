"""Classify the calls of a function that compares two images: for the loss, or for something else."""

from __future__ import annotations

from typing import List

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import arguments
from legs_adapters.lexicon.meaning import swapped
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.order import first
from legs_adapters.rules.rule import CallContext
from legs_adapters.terms.findings import Use

__all__ = ["uses_of"]


def uses_of(analysis: Analysis, function: Function, prediction: cst.CSTNode, target: cst.CSTNode) -> List[Use]:
    """Classify the calls, in the training step, of a function that compares two of its parameters."""
    found: List[Use] = []
    for caller, call in analysis.training.sites.get(function, []) if isinstance(target, cst.Name) else ():
        sides = [function.given(call, side.value) for side in (prediction, target) if isinstance(side, cst.Name)]
        if arguments(call)[2]:  # starred
            found.append(Use(caller, call, None, False))
        elif sides[-1] is not None:
            given = [analysis.meanings.meaning(caller, side) for side in sides if side is not None]
            other = first(CallContext(analysis, caller, call, given))
            is_loss = given[0].kind == "image" and given[-1].role == "target"
            is_loss = is_loss and (len(given) == 1 or swapped(*given) is False)
            found.append(Use(caller, call, other, is_loss or other is not None))
    return sorted(found, key=lambda use: (use.caller.module.path, use.caller.place(use.call).line))
