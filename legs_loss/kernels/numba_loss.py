"""The loss, or its L1 term alone, and the gradient in one pass over the images, on the CPU."""

from __future__ import annotations

from typing import Optional, Sequence, Tuple, Union

import numpy as np
import torch
from torch import Tensor

from legs_loss.kernels.compiling import ONE_AT_A_TIME
from legs_loss.kernels.differentiable import differentiable
from legs_loss.kernels.numba_l1 import ROWS, all_strips
from legs_loss.kernels.numba_tiles import TILE_HEIGHT, TILE_WIDTH, all_tiles
from legs_loss.kernels.numba_weights import Images, WeightSource, images_of, source_of, supports
from legs_loss.spec import WeightSpec
from legs_loss.weights import weight_map

__all__ = ["fused_l1", "fused_loss"]

Weight = Union[Tensor, WeightSpec, None]


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
    spec, inputs = _inputs(target, weight, ranges)

    def compute(wanted: bool, image: Tensor, constants: Sequence[Optional[Tensor]]) -> Tuple[Tensor, Optional[Tensor]]:
        images, source = _read(image, constants, spec)
        gradient = np.empty(images.x.size if wanted else 0, np.float32)
        down, across = -(-images.height // TILE_HEIGHT), -(-images.width // TILE_WIDTH)
        sums = np.zeros((images.views * down * across, 2))
        with ONE_AT_A_TIME:
            all_tiles(images, down, across, np.float32(lambda_dssim), source, gradient, sums)
        absolute_error, similarity = sums.sum(0) / images.x.size
        loss = (1.0 - lambda_dssim) * absolute_error + lambda_dssim * (1.0 - similarity)
        return image.new_tensor(loss), torch.from_numpy(gradient).reshape(image.shape) if wanted else None

    return differentiable(prediction.float(), inputs, compute, _scaled)


def fused_l1(prediction: Tensor, target: Tensor, weight: Weight = None, ranges: Optional[Tensor] = None) -> Tensor:
    """Return the weighted L1 term, as :func:`legs_loss.weighted_l1`; arguments and result as for :func:`fused_loss`."""
    spec, inputs = _inputs(target, weight, ranges)

    def compute(wanted: bool, image: Tensor, constants: Sequence[Optional[Tensor]]) -> Tuple[Tensor, Optional[Tensor]]:
        images, source = _read(image, constants, spec)
        gradient = np.empty(images.x.size if wanted else 0, np.float32)
        sums = np.zeros(images.views * -(-images.height // ROWS))
        with ONE_AT_A_TIME:
            all_strips(images, source, gradient, sums)
        loss = float(sums.sum()) / images.x.size
        return image.new_tensor(loss), torch.from_numpy(gradient).reshape(image.shape) if wanted else None

    return differentiable(prediction.float(), inputs, compute, _scaled)


def _inputs(
    target: Tensor, weight: Weight, ranges: Optional[Tensor]
) -> Tuple[Optional[WeightSpec], Sequence[Optional[Tensor]]]:
    """Return the spec whose weights are made here, if it is one, and the constants: target, map and range."""
    if isinstance(weight, WeightSpec):
        if supports(weight):
            return weight, (target, None, ranges)
        weight = weight_map(target, weight)
    return None, (target, weight, None)


def _read(
    image: Tensor, constants: Sequence[Optional[Tensor]], spec: Optional[WeightSpec]
) -> Tuple[Images, WeightSource]:
    target, stored, ranges = constants
    assert target is not None
    images = images_of(image, target)
    return images, source_of(stored if spec is None else spec, target, images, ranges)


def _scaled(gradient: Tensor, factor: Tensor) -> Tensor:
    return gradient if factor.item() == 1.0 else gradient.mul_(factor)
