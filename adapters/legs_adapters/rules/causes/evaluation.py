"""Skip a term of evaluation code: by the names around it, or by the parameters of its optimiser."""

from __future__ import annotations

from typing import List

from legs_adapters.code.syntax import words
from legs_adapters.lexicon.words import EMBEDDING, EVALUATING, FITTING, LOSS, NOT_TRAINING
from legs_adapters.rules.rule import ByPurpose, CallOfTerm, Rule, Term, header
from legs_adapters.terms.findings import Decider

__all__ = ["EmbeddingFit", "EmbeddingStep", "EvaluationName", "EvaluationRule", "is_of_evaluating_class"]


class EvaluationRule(Rule):
    """Skip a term of an evaluation."""

    reason = "evaluation"

    def may_be_loss(self, term: Term) -> bool:
        """Return whether the function is named as a loss: only some of its callers may evaluate."""
        return "loss" in words(term.function.name)


class EvaluationName(EvaluationRule):
    """The name of the function, its file or its folder is about rendering, testing or evaluation.

    left:
        def evaluate_views(gaussians, cameras):
            for camera in cameras:
                image = render(camera, gaussians, None, None)["render"]
                loss = l1_loss(image, camera.original_image)
                loss.backward()

    weighted: loss = l1_loss(image, gt)
    """

    id = "evaluation-name"

    def evidence(self, term: Term) -> List[Decider]:
        function, purposes = term.function, term.analysis.purposes
        said = words(function.name)
        shows = len(said) > 1 and said[0] in NOT_TRAINING and not LOSS & set(said[1:])
        if shows and not _is_of_training_step(term) and not purposes.trains_its_own(function):
            return [header(function)]
        folders, _, file = function.module.path.rpartition("/")
        evaluates = (words(file)[:1] and words(file)[0] in EVALUATING) or set(folders.split("/")) & EVALUATING
        return term.here if evaluates and not purposes.trains_its_own(function) else []

    def of_call(self, call: CallOfTerm) -> List[Decider]:
        said = set(words(call.function.name))
        return [header(call.function)] if said & EVALUATING and "train" not in said else []


class EmbeddingFit(EvaluationRule):
    """The name of the function says that it fits the embedding of a test view.

    left:
        def optimize_embedding(gaussians, camera):
            image = render(camera, gaussians, None, None)["render"]
            loss = l1_loss(image, camera.original_image)
            loss.backward()
            gaussians.optimizer.step()

    weighted: loss = l1_loss(image, gt)
    """

    id = "embedding-fit"

    def evidence(self, term: Term) -> List[Decider]:
        names = (term.function.name, *term.function.flow.conditions.get(id(term.call), ()))
        spoken = {word for name in names for word in words(name)}
        fits = EMBEDDING & spoken and spoken & FITTING
        return [header(term.function)] if fits else []


class EmbeddingStep(ByPurpose, EvaluationRule):
    """The optimiser updates an embedding only, to fit a test view.

    left:
        def adapt(gaussians, camera, embedding):
            optimizer = torch.optim.Adam([embedding], lr=0.1)
            for _ in range(100):
                image = render(camera, gaussians, embedding, None)["render"]
                loss = l1_loss(image, camera.original_image)
                loss.backward()
                optimizer.step()

    weighted: loss = l1_loss(image, gt)
    """

    id = "embedding-step"


def is_of_evaluating_class(term: Term) -> bool:
    """Return whether the name of the term's class is about evaluation: ``TestLoss``."""
    return bool(set(words(term.class_name)) & EVALUATING)


def _is_of_training_step(term: Term) -> bool:
    """Return whether it returns a loss to functions whose names say that they train: ``render_batch``."""
    callers = [caller for caller, _ in term.analysis.training.sites.get(term.function, [])]
    return bool(callers) and all("train" in words(caller.name) for caller in callers)
