"""Skip a term whose gradients were not found to train Gaussians: no optimiser uses them, or one of other things."""

from __future__ import annotations

from typing import List

from legs_adapters.rules.rule import Rule, Term
from legs_adapters.terms.findings import Decider


class _ByPurpose(Rule):
    """Skip a term by the purpose of its backward pass."""

    def evidence(self, term: Term) -> List[Decider]:
        """Return the step, or the backward pass without one, that shows the purpose."""
        purpose = term.analysis.purposes.purpose(term.function, term.form.call)
        return list(purpose.deciders) if purpose is not None and purpose.rule == self.id else []


class PoseStep(_ByPurpose):
    """By the names of what it is given, the optimiser updates poses, exposures or embeddings; no Gaussians were found.

    skipped:
        def refine(gaussians, camera):
            pose_optimizer = torch.optim.Adam([camera.pose_delta], lr=0.001)
            image = render(camera, gaussians, None, None)["render"]
            l1_loss(image, camera.original_image).backward()
            pose_optimizer.step()
    """

    id = "pose-step"
    reason = "tracking"


class NoStep(_ByPurpose):
    """No optimiser was found that uses the gradients: what only reads them scores the Gaussians.

    skipped:
        def sensitivity(gaussians, camera):
            image = render(camera, gaussians, None, None)["render"]
            l1_loss(image, camera.original_image).backward()
            return gaussians.points.grad.norm()
    """

    id = "no-step"
    reason = "scoring"

    def may_be_loss(self, term: Term) -> bool:
        return True
