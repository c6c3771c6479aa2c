"""Skip an error map that only makes weights or a mask."""

from __future__ import annotations

from typing import List

from legs_adapters.rules.rule import Rule, Term
from legs_adapters.tensors.gradients import is_detached
from legs_adapters.terms.error_maps import is_rescaled, shared_of, takes_no_gradient
from legs_adapters.terms.findings import Decider

__all__ = ["ErrorMask", "UnreadError", "Weighting"]


class Weighting(Rule):
    """The prediction is detached, or the error is only used as a weight or a mask.

    left: loss = l1_loss(image.detach(), gt) * image.mean()
    weighted: loss = l1_loss(image, gt)
    """

    id = reason = "weighting"

    def evidence(self, term: Term) -> List[Decider]:
        function, form = term.function, term.form
        if is_detached(term.prediction) or is_rescaled(function, form):
            return term.here
        for call in function.flow.calls:
            given = any(arg.value is form.node for arg in call.args)
            if given and takes_no_gradient(term.analysis.training, function, call, form.node):
                return [(function, call)]
        return []


class ErrorMask(Rule):
    """The error map is assigned to a name, and its reads make a mask.

    left:
        error = F.l1_loss(image, gt, reduction="none")
        mask = robust_mask(error)
        loss = ((image - gt) ** 2 * mask).mean()

    weighted:
        error = F.l1_loss(image, gt, reduction="none")
        loss = error.mean()
    """

    id = "error-mask"
    reason = "weighting"

    def evidence(self, term: Term) -> List[Decider]:
        if not term.analysis.training.touches(term.function):
            return []
        shared = shared_of(term.analysis.training, term.function, term.form)
        return term.here if shared is not None and not shared.trains else []


class UnreadError(Rule):
    """The error map of a loss module is assigned to a name, and no backward pass reaches the reads of that name.

    left:
        class ImageLoss(torch.nn.Module):
            def forward(self, outputs, batch):
                return self.image_loss(outputs, batch)

            def image_loss(self, outputs, batch):
                error = F.l1_loss(outputs["image"], batch["gt_image"], reduction="none")
                return (error * 2).mean()

    weighted:
        error = F.l1_loss(image, gt, reduction="none")
        loss = (error * 2).mean()
    """

    id = "unread-error"
    reason = "untrained"
    is_listed_for_pictures = True

    def evidence(self, term: Term) -> List[Decider]:
        shared = shared_of(term.analysis.training, term.function, term.form)
        return term.here if shared is not None and not shared.trains else []

    def may_be_loss(self, term: Term) -> bool:
        return True
