"""The numba kernels as a backend for images on the CPU."""

from __future__ import annotations

from typing import FrozenSet, Union

import torch
from torch import Tensor

from legs_loss.kernels import numba_loss
from legs_loss.kernels.contract import Backend, Weights
from legs_loss.kernels.numba_response import CURVES, NORMS, STENCILS
from legs_loss.kernels.numba_weights import response_range
from legs_loss.spec import WeightSpec
from legs_loss.weights import weight_map

__all__ = ["BACKEND"]


class _NumbaBackend(Backend):
    name = "numba"
    offers: FrozenSet[str] = frozenset({"loss", "l1", "ssim"})
    operators: FrozenSet[str] = frozenset(STENCILS)
    norms: FrozenSet[float] = frozenset(NORMS)
    curves: FrozenSet[str] = frozenset(CURVES)

    def response_range(self, target: Tensor, spec: WeightSpec) -> Tensor:
        return torch.from_numpy(response_range(target, spec))

    def loss(self, prediction: Tensor, target: Tensor, weights: Weights, lambda_dssim: float) -> Tensor:
        return numba_loss.fused_loss(prediction, target, _one_source(target, weights), lambda_dssim, weights.range)

    def weighted_l1(self, prediction: Tensor, target: Tensor, weights: Weights) -> Tensor:
        return numba_loss.fused_l1(prediction, target, _one_source(target, weights), weights.range)

    def ssim(self, prediction: Tensor, target: Tensor) -> Tensor:
        return 1.0 - numba_loss.fused_loss(prediction, target, None, 1.0)


def _one_source(target: Tensor, weights: Weights) -> Union[Tensor, WeightSpec, None]:
    """Return what the weights are made from; a mask becomes a factor of a map."""
    if weights.mask is None:
        return weights.map if weights.spec is None else weights.spec
    mask = weights.mask.float()
    if weights.renormalise:
        mask = mask / mask.mean().clamp(min=torch.finfo(mask.dtype).tiny)
    if weights.spec is not None:
        mask = weight_map(target, weights.spec).float() * mask
    elif weights.map is not None:
        mask = weights.map.float() * mask
    return mask


BACKEND: Backend = _NumbaBackend()
