"""List the rules in the order in which they are asked: the first that applies is why a term is left."""

from __future__ import annotations

from typing import Optional, Tuple

from legs_adapters.rules.causes.definition import Definition
from legs_adapters.rules.causes.distillation import Distillation
from legs_adapters.rules.causes.evaluation import EmbeddingFit, EmbeddingStep, EvaluationName
from legs_adapters.rules.causes.features import NamedMap, Network, Scan
from legs_adapters.rules.causes.huber import Huber
from legs_adapters.rules.causes.kinds import (
    Depth,
    Features,
    Flow,
    Gradients,
    ImageChange,
    Mask,
    Normals,
    Parameters,
    Synthetic,
    Warping,
)
from legs_adapters.rules.causes.not_torch import NotTorch
from legs_adapters.rules.causes.other import FixedTarget, NotSplats
from legs_adapters.rules.causes.regulariser import Literal, OfModel, Statistic
from legs_adapters.rules.causes.tracking import PoseStep, Tracking
from legs_adapters.rules.causes.unknown import Ambiguous, Unknown
from legs_adapters.rules.causes.untrained import Evaluation, Leaf, NoStep, Scoring, Untrained
from legs_adapters.rules.causes.weighting import ErrorMask, UnreadError, Weighting
from legs_adapters.rules.rule import CallOfTerm, Rule, Term
from legs_adapters.terms.findings import Evidence

__all__ = ["AMBIGUOUS", "DEFINITION", "HUBER", "ORDER", "RULES", "UNREAD", "first", "first_of_call"]

DEFINITION = (Definition(),)
ORDER: Tuple[Rule, ...] = (
    # What is compared, as names say.
    *(Depth(), Normals(), Features(), Flow(), Mask(), Synthetic(), Gradients(), Parameters(), Literal()),
    # Whether it is trained.
    *(Scoring(), Evaluation(), Untrained(), NotTorch()),
    # What is compared, at a closer look.
    *(Unknown(), Statistic(), Scan(), ImageChange(), Leaf(), Distillation(), OfModel(), FixedTarget(), Weighting()),
    # What the names around it say.
    *(Tracking(), EvaluationName(), Warping(), Network(), EmbeddingFit(), NotSplats(), NamedMap()),
    # What its optimiser moves.
    *(PoseStep(), EmbeddingStep(), NoStep()),
)
# Asked only once it is known which side is which, of a term that a person chose too.
AMBIGUOUS = (Ambiguous(),)
HUBER = (Huber(),)
UNREAD = (ErrorMask(), UnreadError())
RULES = {rule.id: rule for rule in (*DEFINITION, *ORDER, *AMBIGUOUS, *HUBER, *UNREAD)}


def first(term: Term, rules: Tuple[Rule, ...] = ORDER) -> Optional[Evidence]:
    """Return the evidence of the first rule that leaves a term; None where it is to be weighted."""
    for rule in rules:
        deciders = rule.evidence(term)
        if deciders:
            return Evidence(rule.id, rule.reason, deciders)
    return None


def first_of_call(call: CallOfTerm) -> Optional[Evidence]:
    """Return the evidence of the first rule that says a call is not for the loss; None where it may be."""
    for rule in ORDER:
        deciders = rule.of_call(call)
        if deciders:
            return Evidence(rule.id, rule.reason, deciders)
    return None
