"""Classify the calls of a function that compares two images: for the loss, or for something else."""

from __future__ import annotations

from typing import List, NamedTuple, Optional, Sequence

import libcst as cst

from legs_adapters.code.calls import calls_of
from legs_adapters.code.module import Function
from legs_adapters.code.syntax import key_of
from legs_adapters.lexicon.meaning import swapped
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.order import first
from legs_adapters.rules.rule import CallContext
from legs_adapters.tensors.gradients import detaches, is_without_grad
from legs_adapters.terms.findings import Evidence

__all__ = ["Use", "unsettled", "uses_of"]


class Use(NamedTuple):
    """A call of a function that compares images.

    Attributes:
        caller, call: the call, and the function that it stands in.
        other: the evidence that it is not for the loss; None where it is.
        is_sure: whether its arguments show that.
    """

    caller: Function
    call: cst.Call
    other: Optional[Evidence]
    is_sure: bool

    @property
    def where(self) -> str:
        """Its file and line."""
        return f"{self.caller.module.path}:{self.caller.place(self.call).line}"


def uses_of(analysis: Analysis, function: Function, prediction: cst.CSTNode, target: cst.CSTNode) -> List[Use]:
    """Classify the calls, in the training step, of a function that compares two of its parameters."""
    prediction, target = _whole(prediction), _whole(target)
    found: List[Use] = []
    kinds: List[Optional[str]] = []
    calls = analysis.training.sites.get(function, []) if isinstance(target, cst.Name) else []
    for caller, call in sorted(calls, key=lambda site: (site[0].module.path, site[0].place(site[1]).line)):
        sides = [function.given(call, side.value) for side in (prediction, target) if isinstance(side, cst.Name)]
        if sides[-1] is not None:
            given = [analysis.meanings.meaning(caller, side) for side in sides if side is not None]
            is_pair = given[-1].role == "target" and swapped(given[0], given[-1]) is False
            is_cut = given[-1].role is None and detaches(sides[-1])  # a photograph needs no detach()
            given[-1] = given[-1]._replace(role="render") if is_cut else given[-1]
            other = first(CallContext(analysis, caller, call, given))
            passed_on = any(side is not None and caller.is_parameter(side) for side in sides)
            several = passed_on and len(analysis.training.sites.get(caller, ())) > 1
            is_sure = (other is not None or is_pair) and not several and not is_cut
            found.append(Use(caller, call, other, is_sure))
            kinds.append(given[0].kind)
    for at, use in enumerate(found):
        if kinds[at] is None and "image" in kinds and use.other is None:
            unknown = Evidence("unknown", "something unknown", [(use.caller, use.call)])
            found[at] = use._replace(other=unknown, is_sure=False)
    return found


def unsettled(analysis: Analysis, function: Function, uses: Sequence[Use]) -> Optional[str]:
    """Return the place of a call, or possible call, of unknown purpose; None without one.

    Nothing is weighted without gradients, so the purpose of such a call does not matter.
    """
    sure = {id(use.call) for use in uses if use.is_sure}
    calls = calls_of(analysis.program, function)
    for caller, call in calls.known:
        if id(call) not in sure and not is_without_grad(caller, call):
            return f"{caller.module.path}:{caller.place(call).line}"
    return calls.lost


def _whole(node: cst.CSTNode) -> cst.CSTNode:
    """Return ``gt`` of ``gt[:3]``; an entry of a dictionary, ``batch["image"]``, is returned as it is."""
    while isinstance(node, cst.Subscript) and not isinstance(key_of(node), str):
        node = node.value
    return node
