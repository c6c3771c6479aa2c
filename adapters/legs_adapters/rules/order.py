"""List the rules in the order in which they are checked: the first that applies skips the term."""

from __future__ import annotations

from typing import Optional, Tuple

from legs_adapters.rules.causes import definition, distillation, kinds, names, other, ssim, steps, unknown, untrained
from legs_adapters.rules.rule import Rule, Term
from legs_adapters.terms.findings import Evidence

ORDER: Tuple[Rule, ...] = (
    definition.InDefinition(),
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
RULES = {rule.id: rule for rule in (*ORDER, ssim.UnprovenSsim())}


def first(term: Term) -> Optional[Evidence]:
    """Return the evidence of the first rule that skips a term; None without."""
    found = ((rule, rule.evidence(term)) for rule in ORDER)
    return next((Evidence(rule.id, rule.reason, deciders) for rule, deciders in found if deciders), None)
