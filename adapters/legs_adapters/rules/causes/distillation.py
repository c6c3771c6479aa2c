"""Skip a term between two renderings."""

from __future__ import annotations

from typing import List

from legs_adapters.lexicon.renderings import is_rendering
from legs_adapters.rules.rule import CallOfTerm, Rule, Term, source_of
from legs_adapters.tensors.gradients import detaches
from legs_adapters.terms.findings import Decider

__all__ = ["Distillation"]


class Distillation(Rule):
    """The target is a rendering: of another model, of another view, or of the same model at an earlier step."""

    VALID = ["loss = l1_loss(image, gt)"]
    INVALID = [
        """
        teacher_image = render(camera, teacher, None, None)["render"]
        loss = l1_loss(image, teacher_image)
        """
    ]

    id = reason = "distillation"
    is_always_listed = True
    needs_target = False

    def evidence(self, term: Term) -> List[Decider]:
        pair, meanings = term.pair, term.analysis.meanings
        rendered = pair.a.role == pair.b.role == "render"
        rendered = rendered or meanings.origin(term.function, term.target).role == "render"
        rendered = rendered or is_rendering(term.function, term.target)
        return [source_of(term.function, term.target) or term.here[0]] if rendered else []

    def of_call(self, call: CallOfTerm) -> List[Decider]:
        return call.here if call.given[-1].role == "render" else []

    def may_be_loss(self, term: Term) -> bool:
        """Return whether no side is detached; a photograph needs no ``detach()``."""
        return not any(detaches(side) for side in term.sides)
