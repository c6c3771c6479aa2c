"""Skip a term that no backward pass reaches: for scoring, for evaluation, or for an unknown purpose."""

from __future__ import annotations

from itertools import islice
from typing import AbstractSet, Iterator, List, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import call_name, words
from legs_adapters.lexicon.words import LOSS, REPORTING, SCORING
from legs_adapters.rules.causes.evaluation import EvaluationRule
from legs_adapters.rules.rule import ByPurpose, Rule, Term, header
from legs_adapters.tensors.gradients import is_without_grad, no_grad_around
from legs_adapters.tensors.operations import JOINS
from legs_adapters.terms.findings import Decider

__all__ = ["Evaluation", "Leaf", "NoStep", "Scoring", "Untrained"]


class _Scoring(Rule):
    reason = "scoring"


class Scoring(_Scoring):
    """No backward pass reaches the term, and a name says that it is for densification or pruning.

    left:
        def importance_score(gaussians, camera):
            image = render(camera, gaussians, None, None)["render"]
            return l1_loss(image, camera.original_image)

    weighted: loss = l1_loss(image, gt)
    """

    id = "scoring"

    def evidence(self, term: Term) -> List[Decider]:
        return _said(term, SCORING) if _is_untrained(term) else []


class NoStep(ByPurpose, _Scoring):
    """No optimiser uses the gradients: they are read to score the Gaussians, then discarded.

    left:
        def drop_unseen(gaussians, cameras):
            for camera in cameras:
                image = render(camera, gaussians, None, None)["render"]
                l1_loss(image, camera.original_image).backward()
                weight = gaussians.points.grad.norm()
                gaussians.optimizer.zero_grad()

    weighted: loss = l1_loss(image, gt)
    """

    id = "no-step"


class Evaluation(EvaluationRule):
    """No backward pass reaches the term, and it is under ``no_grad``, or in code that reports or tests.

    left:
        with torch.no_grad():
            error = l1_loss(image, gt)

    weighted: loss = l1_loss(image, gt)
    """

    id = "evaluation"

    def evidence(self, term: Term) -> List[Decider]:
        if not _is_untrained(term):
            return []
        around = no_grad_around(term.function, term.call, term.form.node)
        return [around] if around is not None else _said(term, REPORTING)


class _Untrained(Rule):
    reason = "untrained"
    is_listed_for_pictures = True

    def may_be_loss(self, term: Term) -> bool:
        return True


class Untrained(_Untrained):
    """No backward pass reaches the term, and no name says what it is for.

    left:
        def photometric(gaussians, camera):
            image = render(camera, gaussians, None, None)["render"]
            return torch.abs(image - camera.original_image).mean()

    weighted: loss = torch.abs(image - gt).mean()
    """

    id = "untrained"

    def evidence(self, term: Term) -> List[Decider]:
        if not _is_untrained(term):
            return []
        return term.here if term.analysis.training.touches(term.function) else [header(term.function)]


class Leaf(_Untrained):
    """One side is a leaf tensor that requires a gradient, not a rendering.

    left:
        image = torch.tensor(camera.pixels).requires_grad_()
        loss = l1_loss(image, gt)

    weighted: loss = l1_loss(image, gt)
    """

    id = "leaf"

    def evidence(self, term: Term) -> List[Decider]:
        return [found for side in term.sides for found in _leaves(term.function, side)][:1]


def _is_untrained(term: Term) -> bool:
    """Return whether no backward pass reaches a term, or it is under ``no_grad``."""
    training, form = term.analysis.training, term.form
    trained = training.includes(form.node) or training.includes(form.call) or _is_called_by_framework(term)
    return not trained or is_without_grad(term.function, form.call, form.node) or _is_asked_without_grad(term)


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


def _said(term: Term, spoken: AbstractSet[str]) -> List[Decider]:
    """Return the first of the term's function, its class and its callers whose name has one of some words."""
    return [decider for name, decider in _names(term) if spoken & set(words(name))][:1]


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


def _leaves(function: Function, node: cst.CSTNode) -> List[Decider]:
    """Return the calls that make a leaf tensor, ``torch.tensor(array).requires_grad_()``.

    ``torch.cat(images).requires_grad_()`` keeps the gradients of renderings.
    """
    calls = [
        value
        for value in function.flow.assigned(node)
        if isinstance(value, cst.Call) and call_name(value) == "requires_grad_"
    ]
    bases = [(call, call.func.value) for call in calls if isinstance(call.func, cst.Attribute)]
    return [(function, call) for call, of in bases if not (isinstance(of, cst.Call) and call_name(of) in JOINS)]
