"""Select the skipped terms that need a warning, and those that the report omits."""

from __future__ import annotations

from typing import Iterator, NamedTuple, Optional

from legs_adapters.code.module import Function
from legs_adapters.code.parsing import Place
from legs_adapters.code.syntax import one_line, words
from legs_adapters.lexicon.meaning import swapped
from legs_adapters.lexicon.words import EVALUATING
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.order import RULES
from legs_adapters.rules.rule import Rule, Term
from legs_adapters.rules.verdict import Verdicts
from legs_adapters.terms.error_maps import is_asked, is_measured
from legs_adapters.terms.findings import Left, Problem
from legs_adapters.terms.form import Form
from legs_adapters.terms.sides import is_role, pair_of, same_root

__all__ = ["Doubt", "Doubts"]


class Doubt(NamedTuple):
    """A skipped term that may be the loss.

    Attributes:
        problem: the warning.
        is_told_beside_sites: whether to warn also where the codebase has other terms.
    """

    problem: Problem
    is_told_beside_sites: bool = True


class Doubts:
    """Decide which skipped terms of one program need a warning."""

    def __init__(self, analysis: Analysis, verdicts: Verdicts) -> None:
        self.analysis = analysis
        self._verdicts = verdicts

    def is_doubtful(self, function: Function, form: Form, left: Left) -> bool:
        """Return whether a skipped term needs a warning, if nothing else is found."""
        rule, term = _rule(left), Term(self.analysis, function, form)
        if rule is None or not rule.may_be_loss(term):
            return False
        if is_measured(function, form) or EVALUATING & set(words(term.class_name)):
            return False
        pair = term.pair
        pictures = "image" in (pair.a.kind, pair.b.kind)
        pictures = pictures or (function.runs_by_instance and is_role(form.first) and is_role(form.second))
        roles = "target" in (pair.a.role, pair.b.role) or not rule.needs_target
        return pictures and roles and not same_root(form) and not is_asked(function, form)

    def of(self, function: Function, form: Form, place: Place, left: Left) -> Doubt:
        """Return a skipped term as a doubt."""
        term, rule = Term(self.analysis, function, form), _rule(left)
        beside = rule is None or rule.is_doubted_beside_sites
        flipped = bool(swapped(term.pair.a, term.pair.b))
        why = f"nothing shows that this is the loss ({left.reason})"
        return Doubt(self._verdicts.problem(function, form, place, why, flipped), beside)

    def of_uncalled(self, function: Function) -> Iterator[Doubt]:
        """Yield L1 functions that are assigned to names without a call in the codebase: ``base = F.l1_loss``."""
        for name, value in self.analysis.callbacks.uncalled(function):
            why = f"nothing shows where {name} is called"
            advice = f"legs_loss.l1_loss(rendering, photograph, own={one_line(value)}), where it is called"
            yield Doubt(Problem.at(function, function.place(value), why, advice))

    def is_noise(self, function: Function, form: Form, left: Left) -> bool:
        """Return whether an absolute difference is not a loss: of angles, sizes or neighbouring pixels."""
        if form.callee is not None or form.is_mean:
            return False
        rule = _rule(left)
        if rule is None:
            return True
        trained = self.analysis.training.includes(form.node) and rule.is_picture and not same_root(form)
        if trained or rule.is_always_listed:
            return False
        # A difference of a rendering and a photograph is listed where the dataflow analysis may have lost it.
        return not rule.is_listed_for_pictures or not self._compares_pictures(function, form)

    def _compares_pictures(self, function: Function, form: Form) -> bool:
        pair = pair_of(self.analysis.meanings, function, form)
        pictures = pair.a.kind == pair.b.kind == "image" and {pair.a.role, pair.b.role} == {"render", "target"}
        return pictures and not is_measured(function, form) and not is_asked(function, form)


def _rule(left: Left) -> Optional[Rule]:
    return RULES[left.evidence.rule] if left.evidence is not None else None
