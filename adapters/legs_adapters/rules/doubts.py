"""Which of the terms that were left a person should look at, and which are not worth a line in the report."""

from __future__ import annotations

from typing import NamedTuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.parsing import Place
from legs_adapters.code.syntax import one_line, walk_expressions, words
from legs_adapters.lexicon.meaning import swapped
from legs_adapters.lexicon.names import kind_of_words
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.verdict import Verdicts
from legs_adapters.tensors.gradients import detaches
from legs_adapters.terms.error_maps import is_asked, is_huber, is_measured
from legs_adapters.terms.findings import Left, Problem
from legs_adapters.terms.form import Form
from legs_adapters.terms.sides import is_role, pair_of, same_root

__all__ = ["Doubt", "Doubts"]

_FORWARD = ("forward", "__call__")
_PICTURES = {"depth", "normals", "features", "flow", "mask"}  # what else is compared in a training step


class Doubt(NamedTuple):
    """A term that was left and may be the loss after all: what to tell a person, and the reason why it was left."""

    problem: Problem
    reason: str


class Doubts:
    """Tells for the terms of one program that were left whether a person should look at them."""

    def __init__(self, analysis: Analysis, verdicts: Verdicts) -> None:
        self.analysis = analysis
        self._verdicts = verdicts

    def is_doubtful(self, function: Function, form: Form, left: Left) -> bool:
        """Whether a person should have a look at what was left, if nothing else is found."""
        of_class = function.owner is not None and "loss" in words(function.name)
        in_module = left.reason == "definition" and (function.name in _FORWARD or of_class)
        by_callers = left.reason == "evaluation" and "loss" in words(function.name)  # some of whose names say so
        known = left.reason in ("untrained", "unknown", "distillation", "other", "huber")
        known = known or (left.reason == "synthetic" and not _says_warped(form))  # of some callers, perhaps
        if not (in_module or by_callers or known):
            return False
        if is_measured(function, form) or self.analysis.reasons.evaluates(function):
            return False
        if left.reason == "distillation" and (detaches(form.first) or detaches(form.second)):
            return False
        pair = pair_of(self.analysis.meanings, function, form)
        pictures = "image" in (pair.a.kind, pair.b.kind)
        pictures = pictures or (function.name in _FORWARD and is_role(form.first) and is_role(form.second))
        roles = "target" in (pair.a.role, pair.b.role) or left.reason in ("distillation", "huber")
        return pictures and roles and not same_root(form) and not is_asked(function, form)

    def of(self, function: Function, form: Form, place: Place, reason: str) -> Doubt:
        """Return a form that was left for a reason as a doubt."""
        pair = pair_of(self.analysis.meanings, function, form)
        flipped = bool(swapped(pair.a, pair.b))
        if not is_huber(self.analysis.training, function, form):
            why = f"nothing shows that this is the loss ({reason})"
            return Doubt(self._verdicts.problem(function, form, place, why, flipped), reason)
        why = "this is a Huber loss: a weight in it would move its threshold"
        target = one_line(form.first if flipped else form.second)
        advice = f"legs_loss.weight_map({target}) times the loss, before its mean"
        return Doubt(self._verdicts.problem(function, form, place, why)._replace(advice=advice), "huber")

    def is_noise(self, function: Function, form: Form, left: Left) -> bool:
        """An absolute difference that is no loss: of angles, sizes, neighbouring pixels."""
        if form.callee is not None or form.is_mean:
            return False
        trained = self.analysis.training.includes(form.node) and left.reason in _PICTURES and not same_root(form)
        if trained or left.reason in ("definition", "tracking", "distillation", "huber"):
            return False
        # Of a rendering and a photograph it is said all the same, where it may be that the trail was lost.
        return left.reason != "untrained" or not self._compares_pictures(function, form)

    def _compares_pictures(self, function: Function, form: Form) -> bool:
        pair = pair_of(self.analysis.meanings, function, form)
        pictures = pair.a.kind == pair.b.kind == "image" and {pair.a.role, pair.b.role} == {"render", "target"}
        return pictures and not is_measured(function, form) and not is_asked(function, form)


def _says_warped(form: Form) -> bool:
    """Whether a side itself speaks of a picture that is no photograph."""
    parts = [*walk_expressions(form.first), *walk_expressions(form.second)]
    said = [part.value for part in parts if isinstance(part, (cst.Name, cst.SimpleString))]
    return any(kind_of_words(text) == "warp" for text in said)
