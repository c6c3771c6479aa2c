"""Skip a term by the names around it: of its function, its class, its file, or a condition."""

from __future__ import annotations

from typing import AbstractSet, List

from legs_adapters.code.syntax import names_where, root_of, words
from legs_adapters.lexicon.words import (
    EVALUATING,
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
from legs_adapters.rules.rule import Rule, Term, header
from legs_adapters.terms.findings import Decider


class Tracking(Rule):
    """The name of the function, its class or a condition around the term is about tracking.

    skipped:
        def track_camera(image, gt):
            l1_loss(image, gt).backward()
    skipped:
        def refine_pose(image, gt):
            l1_loss(image, gt).backward()
    """

    id = reason = "tracking"

    def evidence(self, term: Term) -> List[Decider]:
        names = () if term.trains_gaussians else term.names_around
        named = [decider for name, decider in names if _is_of_tracking(name)]
        tests = reversed(term.function.flow.contexts.get(id(term.form.call), ()))
        true = [name for test in tests for name in reversed(names_where(test, True)) if _is_of_tracking(root_of(name))]
        return [*named, *((term.function, name) for name in true)][:1]


class EvaluationName(Rule):
    """The name of the function, its file or its folder is about rendering or testing.

    skipped:
        def evaluate_views(image, gt):
            l1_loss(image, gt).backward()
    """

    id = "evaluation-name"
    reason = "evaluation"

    def evidence(self, term: Term) -> List[Decider]:
        first, *others = words(term.function.name) or ("",)
        folders, _, file = term.function.module.path.rpartition("/")
        shows = first in NOT_TRAINING and bool(others) and not LOSS & set(others)
        shows = shows or bool(set(folders.split("/")) & EVALUATING) or words(file)[0] in EVALUATING
        return [header(term.function)] if shows and not term.trains_gaussians else []

    def may_be_loss(self, term: Term) -> bool:
        """Return whether the function is named as a loss: only some of its callers may evaluate."""
        return "loss" in words(term.function.name)


class OtherName(Rule):
    """{why}

    skipped:
        def {name}(cam, image):
            l1_loss(image, cam.original_image).backward()
    """

    def __init__(self, id: str, reason: str, words: AbstractSet[str], why: str, name: str) -> None:
        """Make the rule of a list of words in the name of a function, its class or its file; a row of `NAMES`."""
        self.id: str = id
        self.reason: str = reason
        self.words: AbstractSet[str] = words
        self.__doc__ = str(OtherName.__doc__).format(why=why, name=name)

    def evidence(self, term: Term) -> List[Decider]:
        """Return the first name that has one of the words, unless both sides are proven.

        There may be features beside them still, or a threshold taken of an error map.
        """
        module = term.function.module
        names = [(name, decider) for name, decider in term.names_around if not SPLATS.search(name)]
        file = [(module.path.rpartition("/")[2], header(term.function))]
        names += file if self.words & {*words(file[0][0])} and "gaussian" not in module.text.lower() else []
        found = [decider for name, decider in names if self.words & set(words(name))][:1]
        outweighs = self.id != "perceptual" and (self.id != "robust" or term.form.makes != "none")
        return [] if outweighs and term.pair.is_proven else found

    def may_be_loss(self, term: Term) -> bool:
        """Return whether the name may mean something else: it is reported where no other term was found."""
        return self.id != "robust"


NAMES = (
    OtherName("warping", "synthetic", WARPED, "A name says that one view is warped into another.", "reprojection"),
    OtherName("perceptual", "features", PERCEPTUAL, "A name is of a perceptual loss, perhaps of features.", "vgg"),
    OtherName("mesh", "mesh", MESH, "A name is of a mesh: nothing proves that Gaussians are drawn.", "train_texture"),
    OtherName("robust", "huber", ROBUST, "A name is of a robust loss: a weight may move its threshold.", "huber"),
)


def _is_of_tracking(name: str) -> bool:
    """Return whether a name is about optimising poses: for tracking, or to align a view."""
    tokens = set(words(name))
    return bool(("pose" in tokens and tokens & {"test", "refine"}) or (tokens & TRACKING and not tokens & MAPPING))
