"""List the rules in the order in which they are checked: the first that applies skips the term."""

from __future__ import annotations

from typing import Optional, Tuple

from legs_adapters.rules.causes import definition, distillation, kinds, names, other, ssim, steps, unknown, untrained
from legs_adapters.rules.rule import CallContext, Rule, Term
from legs_adapters.terms.findings import Evidence

__all__ = ["ORDER", "RULES", "SSIM", "first"]

ORDER: Tuple[Rule, ...] = (
    definition.Definition(),
    *kinds.KINDS,
    *untrained.UNTRAINED,
    *names.NAMES,
    unknown.Unknown(),
    distillation.Distillation(),
    names.Tracking(),
    names.EvaluationName(),
    steps.PoseStep(),
    steps.NoStep(),
    other.NotSplats(),
)
# With legs-patch --ssim: nothing is weighted, so neither the images nor what the step trains matter.
SSIM: Tuple[Rule, ...] = (ssim.UnprovenSsim(),)
RULES = {rule.id: rule for rule in (*ORDER, *SSIM)}


def first(term: CallContext, rules: Tuple[Rule, ...] = ORDER) -> Optional[Evidence]:
    """Return the evidence of the first rule that skips a term, or by which a call is not for the loss; None without."""
    for rule in rules:
        deciders = rule.evidence(term) if isinstance(term, Term) else rule.evidence_of_call(term)
        if deciders:
            return Evidence(rule.id, rule.reason, deciders)
    return None
