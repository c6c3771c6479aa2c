"""Leave a term of camera tracking: by the names around it, or by what its optimiser moves."""

from __future__ import annotations

from typing import List

import libcst as cst

from legs_adapters.code.syntax import walk_all, words
from legs_adapters.rules.rule import Asked, ByPurpose, CallOfTerm, Rule, header
from legs_adapters.terms.findings import Decider

__all__ = ["PoseStep", "Tracking"]

_POSE = {"tracking", "track", "tracker", "localize", "localization", "relocalize", "relocalization"}
_MAPPING = {"mapping", "map", "mapper"}  # a class that tracks and maps says nothing of one method


class _Tracking(Rule):
    reason = "tracking"
    is_always_listed = True


class Tracking(_Tracking):
    """The function, its class or a condition around the term is named for tracking.

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
        function = term.function
        if _tracks(function.name):
            return [header(function)]
        for name in function.flow.conditions.get(id(term.call), ()):
            if _tracks(name):
                tests = [part.test for part in walk_all(function.body) if isinstance(part, (cst.If, cst.IfExp))]
                parts = [part for test in tests for part in walk_all(test)]
                named = [part for part in parts if isinstance(part, cst.Name) and part.value in name]
                return [(function, part) for part in [*named, term.call]][:1]
        owner = term.analysis.program.owner_of(function)
        return [(owner.parent, owner.node.name)] if owner is not None and _tracks(owner.name) else []

    def of_call(self, call: CallOfTerm) -> List[Decider]:
        return self.evidence(call)


class PoseStep(ByPurpose, _Tracking):
    """The optimiser that steps moves camera poses, and no Gaussians.

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


def _tracks(name: str) -> bool:
    """Return whether a name says that poses are moved: to track, or to align a test view."""
    said = set(words(name))
    return {"test", "pose"} <= said or bool(said & _POSE and not said & _MAPPING)
