"""Skip the body of the codebase's own L1 function: its calls are the terms."""

from __future__ import annotations

from typing import List

from legs_adapters.code.calls import sure_calls
from legs_adapters.code.module import CALLED
from legs_adapters.code.syntax import words
from legs_adapters.rules.rule import Rule, Term, header
from legs_adapters.terms.findings import Decider


class InDefinition(Rule):
    """The term is in the body of the codebase's own L1 function, whose calls are decided one by one.

    skipped:
        def photometric(image, gt):
            return torch.abs(image - gt).mean()
    """

    id = reason = "definition"
    is_doubted_beside_sites = False

    def evidence(self, term: Term) -> List[Decider]:
        function, analysis = term.function, term.analysis
        shape = analysis.forms.functions.shape
        if shape(function) is None:
            return []
        calls = analysis.training.sites.get(function) or list(sure_calls(analysis.program, function))
        known = {id(form.call) for caller in dict(calls) for form in analysis.forms.in_function(caller)}
        are_own = [id(call) in known or shape(caller) is not None for caller, call in calls]
        own = function in analysis.callbacks.assigned or all(are_own)
        return [header(function)] if own else []

    def may_be_loss(self, term: Term) -> bool:
        """Return whether it is the body of a module, or of a method that is named a loss."""
        function = term.function
        return function.name in CALLED or (function.owner is not None and "loss" in words(function.name))
