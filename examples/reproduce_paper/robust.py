"""A mask that a training makes by itself: no pixel counts whose residual stands out and lies among others that do.

The kernel of RobustNeRF and of SpotLessSplats without its network. A residual, the mean over channels of |U - F|, is an
outlier above a multiple of a running percentile; a majority in each 3x3 box removes single pixels and fills holes; a
patch of which enough pixels are outliers is left out as a whole. It takes the place of `legs_loss.masked`.
"""

from __future__ import annotations

from typing import Optional

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

__all__ = ["RobustMask"]


class RobustMask:
    """A stand-in for :func:`legs_loss.masked`, which knows no photograph's mask.

    Args:
        percentile: of each step's residuals, in (0, 100).
        factor: residuals above this times the running percentile are outliers.
        decay: of the running percentile, a step.
        warmup: steps before anything is left out.
        patch: pixels of a patch's side.
        share: of a patch's pixels that have to be outliers.
    """

    def __init__(
        self,
        percentile: float = 50,
        factor: float = 6,
        decay: float = 0.95,
        warmup: int = 600,
        patch: int = 16,
        share: float = 0.5,
    ) -> None:
        self.percentile, self.factor, self.decay = percentile, factor, decay
        self.warmup, self.patch, self.share = warmup, patch, share
        self.running: Optional[float] = None
        self.steps: int = 0

    def __call__(self, prediction: Tensor, target: Tensor) -> Tensor:
        """Return the prediction [C, H, W] with the target's pixels where they do not count."""
        if not (prediction.requires_grad and torch.is_grad_enabled()):
            return prediction
        with torch.no_grad():
            left_out = self.left_out((prediction - target).abs().mean(0))
        return torch.where(left_out, target, prediction) if bool(left_out.any()) else prediction

    def left_out(self, residual: Tensor) -> Tensor:
        """Take a step's residuals [H, W] in; return which pixels do not count."""
        self.steps += 1
        now = float(residual.flatten().kthvalue(max(1, round(self.percentile / 100 * residual.numel()))).values)
        self.running = now if self.running is None else self.decay * self.running + (1 - self.decay) * now
        if self.steps <= self.warmup:
            return torch.zeros_like(residual, dtype=torch.bool)
        return vote((residual > self.factor * self.running).float(), self.patch, self.share)


def vote(outlier: Tensor, patch: int, share: float) -> Tensor:
    """Return the pixels [H, W] of the patches of which at least a share are outliers, after a 3x3 majority."""
    smooth = avg_pool2d(pad(outlier[None, None], (1, 1, 1, 1), mode="replicate"), 3, 1) > 0.5
    counted = avg_pool2d(smooth.float(), patch, ceil_mode=True)  # a patch at the edge: the mean over what it has
    height, width = outlier.shape
    return interpolate((counted >= share).float(), scale_factor=patch)[0, 0, :height, :width] > 0
