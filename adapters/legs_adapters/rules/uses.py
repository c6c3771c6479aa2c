"""Classify the calls of a function that compares two images: for the loss, or for something else."""

from __future__ import annotations

from typing import List, NamedTuple, Optional, Sequence, Tuple

import libcst as cst

from legs_adapters.code.calls import calls_of
from legs_adapters.code.module import Function
from legs_adapters.code.syntax import arguments, attribute_chain, key_of
from legs_adapters.lexicon.meaning import Meaning, swapped
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.order import first_of_call
from legs_adapters.rules.rule import CallOfTerm
from legs_adapters.tensors.gradients import detaches, is_without_grad
from legs_adapters.terms.findings import Evidence

__all__ = ["Use", "Uses"]


class Use(NamedTuple):
    """A call of a function that compares images.

    Attributes:
        caller, call: the call, and the function that it stands in.
        other: the evidence that it is not for the loss; None where it is.
        sure: whether its arguments show that.
    """

    caller: Function
    call: cst.Call
    other: Optional[Evidence]
    sure: bool

    @property
    def where(self) -> str:
        """Its file and line."""
        return f"{self.caller.module.path}:{self.caller.place(self.call).line}"


class Uses:
    """Answer for one program."""

    def __init__(self, analysis: Analysis) -> None:
        self.analysis = analysis

    def of(self, function: Function, prediction: cst.CSTNode, target: cst.CSTNode) -> List[Use]:
        """Classify the calls, in the training step, of a function that compares two of its parameters."""
        found: List[Tuple[Use, Optional[str]]] = []
        prediction, target = _whole(prediction), _whole(target)
        if not isinstance(target, cst.Name):
            return []
        calls = self.analysis.training.sites.get(function, [])
        for caller, call in sorted(calls, key=lambda site: (site[0].module.path, site[0].place(site[1]).line)):
            photograph = function.given(call, target.value)
            rendering = function.given(call, prediction.value) if isinstance(prediction, cst.Name) else None
            if photograph is not None:
                given = [node for node in (rendering, photograph) if node is not None]
                meanings = [self.analysis.meanings.of(caller, node) for node in given]
                sure = not arguments(call)[2] and not any(self._is_handed_on(caller, node) for node in given)
                if meanings[-1].role is None and detaches(photograph):  # a photograph needs no detach()
                    meanings[-1], sure = meanings[-1]._replace(role="render"), False
                other = first_of_call(CallOfTerm(self.analysis, caller, call, meanings))
                sure = sure and (other is not None or _are_pair(meanings))
                found.append((Use(caller, call, other, sure), meanings[0].kind))
        pictures = any(kind == "image" for _, kind in found)
        return [
            use._replace(other=_unknown(use), sure=False) if pictures and kind is None and use.other is None else use
            for use, kind in found
        ]

    def unsettled(self, function: Function, uses: Sequence[Use]) -> Optional[str]:
        """Return the place of a call, or possible call, of unknown purpose; None without one.

        Nothing is weighted without gradients, so the purpose of such a call does not matter.
        """
        sure = {id(use.call) for use in uses if use.sure}
        calls = calls_of(self.analysis.program, function)
        for caller, call in calls.known:
            if id(call) not in sure and not is_without_grad(caller, call):
                return f"{caller.module.path}:{caller.place(call).line}"
        return calls.lost

    def _is_handed_on(self, caller: Function, node: cst.CSTNode) -> bool:
        """Return whether the caller got it from several calls of its own, which may pass different kinds."""
        several = len(self.analysis.training.sites.get(caller, ())) > 1
        given = [made for part in attribute_chain(node) for made in caller.flow.reaching(part)] if several else []
        return any(made.kind == "parameter" for made in given)


def _unknown(use: Use) -> Evidence:
    """Return the evidence that the purpose of a call is unknown."""
    return Evidence("unknown", "something unknown", [(use.caller, use.call)])


def _whole(node: cst.CSTNode) -> cst.CSTNode:
    """Return ``gt`` of ``gt[:3]``; an entry of a dictionary, ``batch["image"]``, is returned as it is."""
    while isinstance(node, cst.Subscript) and not isinstance(key_of(node), str):
        node = node.value
    return node


def _are_pair(meanings: Sequence[Meaning]) -> bool:
    """Return whether the first is a rendering and the second surely a photograph."""
    return meanings[-1].role == "target" and swapped(meanings[0], meanings[-1]) is False
