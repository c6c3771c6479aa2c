"""Classify the calls of a function that compares two images: for the loss, or for something else."""

from __future__ import annotations

import ast
from typing import Iterator, List, Optional, Sequence, Tuple

from legs_adapters.code.calls import likely_calls
from legs_adapters.code.module import Function
from legs_adapters.code.syntax import arguments, one_line, words_in
from legs_adapters.lexicon.meaning import Meaning, swapped
from legs_adapters.lexicon.words import TRACKING
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.causes.distillation import is_rendered
from legs_adapters.rules.causes.kinds import KINDS
from legs_adapters.rules.order import RULES
from legs_adapters.rules.rule import Term
from legs_adapters.terms.findings import Evidence, Use
from legs_adapters.terms.sides import surest, without_shared_factors

_Call = Tuple[Function, ast.Call, List[Optional[ast.expr]]]
_DEPTH = 3  # functions that hand on what they are given


def uses_of(analysis: Analysis, term: Term) -> List[Use]:
    """Classify the calls, in the training step, of a function that compares two pictures."""
    found: List[Use] = []
    function, (prediction, target) = term.function, without_shared_factors(term.prediction, term.target)
    names = [side.id for side in (prediction, target) if isinstance(side, ast.Name)]
    is_given = isinstance(target, ast.Name) and target.id in function.parameters
    for caller, call, sides in _calls(analysis, function, names):
        image = sides[-1] if is_given else None
        if is_given and arguments(call)[2]:  # starred
            found.append(Use(caller, call, None, False))
        elif image is None and not TRACKING & words_in(call):  # the step decides; in the others a branch may
            found.append(Use(caller, call, analysis.purposes.of_call(function, term.form.call, caller, call), True))
        elif image is not None:
            both = [side for side in sides if side is not None]
            answers = surest(analysis.meanings, analysis.ways, caller, both)
            given = [answers.meaning(caller, side) for side in both]
            other = _why_other(analysis, caller, call, given, is_rendered(analysis, caller, image))
            is_loss = given[0].kind == "image" and given[-1].role == "target"
            is_loss = is_loss and (len(given) == 1 or swapped(*given) is False)
            is_masked = target is not term.target  # for the loss, unless known to be for something else
            found.append(Use(caller, call, other, is_loss or is_masked or other is not None, one_line(image)))
    return sorted(found, key=lambda use: (use.caller.module.path, use.caller.place(use.call).line))


def _calls(analysis: Analysis, function: Function, names: Sequence[str], depth: int = 0) -> Iterator[_Call]:
    """Yield the calls that give a function these parameters, past callers that only hand on their own."""
    sites = analysis.training.sites
    for caller, call in sites.get(function) or likely_calls(analysis.program, function):
        sides = [function.given(call, name) for name in names]
        own = [side.id for side in sides if isinstance(side, ast.Name) and caller.is_parameter(side)]
        if len(own) == len(names) and caller in sites and depth < _DEPTH:
            yield from _calls(analysis, caller, own, depth + 1)
        else:
            yield caller, call, sides


def _why_other(
    analysis: Analysis, caller: Function, call: ast.Call, given: Sequence[Meaning], is_drawn: bool
) -> Optional[Evidence]:
    """Return the evidence that a call is not for the loss: by what it is given, or by the step after it."""
    rules = [rule.id for meaning in given for rule in KINDS if rule.kind == meaning.kind]
    rules += ["distillation"] if is_drawn or given[-1].role == "render" else []
    if not rules:
        return analysis.purposes.purpose(caller, call)
    return Evidence(rules[0], RULES[rules[0]].reason, [(caller, call)])
