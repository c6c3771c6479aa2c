"""Check that a comparison's baseline is 3DGS's own loss: with a weighted baseline all arms are equal."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Dict, Sequence

import torch

from legs_loss.errors import LegsError
from legs_loss.lab.training.dataset import TrainingView
from legs_loss.lab.training.trainer import TrainConfig, step_loss, step_weights
from legs_loss.similarity import d_ssim

CLOSE = 1e-4  # relative: two implementations in float32


def prove_unweighted(views: Sequence[TrainingView], config: TrainConfig) -> Dict[str, Any]:
    """Compare the trainer's loss of every training view with 3DGS's own formula.

    Args:
        views: the baseline's training views, with the weight maps that its trainings would use.
        config: the baseline's settings.

    Returns:
        What was compared, for the record: ``views``, their number; ``loss`` and ``loss_3dgs``, means over views;
        ``gradient_error``, the largest difference of a gradient over the largest gradient.

    Raises:
        LegsError: a view has a weight map that is not 1 everywhere, or loss or gradient are not 3DGS's.
    """
    generator = torch.Generator().manual_seed(0)
    ours_sum = theirs_sum = worst = 0.0
    for view in views:
        weights = step_weights(view.weight, replace(view, mask=None), config)
        if weights.map is not None and not bool((weights.map == 1).all()):
            raise LegsError(
                f"the baseline is weighted: {view.name} has a weight map of mean {weights.mean_weight():.3f}: "
                "differences from it would be meaningless. Is it of --weights? Move the store away; masks may stay"
            )
        # Any rendering will do: the photograph with noise has errors of all sizes.
        rendering = (view.image + 0.2 * torch.randn(view.image.shape, generator=generator)).clamp(0, 1).requires_grad_()
        absolute, share = (rendering - view.image).abs().mean(), config.lambda_dssim
        losses = (
            step_loss(rendering, view.image, weights, share),
            (1 - share) * absolute + share * d_ssim(rendering, view.image),
        )
        our_gradient, their_gradient = (torch.autograd.grad(loss, rendering)[0] for loss in losses)
        difference = float((our_gradient - their_gradient).abs().max() / their_gradient.abs().max())
        ours, theirs = (float(loss.detach()) for loss in losses)
        if abs(ours - theirs) > CLOSE * theirs or difference > CLOSE:
            raise LegsError(
                f"the baseline's loss is not 3DGS's: {ours:.6f} in place of {theirs:.6f} for {view.name} "
                f"(gradients differ by {difference:.1e} of the largest)"
            )
        ours_sum, theirs_sum, worst = ours_sum + ours, theirs_sum + theirs, max(worst, difference)
    count = len(views)
    return {"views": count, "loss": ours_sum / count, "loss_3dgs": theirs_sum / count, "gradient_error": worst}
