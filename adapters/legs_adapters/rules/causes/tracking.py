"""Skip a term of camera tracking: by the names around it, or by the parameters of its optimiser."""

from __future__ import annotations

from typing import List

import libcst as cst

from legs_adapters.code.syntax import walk_all, words
from legs_adapters.lexicon.words import MAPPING, TRACKING
from legs_adapters.rules.rule import Asked, ByPurpose, CallOfTerm, Rule
from legs_adapters.terms.findings import Decider

__all__ = ["PoseStep", "Tracking"]


class _Tracking(Rule):
    reason = "tracking"
    is_always_listed = True


class Tracking(_Tracking):
    """The name of the function, its class or a condition around the term is about tracking.

    left:
        def track_camera(gaussians, camera):
            image = render(camera, gaussians, None, None)["render"]
            loss = l1_loss(image, camera.original_image)
            loss.backward()
            camera.optimizer.step()

    weighted: loss = l1_loss(image, gt)
    """

    id = "tracking"

    def evidence(self, term: Asked) -> List[Decider]:
        named = [decider for name, decider in term.names_around if _tracks(name)]
        return (named or [(term.function, part) for part in _condition(term)])[:1]

    def of_call(self, call: CallOfTerm) -> List[Decider]:
        return self.evidence(call)


class PoseStep(ByPurpose, _Tracking):
    """The optimiser updates camera poses and no Gaussians.

    left:
        def refine(gaussians, camera):
            pose_optimizer = torch.optim.Adam([camera.pose_delta], lr=0.001)
            image = render(camera, gaussians, None, None)["render"]
            loss = l1_loss(image, camera.original_image)
            loss.backward()
            pose_optimizer.step()

    weighted: loss = l1_loss(image, gt)
    """

    id = "pose-step"


def _condition(term: Asked) -> List[cst.CSTNode]:
    """Return the names about tracking in the conditions around a call; the call itself where there are none."""
    said = [name for name in term.function.flow.conditions.get(id(term.call), ()) if _tracks(name)]
    if not said:
        return []
    branches = [part for part in walk_all(term.function.body) if isinstance(part, (cst.If, cst.IfExp))]
    inside = [[id(part) for part in walk_all(branch)] for branch in branches]
    around = sorted((len(ids), at) for at, ids in enumerate(inside) if id(term.call) in ids)
    tests = [branches[at].test for _, at in around]  # the innermost first
    parts = [part for test in tests for part in walk_all(test) if isinstance(part, cst.Name) and part.value in said[0]]
    return [*parts, term.call]


def _tracks(name: str) -> bool:
    """Return whether a name is about optimising poses: for tracking, or to align a test view."""
    said = set(words(name))
    return {"test", "pose"} <= said or bool(said & TRACKING and not said & MAPPING)
