"""The numba backend: the loss, its L1 term or SSIM, and the gradient in one pass over the images, on the CPU."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from typing import Any, ContextManager, FrozenSet, Optional, Sequence, Tuple, Union

import numpy as np
import torch
from torch import Tensor

from legs_loss.kernels.codes import NORMS, STENCILS
from legs_loss.kernels.compiling import in_threads, said
from legs_loss.kernels.contract import Backend
from legs_loss.kernels.differentiable import differentiable
from legs_loss.kernels.numba_l1 import ROWS, all_strips
from legs_loss.kernels.numba_tiles import TILE_HEIGHT, TILE_WIDTH, all_tiles
from legs_loss.kernels.numba_weights import FORMULAS, Images, WeightSource, images_of, response_range, source_of
from legs_loss.spec import WeightSpec
from legs_loss.weights import Weights, weight_map

__all__ = ["BACKEND", "fused_loss"]


class _NumbaBackend(Backend):
    name = "numba"
    offers: FrozenSet[str] = frozenset({"loss", "l1", "ssim"})
    operators: FrozenSet[str] = frozenset(STENCILS)
    norms: FrozenSet[float] = frozenset(NORMS)
    curves: FrozenSet[str] = frozenset(FORMULAS)

    def preparing(self) -> ContextManager[Any]:
        # In somebody's training script: where nobody looks, nothing is said.
        return said("legs-loss", "5 to 15 s") if sys.stderr.isatty() else nullcontext()

    def response_range(self, target: Tensor, spec: WeightSpec) -> Tensor:
        return response_range(target, spec)

    def loss(self, prediction: Tensor, target: Tensor, weights: Weights, lambda_dssim: float) -> Tensor:
        return _differentiable(prediction, target, weights, lambda_dssim)

    def weighted_l1(self, prediction: Tensor, target: Tensor, weights: Weights) -> Tensor:
        return _differentiable(prediction, target, weights, 0.0)

    def ssim(self, prediction: Tensor, target: Tensor) -> Tensor:
        return 1.0 - _differentiable(prediction, target, Weights(), 1.0)


BACKEND: Backend = _NumbaBackend()


def fused_loss(
    prediction: Tensor,
    target: Tensor,
    weight: Union[Tensor, WeightSpec, None] = None,
    lambda_dssim: float = 0.2,
) -> Tensor:
    """Return (1 - lambda) * L_w + lambda * (1 - SSIM), as :func:`legs_loss.legs_loss` with zero padding.

    Args:
        prediction: on the CPU, [C, H, W] or [B, C, H, W]; what is not float32 is converted.
        target: the same shape; no gradient flows to it.
        weight: [1, H, W] or [B, 1, H, W]; a spec computes it from the target; None is 1 everywhere.
        lambda_dssim: the share of D-SSIM.

    Returns:
        A scalar, differentiable once in the prediction. It repeats bit for bit, whatever the number of threads.

    Raises:
        LegsError: a spec, and a target with NaN, infinity or plainly of 0..255.
    """
    if isinstance(weight, WeightSpec) and not BACKEND.makes_weights_of(weight):
        weight = weight_map(target, weight, False)
    weights = Weights(spec=weight) if isinstance(weight, WeightSpec) else Weights(map=weight)
    return BACKEND.loss(prediction, target, weights, lambda_dssim)


def _differentiable(prediction: Tensor, target: Tensor, weights: Weights, share: float) -> Tensor:
    def compute(wanted: bool, image: Tensor, constants: Sequence[Optional[Tensor]]) -> Tuple[Tensor, Optional[Tensor]]:
        target, map_, found = constants
        assert target is not None
        images = images_of(image, target)
        source = source_of(Weights(weights.spec, found, map_), target, images)
        gradient = np.empty(images.x.size if wanted else 0, np.float32)
        loss = (_l1_alone if share == 0.0 else _l1_and_ssim)(images, source, share, gradient)
        return image.new_tensor(loss), torch.from_numpy(gradient).reshape(image.shape) if wanted else None

    constants = (target, weights.map, weights.range)
    return differentiable(prediction.float(), constants, compute, _scaled)


def _l1_and_ssim(images: Images, source: WeightSource, share: float, gradient: np.ndarray) -> float:
    down, across = -(-images.height // TILE_HEIGHT), -(-images.width // TILE_WIDTH)
    sums, size = np.zeros((images.views * down * across, 2)), images.x.size
    scales = np.float32((1.0 - share) / size), np.float32(-2.0 * share / size)  # SSIM's, of halves of slopes
    in_threads(all_tiles, len(sums), images, down, across, scales, source, gradient, sums)
    absolute_error, similarity = sums.sum(0) / size
    return float((1.0 - share) * absolute_error + share * (1.0 - similarity))


def _l1_alone(images: Images, source: WeightSource, share: float, gradient: np.ndarray) -> float:
    sums, size = np.empty(images.views * -(-images.height // ROWS)), images.x.size
    in_threads(all_strips, len(sums), images, source, np.float32(1.0 / size), gradient, sums)
    return float(sums.sum()) / size


def _scaled(gradient: Tensor, factor: Tensor) -> Tensor:
    return gradient if factor.item() == 1.0 else gradient.mul_(factor)
