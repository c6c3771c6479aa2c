"""The CUDA kernels as a backend."""

from __future__ import annotations

import threading
from typing import Callable, Dict, FrozenSet

import torch
from torch import Tensor

from legs_loss.kernels.contract import Backend, Weights
from legs_loss.kernels.cuda.cache import BinaryCache, cache_folder
from legs_loss.kernels.cuda.driver import CudaDriver
from legs_loss.kernels.cuda.launch import CURVES, NORMS, STENCILS
from legs_loss.kernels.cuda.modules import Modules
from legs_loss.kernels.cuda.nvrtc import find_compiler
from legs_loss.kernels.cuda.operations import Shares, fused_loss, response_range
from legs_loss.spec import WeightSpec

__all__ = ["BACKEND", "CudaBackend"]


class CudaBackend(Backend):
    """The operations on every CUDA device; its kernels are loaded when a device is first met.

    Args:
        open_device: makes the kernels of a device.
    """

    name = "cuda"
    offers: FrozenSet[str] = frozenset({"loss", "l1", "ssim"})
    most_channels = 1 << 16
    operators: FrozenSet[str] = frozenset(STENCILS)
    norms: FrozenSet[float] = frozenset(NORMS)
    curves: FrozenSet[str] = frozenset(CURVES)

    def __init__(self, open_device: Callable[[torch.device], Modules]) -> None:
        self._open = open_device
        self._modules: Dict[torch.device, Modules] = {}
        self._lock = threading.Lock()

    def response_range(self, target: Tensor, spec: WeightSpec) -> Tensor:
        """Return each view's least response and the span."""
        return response_range(self._of(target), target, spec)

    def loss(self, prediction: Tensor, target: Tensor, weights: Weights, lambda_dssim: float) -> Tensor:
        """Return the whole loss."""
        shares = Shares(1.0 - lambda_dssim, -lambda_dssim, lambda_dssim)
        return fused_loss(self._of(target), prediction, target, weights, shares)

    def weighted_l1(self, prediction: Tensor, target: Tensor, weights: Weights) -> Tensor:
        """Return the weighted L1."""
        return fused_loss(self._of(target), prediction, target, weights, Shares(1.0, 0.0))

    def ssim(self, prediction: Tensor, target: Tensor) -> Tensor:
        """Return the mean SSIM."""
        return fused_loss(self._of(target), prediction, target, Weights(), Shares(0.0, 1.0))

    def _of(self, images: Tensor) -> Modules:
        if images.device not in self._modules:
            with self._lock:
                if images.device not in self._modules:
                    self._modules[images.device] = self._open(images.device)
        return self._modules[images.device]


def _open(device: torch.device) -> Modules:
    return Modules(CudaDriver(device), find_compiler(), BinaryCache(cache_folder()))


BACKEND: Backend = CudaBackend(_open)
