"""Skip a term that no backward pass reaches: for scoring, for evaluation, or for an unknown purpose."""

from __future__ import annotations

from typing import AbstractSet, Iterator, List

from legs_adapters.code.calls import likely_calls
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import attribute_chain, call_name, code, words
from legs_adapters.lexicon.words import LOSS, REPORTING, SCORING
from legs_adapters.rules.rule import Rule, Term, header
from legs_adapters.tensors.gradients import is_detached, no_grad_around
from legs_adapters.tensors.operations import ENDS_GRADIENT
from legs_adapters.terms.error_maps import is_measured
from legs_adapters.terms.findings import Decider

MAX_CALLERS = 8


class Scoring(Rule):
    """No backward pass was found that reaches the term, and a name says that it is for densification or pruning.

    skipped:
        def importance_score(camera, image):
            return l1_loss(image, camera.original_image)
    """

    id = reason = "scoring"

    def evidence(self, term: Term) -> List[Decider]:
        return _named(term, SCORING) if _is_untrained(term) else []


class Evaluation(Rule):
    """No backward pass was found that reaches it, and it is under ``no_grad``, or in code that reports or tests.

    skipped:
        with torch.no_grad():
            error = l1_loss(image, gt)
    """

    id = reason = "evaluation"

    def evidence(self, term: Term) -> List[Decider]:
        if not _is_untrained(term):
            return []
        around = no_grad_around(term.function, term.form.call, term.form.node)
        return [around] if around is not None else _named(term, REPORTING)

    def may_be_loss(self, term: Term) -> bool:
        """Return whether the function is named as a loss: only some of its callers may evaluate."""
        return "loss" in words(term.function.name)


class Untrained(Rule):
    """No backward pass was found that reaches the term, and no name says what it is for.

    skipped:
        def compared(camera, image):
            return l1_loss(image, camera.original_image)
    """

    id = reason = "untrained"

    def evidence(self, term: Term) -> List[Decider]:
        if not _is_untrained(term):
            return []
        return term.here if term.analysis.training.touches(term.function) else [header(term.function)]

    def may_be_loss(self, term: Term) -> bool:
        """Return whether a backward pass may reach it unseen: none entered its function, which something may run.

        A gradient that is cut of it, ``error = l1_loss(image, gt).detach()``, makes a weight or a number.
        """
        analysis, function, calls = term.analysis, term.function, term.function.flow.calls_of
        is_cut = any(term.form.node in attribute_chain(cut) for name in ENDS_GRADIENT for cut in calls.get(name, ()))
        return not is_cut and not analysis.training.touches(function) and _may_run(analysis.program, function, 3)


UNTRAINED = (Scoring(), Evaluation(), Untrained())


def _is_untrained(term: Term) -> bool:
    """Return whether no backward pass reaches a term, or it is under ``no_grad``."""
    training, form = term.analysis.training, term.form
    trained = training.includes(form.node) or training.includes(form.call) or _is_called_by_framework(term)
    trained = trained or training.scores(form.node) is not None  # see `NoStep`
    sites = training.sites.get(term.function, [])  # a caller may drop its gradient: an error map for the next mask
    without = bool(sites) and all(no_grad_around(caller, call) for caller, call in sites)
    without = without or no_grad_around(term.function, form.call, form.node) is not None or is_detached(term.prediction)
    return without or not trained or is_measured(term.function, form)


def _may_run(program: Program, function: Function, depth: int) -> bool:
    """Return whether something names a function, and is no function that nothing names."""
    if function.owner is not None or function.decorators or not function.name or depth == 0:
        return True
    others = (each for each in program.mentioning(function.name) if each is not function)
    return any(_names(each, function.name) and _may_run(program, each, depth - 1) for each in others)


def _names(function: Function, name: str) -> bool:
    """Return whether a function, or the top level of a file, reads, calls or imports a name."""
    flow, said = function.flow, [code(node) for node in function.flow.imports]
    return any(name in each for each in said) or name in {*map(call_name, flow.calls), *(r.id for r in flow.reads)}


def _is_called_by_framework(term: Term) -> bool:
    """Return whether it makes the loss of a module's ``forward``, whose caller is chosen at run time (a registry)."""
    training = term.analysis.training
    if not LOSS & set(words(term.function.name)) or not training.roots:
        return False
    above = list(_above(term))
    if any(set(words(function.name)) & (REPORTING | SCORING) for function in above):
        return False
    return any(f.name == "forward" and f.owner is not None and f not in training.sites for f in above)


def _named(term: Term, tokens: AbstractSet[str]) -> List[Decider]:
    """Return the first of the term's function, its class, its callers and their files whose name has one of words."""
    names = list(term.names_around)
    for function in _above(term):
        names += [(name, header(function)) for name in (function.name, function.module.path.rsplit("/", 1)[-1])]
    return [decider for name, decider in names if tokens & set(words(name))][:1]


def _above(term: Term) -> Iterator[Function]:
    """Yield the function of a term, those that call its name, and those that call theirs."""
    above = [term.function]
    for _ in range(3):
        yield from above
        above = [caller for function in above for caller in _callers(term, function)]


def _callers(term: Term, function: Function) -> List[Function]:
    if function.name in ("", "forward") or function.name.startswith("__"):  # any module's has that name
        return []
    calls = likely_calls(term.analysis.program, function)
    return list(dict.fromkeys(caller for caller, _ in calls if caller.parent is not None))[:MAX_CALLERS]
