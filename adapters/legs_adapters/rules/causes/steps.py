"""Skip a term whose gradients do not train the Gaussians: no optimiser uses them, or one of camera poses."""

from __future__ import annotations

from typing import List

from legs_adapters.rules.rule import CallContext, CallOfTerm, Rule
from legs_adapters.terms.findings import Decider

__all__ = ["EmbeddingStep", "NoStep", "PoseStep"]


class _OtherStep(Rule):
    """Skip a term, or a call, by the purpose of its backward pass: the rule's reason."""

    def evidence(self, term: CallContext) -> List[Decider]:
        """Return the step, or the backward pass without one, that shows the purpose."""
        found = term.analysis.purposes.purpose(term.function, term.call)
        return [(found.function, found.node)] if found is not None and found.word == self.reason else []

    def of_call(self, call: CallOfTerm) -> List[Decider]:
        """Return the same of a call."""
        return self.evidence(call)


class PoseStep(_OtherStep):
    """The optimiser updates camera poses and no Gaussians."""

    id = "pose-step"
    reason = "tracking"
    is_always_listed = True
    VALID = ["loss = l1_loss(image, gt)"]
    INVALID = [
        """
        def refine(gaussians, camera):
            pose_optimizer = torch.optim.Adam([camera.pose_delta], lr=0.001)
            image = render(camera, gaussians, None, None)["render"]
            loss = l1_loss(image, camera.original_image)
            loss.backward()
            pose_optimizer.step()
        """
    ]


class EmbeddingStep(_OtherStep):
    """The optimiser updates an embedding only, to fit a test view."""

    id = "embedding-step"
    reason = "evaluation"
    VALID = ["loss = l1_loss(image, gt)"]
    INVALID = [
        """
        def adapt(gaussians, camera, embedding):
            optimizer = torch.optim.Adam([embedding], lr=0.1)
            for _ in range(100):
                image = render(camera, gaussians, embedding, None)["render"]
                loss = l1_loss(image, camera.original_image)
                loss.backward()
                optimizer.step()
        """
    ]


class NoStep(_OtherStep):
    """No optimiser uses the gradients: they are read to score the Gaussians, then discarded."""

    id = "no-step"
    reason = "scoring"
    VALID = ["loss = l1_loss(image, gt)"]
    INVALID = [
        """
        def drop_unseen(gaussians, cameras):
            for camera in cameras:
                image = render(camera, gaussians, None, None)["render"]
                l1_loss(image, camera.original_image).backward()
                weight = gaussians.points.grad.norm()
                gaussians.optimizer.zero_grad()

        drop_unseen(GaussianModel(3), Scene().cameras)
        """
    ]
