"""Skip a term between two renderings."""

from __future__ import annotations

from typing import List

from legs_adapters.rules.rule import Rule, Term, source_of
from legs_adapters.tensors.gradients import detaches
from legs_adapters.terms.findings import Decider

__all__ = ["Distillation"]


class Distillation(Rule):
    """The target is a rendering: of another model, of another view, or of the same model at an earlier step."""

    id = reason = "distillation"
    needs_target = False
    INVALID = ['teacher_image = render(camera, teacher, None, None)["render"]\nloss = l1_loss(image, teacher_image)']

    def evidence(self, term: Term) -> List[Decider]:
        rendered = term.pair.a.role == term.pair.b.role == "render"
        analysis, target = term.analysis, (term.function, term.target)
        rendered = rendered or "render" in (
            analysis.meanings.origin(*target).role,
            analysis.origins.meaning(*target).role,
        )
        return [source_of(term.function, term.target) or term.here[0]] if rendered else []

    def may_be_loss(self, term: Term) -> bool:
        """Return whether no side is detached; a photograph needs no ``detach()``."""
        return not any(detaches(side) for side in term.sides)
