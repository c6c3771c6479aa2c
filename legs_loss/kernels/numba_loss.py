"""The loss, or its L1 term alone, and the gradient in one pass over the images, on the CPU.

The loss is a scalar, so its gradient is known as soon as the images are: the forward pass computes both, and the
backward pass scales.
"""

from __future__ import annotations

from typing import Any, Callable, Optional, Tuple, Union

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from legs_loss.kernels.compiling import ONE_AT_A_TIME
from legs_loss.kernels.numba_l1 import ROWS, all_strips
from legs_loss.kernels.numba_tiles import TILE_HEIGHT, TILE_WIDTH, all_tiles
from legs_loss.kernels.numba_weights import images_of, source_of, supports
from legs_loss.spec import WeightSpec
from legs_loss.weights import weight_map

__all__ = ["fused_l1", "fused_loss"]

Weight = Union[Tensor, WeightSpec, None]
# Whether the gradient is wanted -> the loss, and the gradient in the prediction's shape.
Compute = Callable[[bool], Tuple[float, Optional[Tensor]]]


def fused_loss(
    prediction: Tensor,
    target: Tensor,
    weight: Weight = None,
    lambda_dssim: float = 0.2,
    ranges: Optional[Tensor] = None,
) -> Tensor:
    """Return (1 - lambda) * L_w + lambda * (1 - SSIM), as :func:`legs_loss.legs_loss` with zero padding.

    Args:
        prediction: on the CPU, [C, H, W] or [B, C, H, W]; what is not float32 is converted.
        target: the same shape; no gradient flows to it.
        weight: [1, H, W] or [B, 1, H, W]; a spec computes it from the target (without a map in memory where
            :func:`supports` says so); None is 1 everywhere.
        lambda_dssim: the share of D-SSIM.
        ranges: [B, 2], with a spec: what ``response_range`` returned for the target.

    Returns:
        A scalar, differentiable once in the prediction. It repeats bit for bit, whatever the number of threads.

    Raises:
        LegsError: a spec, and a target with NaN, infinity or plainly of 0..255.
    """
    image = prediction.detach()

    def compute(wanted: bool) -> Tuple[float, Optional[Tensor]]:
        images = images_of(image, target)
        source = source_of(_mapped(weight, target), target, images, ranges)
        gradient = np.empty(images.x.size if wanted else 0, np.float32)
        down, across = -(-images.height // TILE_HEIGHT), -(-images.width // TILE_WIDTH)
        sums = np.zeros((images.views * down * across, 2))
        with ONE_AT_A_TIME:
            all_tiles(images, down, across, np.float32(lambda_dssim), source, gradient, sums)
        absolute_error, similarity = sums.sum(0) / images.x.size
        loss = (1.0 - lambda_dssim) * absolute_error + lambda_dssim * (1.0 - similarity)
        return loss, torch.from_numpy(gradient).reshape(image.shape) if wanted else None

    return _FusedLoss.apply(prediction.float(), compute)


def fused_l1(prediction: Tensor, target: Tensor, weight: Weight = None, ranges: Optional[Tensor] = None) -> Tensor:
    """Return the weighted L1 term, as :func:`legs_loss.weighted_l1`; arguments and result as for :func:`fused_loss`."""
    image = prediction.detach()

    def compute(wanted: bool) -> Tuple[float, Optional[Tensor]]:
        images = images_of(image, target)
        source = source_of(_mapped(weight, target), target, images, ranges)
        gradient = np.empty(images.x.size if wanted else 0, np.float32)
        sums = np.zeros(images.views * -(-images.height // ROWS))
        with ONE_AT_A_TIME:
            all_strips(images, source, gradient, sums)
        loss = float(sums.sum()) / images.x.size
        return loss, torch.from_numpy(gradient).reshape(image.shape) if wanted else None

    return _FusedLoss.apply(prediction.float(), compute)


def _mapped(weight: Weight, target: Tensor) -> Weight:
    return weight_map(target, weight) if isinstance(weight, WeightSpec) and not supports(weight) else weight


class _FusedLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, prediction: Tensor, compute: Compute) -> Tensor:
        ctx.compute = compute
        loss, ctx.gradient = compute(ctx.needs_input_grad[0])
        return prediction.new_tensor(loss)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_output: Tensor) -> Tuple[Optional[Tensor], None]:
        # The gradient is passed on, not copied; a second backward of a retained graph recomputes it.
        gradient, ctx.gradient = ctx.gradient, None
        if gradient is None:
            gradient = ctx.compute(True)[1]
        return gradient if grad_output.item() == 1.0 else gradient.mul_(grad_output), None
