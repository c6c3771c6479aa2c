"""Skip a term by the names around it: of its function, its class, its file, or a condition."""

from __future__ import annotations

from typing import AbstractSet, List

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import call_name, walk_all, words
from legs_adapters.lexicon.words import (
    EMBEDDING,
    EVALUATING,
    FITTING,
    GAUSSIANS,
    LOSS,
    MAPPING,
    MESH,
    NOT_TRAINING,
    PERCEPTUAL,
    ROBUST,
    SPLATS,
    TRACKING,
    WARPED,
)
from legs_adapters.rules.rule import CallContext, CallOfTerm, Rule, Term, header
from legs_adapters.tensors.steps import has_step
from legs_adapters.terms.findings import Decider

__all__ = ["NAMES", "EvaluationName", "OtherName", "Tracking"]


class Tracking(Rule):
    """The name of the function, its class or a condition around the term is about tracking."""

    id = reason = "tracking"
    is_always_listed = True
    VALID = ["loss = l1_loss(image, gt)"]
    INVALID = [
        """
        def track_camera(gaussians, camera):
            image = render(camera, gaussians, None, None)["render"]
            loss = l1_loss(image, camera.original_image)
            loss.backward()
            camera.optimizer.step()
        """
    ]

    def evidence(self, term: CallContext) -> List[Decider]:
        named = [decider for name, decider in term.names_around if _is_of_tracking(name)]
        return (named or [(term.function, part) for part in _condition(term)])[:1]

    def of_call(self, call: CallOfTerm) -> List[Decider]:
        return self.evidence(call)


class EvaluationName(Rule):
    """The name of the function is about rendering, testing or fitting an embedding to a test view."""

    id = "evaluation-name"
    reason = "evaluation"
    VALID = ["loss = l1_loss(image, gt)"]
    INVALID = [
        """
        def evaluate_views(gaussians, cameras):
            for camera in cameras:
                image = render(camera, gaussians, None, None)["render"]
                loss = l1_loss(image, camera.original_image)
                loss.backward()
        """,
        """
        def optimize_embedding(gaussians, camera):
            image = render(camera, gaussians, None, None)["render"]
            loss = l1_loss(image, camera.original_image)
            loss.backward()
            gaussians.optimizer.step()
        """,
    ]

    def evidence(self, term: Term) -> List[Decider]:
        first, *others = words(term.function.name) or ("",)
        spoken, (folders, _, file) = {first, *others}, term.function.module.path.rpartition("/")
        shows = first in NOT_TRAINING and bool(others) and not LOSS & set(others) and not _is_of_training_step(term)
        shows = shows or bool(set(folders.split("/")) & EVALUATING) or words(file)[0] in EVALUATING
        shows = shows and not _trains_its_own(term.function)
        return [header(term.function)] if shows or (spoken & EMBEDDING and spoken & FITTING) else []

    def of_call(self, call: CallOfTerm) -> List[Decider]:
        spoken = set(words(call.function.name))
        return [header(call.function)] if spoken & EVALUATING and "train" not in spoken else []

    def may_be_loss(self, term: Term) -> bool:
        """Return whether the function is named as a loss: only some of its callers may evaluate."""
        return "loss" in words(term.function.name)


class OtherName(Rule):
    """Skip a term by a word in the name of its function, its class or its file; a row of `NAMES` for each."""

    is_always_listed = True
    VALID = ["loss = l1_loss(image, gt)"]

    def __init__(self, id: str, reason: str, words: AbstractSet[str], why: str, invalid: str) -> None:
        self.id: str = id
        self.reason: str = reason
        self.words: AbstractSet[str] = words
        self.why: str = why
        self.INVALID: List[str] = [invalid]

    def evidence(self, term: Term) -> List[Decider]:
        """Return the first name that has one of the words."""
        module = term.function.module
        names = [(name, decider) for name, decider in term.names_around if not SPLATS.search(name)]
        names += [] if SPLATS.search(module.text) else [(module.path.rpartition("/")[2], header(term.function))]
        return [decider for name, decider in names if self.words & set(words(name))][:1]

    def may_be_loss(self, term: Term) -> bool:
        """Return whether the name may mean something else: it is told where no other term was found."""
        return True


_OF_A_NETWORK = """
def perceptual_loss(network, image, gt):
    image_layer, gt_layer = network(image), network(gt)
    return l1_loss(image_layer, gt_layer)

def training(gaussians, camera, network):
    image = render(camera, gaussians, None, None)["render"]
    loss = perceptual_loss(network, image, camera.original_image)
    loss.backward()
    gaussians.optimizer.step()
"""
_OF_A_MESH = """
def train_texture(texture, camera):
    image = render(camera, texture, None, None)["render"]
    loss = l1_loss(image, camera.original_image)
    loss.backward()
    texture.optimizer.step()
"""
_OF_A_THRESHOLD = """
def huber(image, gt):
    error = torch.abs(image - gt)
    return torch.where(error < 0.1, error ** 2 / 0.2, error - 0.05).mean()

def training(gaussians, camera):
    image = render(camera, gaussians, None, None)["render"]
    huber(image, camera.original_image).backward()
    gaussians.optimizer.step()
"""
_OF_ANOTHER_VIEW = """
def reprojection(gaussians, camera):
    image = render(camera, gaussians, None, None)["render"]
    loss = l1_loss(image, camera.original_image)
    loss.backward()
    gaussians.optimizer.step()
"""
NAMES = (
    OtherName("warping", "synthetic", WARPED, "A name says that one view is warped into another.", _OF_ANOTHER_VIEW),
    OtherName(
        "perceptual", "features", PERCEPTUAL, "A name is of a perceptual loss: its sides are features.", _OF_A_NETWORK
    ),
    OtherName("mesh", "other", MESH, "A name is of a mesh: no Gaussians are drawn.", _OF_A_MESH),
    OtherName(
        "robust", "huber", ROBUST, "A name is of a robust loss: a weight would move its threshold.", _OF_A_THRESHOLD
    ),
)


def _condition(term: CallContext) -> List[cst.CSTNode]:
    """Return the names about tracking in the conditions around a call; the call itself where there are none."""
    named = [name for name in term.function.flow.conditions.get(id(term.call), ()) if _is_of_tracking(name)]
    if not named:
        return []
    branches = [part for part in walk_all(term.function.body) if isinstance(part, (cst.If, cst.IfExp))]
    inside = [[id(part) for part in walk_all(branch)] for branch in branches]
    around = sorted((len(ids), at) for at, ids in enumerate(inside) if id(term.call) in ids)
    tests = [branches[at].test for _, at in around]  # the innermost first
    parts = [part for test in tests for part in walk_all(test) if isinstance(part, cst.Name) and part.value in named[0]]
    return [*parts, term.call]


def _is_of_tracking(name: str) -> bool:
    """Return whether a name is about optimising poses: for tracking, or to align a test view."""
    spoken = set(words(name))
    return {"test", "pose"} <= spoken or bool(spoken & TRACKING and not spoken & MAPPING)


def _trains_its_own(function: Function) -> bool:
    """Return whether it makes a Gaussian model and steps an optimiser: it trains, whatever its name."""
    names = map(call_name, function.flow.calls)
    makes = any(name[:1].isupper() and set(words(name)) & GAUSSIANS for name in names)
    return makes and has_step(function)


def _is_of_training_step(term: Term) -> bool:
    """Return whether it returns a loss to functions whose names say that they train: ``render_batch``."""
    callers = [caller for caller, _ in term.analysis.training.sites.get(term.function, [])]
    return bool(callers) and all("train" in words(caller.name) for caller in callers)
