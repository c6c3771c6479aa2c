"""List the rules in the order in which they are checked: the first that applies skips the term."""

from __future__ import annotations

from typing import Optional, Tuple

from legs_adapters.rules.causes import (
    definition,
    distillation,
    kinds,
    names,
    other,
    steps,
    structural,
    unknown,
    untrained,
)
from legs_adapters.rules.rule import CallOfTerm, Rule, Term
from legs_adapters.terms.findings import Evidence

__all__ = ["DEFINITION", "ORDER", "RULES", "SSIM", "first", "first_of_call"]

DEFINITION = (definition.Definition(),)
_UNTRAINED = (untrained.Scoring(), untrained.Evaluation(), untrained.Untrained())
_OF_THE_STEP = (names.Tracking(), names.EvaluationName(), steps.PoseStep(), steps.EmbeddingStep(), steps.NoStep())
ORDER: Tuple[Rule, ...] = (
    *kinds.KINDS,
    *_UNTRAINED,
    *names.NAMES,
    unknown.Unknown(),
    distillation.Distillation(),
    *_OF_THE_STEP,
    other.NotSplats(),
)
# For SSIM terms, with legs-patch --ssim: nothing is weighted, so the compared images do not matter.
_OF_SSIM = (
    structural.Library(),
    structural.Settings(),
    structural.Unproven(),
    structural.Twice(),
)
SSIM: Tuple[Rule, ...] = (structural.Definition(), *_UNTRAINED, *_OF_THE_STEP, *_OF_SSIM)
RULES = {rule.id: rule for rule in (*DEFINITION, *ORDER, *SSIM)}


def first(term: Term, rules: Tuple[Rule, ...] = ORDER) -> Optional[Evidence]:
    """Return the evidence of the first rule that skips a term; None where it is weighted."""
    for rule in rules:
        deciders = rule.evidence(term)
        if deciders:
            return rule.found(deciders)
    return None


def first_of_call(call: CallOfTerm) -> Optional[Evidence]:
    """Return the evidence of the first rule by which a call is not for the loss; None where it may be."""
    for rule in ORDER:
        deciders = rule.of_call(call)
        if deciders:
            return rule.found(deciders)
    return None
