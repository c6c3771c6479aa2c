"""Skip a term between two renderings."""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING, List

from legs_adapters.code.module import Function
from legs_adapters.rules.rule import Rule, Term, source_of
from legs_adapters.tensors.gradients import is_detached
from legs_adapters.terms.findings import Decider

if TYPE_CHECKING:
    from legs_adapters.rules.analysis import Analysis


class Distillation(Rule):
    """The target was found to be a rendering: of another model, another view, or an earlier step.

    skipped:
        teacher_image = render(camera, teacher, None, None)["render"]
        loss = l1_loss(image, teacher_image)
    """

    id = reason = "distillation"
    needs_target = False

    def evidence(self, term: Term) -> List[Decider]:
        rendered = term.pair.a.role == term.pair.b.role == "render"
        rendered = rendered or is_rendered(term.analysis, term.function, term.target)
        return [source_of(term.function, term.target) or term.here[0]] if rendered else []

    def may_be_loss(self, term: Term) -> bool:
        """Return whether no side is detached; a photograph needs no ``detach()``."""
        return not any(map(is_detached, term.sides))


def is_rendered(analysis: Analysis, function: Function, target: ast.AST) -> bool:
    """Return whether what is assigned to a target is a rendering, whatever its name."""
    origin, way = analysis.meanings.origin(function, target), analysis.ways.meaning(function, target)
    return "render" in (origin.role, way.role)
