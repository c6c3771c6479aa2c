"""The contract of a backend: what it declares, and the operations that it offers. torch is the reference.

A backend never gets a case that it did not declare: backends.py uses torch for it. So no kernel needs a branch for "any
other curve", which would silently compute something else.
"""

from __future__ import annotations

from contextlib import nullcontext
from functools import lru_cache
from typing import Any, ContextManager, FrozenSet

import torch
from torch import Tensor

from legs_loss.spec import WeightSpec
from legs_loss.weights import Weights

__all__ = ["Backend", "DeviceFault", "NotNow"]


class NotNow(Exception):
    """An operation cannot be done now, for want of memory or since a capture is under way: torch computes it once."""


class DeviceFault(RuntimeError):
    """A kernel of somebody else's has failed, and the device computes nothing any more: no backend's failure."""


class Backend:
    """A fast implementation of the loss. Subclasses set the attributes and define the operations in ``offers``.

    Images are [C, H, W] or [B, C, H, W] with any strides, of a type in ``dtypes``; no gradient flows to a target or a
    map. Of weights only spec, range and map are read: what a mask does is done around the operation. An operation
    returns a float32 scalar, differentiable once in the prediction. It repeats bit for bit. On a GPU nothing waits for
    the device, and all is launched on the current stream.

    Attributes:
        name: as in LEGS_BACKEND.
        offers: of "loss", "l1" and "ssim": which of :meth:`loss`, :meth:`weighted_l1` and :meth:`ssim` there are.
        dtypes: of the images.
        most_channels, most_pixels: how many channels and pixels an image may have.
        operators, norms, curves: of the specs whose weights the backend makes by itself; torch makes a map for others.
    """

    name: str
    offers: FrozenSet[str] = frozenset()
    dtypes: FrozenSet[torch.dtype] = frozenset({torch.float32, torch.float16, torch.bfloat16})
    most_channels: int = 4
    most_pixels: int = 2**31 - 1
    operators: FrozenSet[str] = frozenset()
    norms: FrozenSet[float] = frozenset()
    curves: FrozenSet[str] = frozenset()

    def preparing(self) -> ContextManager[Any]:
        """Return what the trial runs in: a backend that compiles says so in it."""
        return nullcontext()

    def makes_weights_of(self, spec: WeightSpec) -> bool:
        """Return whether the weights of a spec need no map: it differs from the defaults in what is known here only."""
        known = spec.operator in self.operators and spec.p in self.norms and spec.curve in self.curves
        return known and _is_known(spec)

    def response_range(self, target: Tensor, spec: WeightSpec) -> Tensor:
        """Return the min response of each view, and max - min: float32 [B, 2] on its device.

        It depends on the spec's operator and p only. On the CPU a target with NaN, infinity or values of 0..255 is
        refused (LegsError); on other devices a NaN makes both numbers NaN, and so each weight.
        """
        raise NotImplementedError

    def loss(self, prediction: Tensor, target: Tensor, weights: Weights, lambda_dssim: float) -> Tensor:
        """Return (1 - lambda) * L_w + lambda * (1 - SSIM), SSIM with zero padding."""
        raise NotImplementedError

    def weighted_l1(self, prediction: Tensor, target: Tensor, weights: Weights) -> Tensor:
        """Return the mean over pixels of the weight times the mean over channels of |prediction - target|."""
        raise NotImplementedError

    def ssim(self, prediction: Tensor, target: Tensor) -> Tensor:
        """Return the mean SSIM, with zero padding."""
        raise NotImplementedError


@lru_cache(maxsize=64)
def _is_known(spec: WeightSpec) -> bool:
    return spec == WeightSpec(operator=spec.operator, p=spec.p, curve=spec.curve, beta=spec.beta, eps=spec.eps)
