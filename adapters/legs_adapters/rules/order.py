"""List the rules in the order in which they are checked: the first that applies skips the term."""

from __future__ import annotations

from typing import Optional, Tuple

from legs_adapters.rules.causes import (
    definition,
    distillation,
    evaluation,
    features,
    huber,
    kinds,
    other,
    regulariser,
    structural,
    tracking,
    unknown,
    untrained,
    weighting,
)
from legs_adapters.rules.rule import CallOfTerm, Rule, Term
from legs_adapters.terms.findings import Evidence

__all__ = ["AMBIGUOUS", "DEFINITION", "HUBER", "ORDER", "RULES", "SSIM", "UNREAD", "first", "first_of_call"]

DEFINITION = (definition.Definition(),)
ORDER: Tuple[Rule, ...] = (
    # What is compared, as names say.
    kinds.Depth(),
    kinds.Normals(),
    kinds.Features(),
    kinds.Flow(),
    kinds.Mask(),
    kinds.Synthetic(),
    kinds.Gradients(),
    kinds.Parameters(),
    regulariser.Literal(),
    # Whether it is trained.
    untrained.Scoring(),
    untrained.Evaluation(),
    untrained.Untrained(),
    other.NotTorch(),
    # What is compared, at a closer look.
    unknown.Unknown(),
    regulariser.Statistic(),
    features.Scan(),
    kinds.ImageChange(),
    untrained.Leaf(),
    distillation.Distillation(),
    regulariser.OfModel(),
    other.FixedTarget(),
    weighting.Weighting(),
    # What the names around it say.
    tracking.Tracking(),
    evaluation.EvaluationName(),
    kinds.Warping(),
    features.Network(),
    evaluation.EmbeddingFit(),
    other.NotSplats(),
    features.NamedMap(),
    # What its optimiser moves.
    tracking.PoseStep(),
    evaluation.EmbeddingStep(),
    untrained.NoStep(),
)
# Checked by verdict.py separately: HUBER and UNREAD also for a term that the user named.
AMBIGUOUS = (unknown.Ambiguous(),)
HUBER = (huber.Huber(),)
UNREAD = (weighting.ErrorMask(), weighting.UnreadError())
# For SSIM terms, with legs-patch --ssim: nothing is weighted, so the compared images do not matter.
_OF_SSIM = (
    structural.Library(),
    structural.Settings(),
    structural.Value(),
    structural.Unproven(),
    structural.Twice(),
)
_OF_TRAINING = (
    untrained.Scoring,
    untrained.Evaluation,
    untrained.Untrained,
    other.NotTorch,
    tracking.Tracking,
    evaluation.EvaluationName,
    evaluation.EmbeddingFit,
    tracking.PoseStep,
    evaluation.EmbeddingStep,
    untrained.NoStep,
)
SSIM: Tuple[Rule, ...] = (
    structural.Definition(),
    *(rule for rule in ORDER if isinstance(rule, _OF_TRAINING)),
    *_OF_SSIM,
)
RULES = {rule.id: rule for rule in (*DEFINITION, *ORDER, *AMBIGUOUS, *HUBER, *UNREAD, *SSIM)}


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
