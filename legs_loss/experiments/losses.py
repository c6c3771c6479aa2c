"""Losses for experiments, which replace the trainer's own; see :data:`legs_loss.reference.training.trainer.Loss`."""

from __future__ import annotations

from typing import Mapping, Optional

from torch import Tensor

from legs_loss.loss import weighted_l1
from legs_loss.reference.training.trainer import Loss, step_loss
from legs_loss.ssim import ssim_map

__all__ = ["LOSSES"]


def weighted_ssim(prediction: Tensor, target: Tensor, weight: Optional[Tensor], lambda_dssim: float) -> Tensor:
    """Return the loss whose weights multiply both terms pixel by pixel: the error, and 1 - SSIM before its mean."""
    if weight is None:
        return step_loss(prediction, target, weight, lambda_dssim)
    structural = (weight * (1.0 - ssim_map(prediction, target))).mean()
    return (1.0 - lambda_dssim) * weighted_l1(prediction, target, weight) + lambda_dssim * structural


LOSSES: Mapping[str, Loss] = {"ssim": weighted_ssim}
