"""Skip a term that no backward pass reaches: for scoring, for evaluation, or for an unknown purpose."""

from __future__ import annotations

from itertools import islice
from typing import AbstractSet, Iterator, List, Tuple

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import call_name, words
from legs_adapters.lexicon.words import LOSS, REPORTING, SCORING
from legs_adapters.rules.rule import Rule, Term, header
from legs_adapters.tensors.gradients import is_detached, is_without_grad, no_grad_around
from legs_adapters.terms.findings import Decider

__all__ = ["Evaluation", "Scoring", "Untrained"]


class Scoring(Rule):
    """No backward pass reaches the term, and a name says that it is for densification or pruning."""

    VALID = ["loss = l1_loss(image, gt)"]
    INVALID = [
        """
        def importance_score(gaussians, camera):
            image = render(camera, gaussians, None, None)["render"]
            return l1_loss(image, camera.original_image)
        """
    ]

    id = reason = "scoring"

    def evidence(self, term: Term) -> List[Decider]:
        return _named(term, SCORING) if _is_untrained(term) else []


class Evaluation(Rule):
    """No backward pass reaches the term, and it is under ``no_grad``, or in code that reports or tests."""

    VALID = ["loss = l1_loss(image, gt)"]
    INVALID = [
        """
        with torch.no_grad():
            error = l1_loss(image, gt)
        """
    ]

    id = reason = "evaluation"

    def evidence(self, term: Term) -> List[Decider]:
        if not _is_untrained(term):
            return []
        around = no_grad_around(term.function, term.call, term.form.node)
        return [around] if around is not None else _named(term, REPORTING)

    def may_be_loss(self, term: Term) -> bool:
        """Return whether the function is named as a loss: only some of its callers may evaluate."""
        return "loss" in words(term.function.name)


class Untrained(Rule):
    """No backward pass reaches the term, and no name says what it is for."""

    VALID = ["loss = torch.abs(image - gt).mean()"]
    INVALID = [
        """
        def photometric(gaussians, camera):
            image = render(camera, gaussians, None, None)["render"]
            return torch.abs(image - camera.original_image).mean()
        """
    ]

    id = reason = "untrained"
    is_listed_for_pictures = True

    def evidence(self, term: Term) -> List[Decider]:
        if not _is_untrained(term):
            return []
        return term.here if term.analysis.training.touches(term.function) else [header(term.function)]

    def may_be_loss(self, term: Term) -> bool:
        return True


def _is_untrained(term: Term) -> bool:
    """Return whether no backward pass reaches a term, or it is under ``no_grad``."""
    training, form = term.analysis.training, term.form
    trained = training.includes(form.node) or training.includes(form.call) or _is_called_by_framework(term)
    without = is_without_grad(term.function, form.call, form.node) or is_detached(term.prediction)
    return not trained or without or _is_asked_without_grad(term)


def _is_called_by_framework(term: Term) -> bool:
    """Return whether it makes the loss of a module's ``forward``, whose caller is chosen at run time (a registry)."""
    training = term.analysis.training
    if not LOSS & set(words(term.function.name)):
        return False
    above = [term.function, *_callers(term, term.function)]
    above += [caller for callee in above[1:] for caller in _callers(term, callee)]
    if any(set(words(f.name)) & (REPORTING | SCORING) for f in above):
        return False
    return bool(training.roots) and any(
        f.name == "forward" and f.owner is not None and f not in training.sites for f in above
    )


def _is_asked_without_grad(term: Term) -> bool:
    """Return whether every caller drops its gradient: an error map for the next step's mask."""
    sites = term.analysis.training.sites.get(term.function, [])
    return bool(sites) and all(is_without_grad(caller, call) for caller, call in sites)


def _named(term: Term, words_: AbstractSet[str]) -> List[Decider]:
    """Return the first of the term's function, its class and its callers whose name has one of some words."""
    return [decider for name, decider in _names(term) if words_ & set(words(name))][:1]


def _names(term: Term) -> Iterator[Tuple[str, Decider]]:
    yield from term.names_around
    above = queue = [term.function]
    for _ in range(2):
        queue = [caller for callee in queue for caller in _callers(term, callee)]
        above = above + queue
    for function in above:
        yield function.name, header(function)
        yield function.module.path.rsplit("/", 1)[-1], header(function)


def _callers(term: Term, function: Function) -> List[Function]:
    if not function.name or function.name.startswith("__"):
        return []
    callers = (
        caller
        for caller in term.analysis.program.mentioning(function.name, called=True)
        if caller is not function
        and caller.parent is not None
        and any(call_name(call) == function.name for call in caller.flow.calls)
    )
    return list(islice(callers, 8))
