"""Decide on one form: a site to weight, a term that a rule skips, or a problem that needs a manual edit."""

from __future__ import annotations

import re
from typing import Optional, Sequence, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.parsing import Place
from legs_adapters.code.syntax import arguments, code, one_line
from legs_adapters.lexicon.masks import is_rows, picked_from
from legs_adapters.lexicon.meaning import swapped
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.order import DEFINITION, ORDER, RULES, first, first_of_call
from legs_adapters.rules.rule import CallOfTerm, Term
from legs_adapters.rules.uses import Use, Uses
from legs_adapters.terms.error_maps import reads_of
from legs_adapters.terms.findings import Kept, Left, Problem, Site
from legs_adapters.terms.form import Form
from legs_adapters.terms.kinds.callback import Callback
from legs_adapters.terms.kinds.named import Named
from legs_adapters.terms.kinds.reread import Reread
from legs_adapters.terms.writing import Writing

__all__ = ["Verdicts"]


class Verdicts:
    """Decide on the forms of one program."""

    def __init__(self, analysis: Analysis) -> None:
        self.analysis = analysis
        self.uses: Uses = Uses(analysis)

    def of(self, function: Function, form: Form, place: Place, by_hand: bool) -> Site | Left | Problem:
        """Return the verdict on a form; ``by_hand`` where the user named it as the loss."""
        term = Term(self.analysis, function, form)
        pair = term.pair
        evidence = None if by_hand else first(term, (*DEFINITION, *ORDER))
        if evidence is not None:
            return Left.at(function, place, evidence)
        target_first = swapped(pair.a, pair.b)
        if target_first is None and not by_hand:
            sides = f"{one_line(pair.first)} and {one_line(pair.second)}"
            why = f"cannot tell which of {sides} is the rendering and which the photograph"
            return self.problem(function, form, place, why)
        flipped = bool(target_first)
        if not by_hand and "target" not in (pair.a.role, pair.b.role):
            why = f"nothing shows that {one_line(pair.first if flipped else pair.second)} is a photograph"
            return self.problem(function, form, place, why, flipped)
        picked = None if pair.selection else self._picked(function, form)
        if picked is not None:
            form = Named.of(form, picked[0].value, picked[1].value, _index(picked[0]))
            pair = pair._replace(first=form.first, second=form.second)
        prediction, target = (pair.second, pair.first) if flipped else (pair.first, pair.second)
        if is_rows(self.analysis.meanings, function, pair.first) or is_rows(
            self.analysis.meanings, function, pair.second
        ):
            why = "the sides are lists of pixels: a weight map needs whole images"
            return self.problem(function, form, place, why, flipped)
        if form.why_by_hand():
            return self.problem(function, form, place, form.why_by_hand(), flipped)
        if form.is_named and not function.flow.unchanged_at(form.call, form.first, form.second):
            return self.problem(function, form, place, "the images change before the absolute value is taken", flipped)
        uses = self.uses.of(function, prediction, target)
        others = [(use, use.other) for use in uses if use.other is not None]
        if others and len(others) == len(uses):
            return Left.at(function, place, others[0][1])
        unsettled = self.uses.unsettled(function, uses) if others else None
        if unsettled is not None:  # one body cannot serve both
            use, other = others[0]
            why = f"{function.name} is also called for {other.reason} at {use.where}"
            why += f"; the purpose of the call at {unsettled} is unknown" if unsettled != use.where else ""
            problem = self.problem(function, form, place, why, flipped)
            return problem._replace(advice=problem.advice + _in_a_copy(function, uses))
        loss, others_read = reads_of(self.analysis.training, function, form)
        if others_read and not loss:
            return Left.at(function, place, RULES["untrained"].found(term.here))
        if others_read:
            alone = len(loss) == 1 and loss[0] not in others_read and len(function.flow.reaching(loss[0])) == 1
            if not alone or not function.flow.unchanged(form.first, form.second):
                why = f"{one_line(form.node)} has other uses than the loss"
                return self.problem(function, form, place, why, flipped)
            form = Reread.of(form, loss[0])
            place = function.place(form.node)
        stands = (function.module.path, place.line, place.column, place.last_line)
        kept = tuple(self._kept(function, use, other.reason) for use, other in others)
        selection, why = pair.selection + form.selection, self._why(function, target)
        return Site(*stands, form, flipped, selection, why, function, kept)

    def of_callback(self, holder: Function, callback: Callback) -> Site | Left:
        """Return the verdict on an L1 function that is passed as a callback, from the arguments of its call."""
        term = Term(self.analysis, callback.caller, callback.form)
        unknown = RULES["unknown"].found(term.here)
        evidence = first(term)
        if evidence is None and callback.outer is not None:
            given = [self.analysis.meanings.of(holder, value) for value in arguments(callback.outer)[0][:2]]
            evidence = first_of_call(CallOfTerm(self.analysis, holder, callback.outer, given)) if given else unknown
        if evidence is None and swapped(term.pair.a, term.pair.b) is not False:
            evidence = unknown
        if evidence is not None:
            return Left.at(holder, holder.place(callback.form.node), evidence)
        return self.callable(holder, callback.form)

    @staticmethod
    def callable(function: Function, form: Form) -> Site:
        """Return a callback as a site."""
        place = function.place(form.node)
        stands = (function.module.path, place.line, place.column, place.line)
        return Site(*stands, form, False, "", "passed by name", function)

    @staticmethod
    def _kept(function: Function, use: Use, purpose: str) -> Kept:
        module, line = use.caller.module, use.caller.place(use.call).line
        return Kept(module.path, line, module.lines.text(line), purpose, _called(function), use.call, use.caller)

    def _picked(self, function: Function, form: Form) -> Optional[Tuple[cst.Subscript, cst.Subscript]]:
        """Return ``image[:, mask]`` and ``photo[:, mask]`` of a form that compares names of theirs.

        None where the names have other values, or where image, photo or mask is reassigned before the term.
        """
        if not form.takes_index:
            return None
        one, other = (picked_from(self.analysis.meanings, function, side) for side in (form.first, form.second))
        if one is None or other is None or not function.flow.unchanged_at(form.call, one, other):
            return None
        alike = re.sub(r"\s+", "", _index(one)) == re.sub(r"\s+", "", _index(other))
        return (one, other) if alike else None

    def _why(self, function: Function, target: cst.BaseExpression) -> str:
        """Return what shows that a side is the photograph."""
        name = one_line(target)
        if self.analysis.meanings.origin(function, target).role == "target":
            return f"{name} is the photograph"
        return f"{name} is a parameter" if function.is_parameter(target) else f"{name} is the photograph by its name"

    def problem(self, function: Function, form: Form, place: Place, reason: str, flipped: bool = False) -> Problem:
        """Return a form as a problem, with the advice for the manual edit."""
        rows = any(is_rows(self.analysis.meanings, function, side) for side in (form.first, form.second))
        text = form.advice(Writing(swapped=flipped), rows)
        return Problem.at(function, place, reason, text)


def _index(node: cst.Subscript) -> str:
    return code(node)[len(code(node.value)) :].strip()


def _in_a_copy(function: Function, uses: Sequence[Use]) -> str:
    """Return the advice to weight a copy of a function, for the calls of the loss; empty without such a call."""
    calls = [use.where for use in uses if use.other is None]
    shown = ", ".join(calls[:3]) + (f" and {len(calls) - 3} more" if len(calls) > 3 else "")
    return f", in a copy of {_called(function)} for {shown}" if calls else ""


def _called(function: Function) -> str:
    """Return the name that calls use: for a ``forward`` the name of its class."""
    return function.owner.name if function.owner is not None and function.runs_by_instance else function.name
