"""The contract of a backend: what it declares, and how it prepares a loss. torch is the reference.

A backend never gets a case that it did not declare: backends.py uses torch for it. So no kernel needs a branch for "any
other curve", which would silently compute something else.

A loss is one node of autograd's graph. It is a scalar, so its gradient needs nothing of what comes after it but a
factor: a backend computes both in one pass over the images, and backward only scales.
"""

from __future__ import annotations

from contextlib import nullcontext
from functools import lru_cache
from typing import Any, ContextManager, FrozenSet, NamedTuple, Optional, Tuple

import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.spec import WeightSpec
from legs_loss.weights import Weights

_NO_WEIGHTS = Weights()


class NotNow(Exception):
    """An operation cannot be done now, for want of memory or since a capture is under way: torch computes it once."""


class Failed(Exception):
    """A node's computation failed, as the cause says. What else is raised in a node, as by a hook of tensors that are
    saved (torch stops a checkpoint's second pass so), is not the backend's."""


class DeviceFault(RuntimeError):
    """A kernel of somebody else's has failed, and the device computes nothing any more: no backend's failure."""


class Terms(NamedTuple):
    """The loss is l1 * (weighted L1) + ssim * SSIM + constant; a term of share 0 is not computed."""

    l1: float
    ssim: float = 0.0
    constant: float = 0.0

    @property
    def name(self) -> str:
        """Return which kernels compute them: "l1", "ssim", or "loss" for both."""
        return "l1" if self.ssim == 0.0 else ("loss" if self.l1 else "ssim")


L1, SSIM = Terms(1.0), Terms(0.0, 1.0)


@lru_cache(maxsize=64)
def terms_of(lambda_dssim: float) -> Terms:
    """Return (1 - lambda) * L1 + lambda * (1 - SSIM)."""
    return Terms(1.0 - lambda_dssim, -lambda_dssim, lambda_dssim)


class PreparedLoss:
    """A loss of images [C, H, W] or [B, C, H, W] of one shape, strides, types and device: all that hangs on no value.

    The weighted L1 is the mean over pixels of the weight times the mean over channels of |prediction - target|; SSIM
    has zero padding. Both repeat bit for bit. On a GPU nothing waits for the device, and all is launched on the current
    stream.
    """

    def compute(
        self, prediction: Tensor, target: Tensor, map_: Optional[Tensor], range_: Optional[Tensor]
    ) -> Tuple[Tensor, Optional[Tensor]]:
        """Return the loss, a float32 scalar, and its gradient where that is wanted; map and range as in Weights."""
        raise NotImplementedError

    def scaled(self, gradient: Tensor, step: Tensor) -> Tensor:
        """Return a gradient, which may be overwritten, times the factor that arrives in backward."""
        raise NotImplementedError

    def response_range(self, target: Tensor) -> Tensor:
        """Return the min response of each view, and max - min: float32 [B, 2] on its device.

        It depends on the spec's operator and p only. On the CPU a target with NaN, infinity or values of 0..255 is
        refused (LegsError); on other devices a NaN makes both numbers NaN, and so each weight.
        """
        raise NotImplementedError


class Backend:
    """A fast implementation of the loss. Subclasses set the attributes and define :meth:`prepare`.

    Images have any strides and a type in ``dtypes``; no gradient flows to a target or a map. Of weights only spec,
    range and map are read: what a mask does is done around the operation.

    Attributes:
        name: as in LEGS_BACKEND.
        dtypes: of the images; of two types they are computed in float32.
        most_channels, most_pixels: how many channels and pixels an image may have.
        curves: of the specs whose weights the backend makes by itself; torch makes a map for others.
    """

    name: str
    dtypes: FrozenSet[torch.dtype] = frozenset({torch.float32, torch.float16, torch.bfloat16})
    most_channels: int = 4
    most_pixels: int = 2**31 - 1
    curves: FrozenSet[str] = frozenset()

    def preparing(self) -> ContextManager[Any]:
        """Return what the trial runs in: a backend that compiles says so in it."""
        return nullcontext()

    def makes_weights_of(self, spec: WeightSpec) -> bool:
        """Return whether the weights of a spec need no map: it differs from the defaults in what is known here only."""
        from legs_loss.kernels.codes import STENCILS

        known = WeightSpec(operator=spec.operator, p=spec.p, curve=spec.curve, beta=spec.beta, eps=spec.eps)
        return spec.operator in STENCILS and spec.curve in self.curves and spec == known

    def prepare(
        self, terms: Terms, spec: Optional[WeightSpec], prediction: Tensor, target: Tensor, wanted: bool
    ) -> PreparedLoss:
        """Return a loss of such images, prepared; its gradient, too, if it is wanted.

        Args:
            terms: of the loss.
            spec: of weights that are made from the target, one of those that are known here.
            prediction, target: examples.
        """
        raise NotImplementedError

    def loss(self, terms: Terms, prediction: Tensor, target: Tensor, weights: Weights = _NO_WEIGHTS) -> Tensor:
        """Return a loss of images [C, H, W] or [B, C, H, W], differentiable once in the prediction."""
        wanted = prediction.requires_grad and torch.is_grad_enabled()
        prepared = self.prepare(terms, weights.spec, prediction, target, wanted)
        try:
            loss: Tensor = node(prediction, target, weights.map, weights.range, prepared)
        except Failed as failed:
            raise (failed.__cause__ or failed) from None
        return loss


class _FusedLoss(torch.autograd.Function):
    """A loss, differentiable once in the prediction.

    The first backward uses the gradient of the forward pass. A second one of a retained graph computes it anew, from
    tensors that autograd has saved: as everywhere in torch it raises a RuntimeError where one of them was changed in
    place meanwhile, or where the graph was not retained.
    """

    @staticmethod
    def forward(ctx: Any, prediction: Tensor, target: Tensor, map_: Any, range_: Any, prepared: PreparedLoss) -> Tensor:
        channels, height, width = prediction.shape[-3:]
        # Kernels read a map by its address: for all views, or for each.
        if map_ is not None and map_.numel() not in (height * width, prediction.numel() // channels):
            raise LegsError(f"weight {list(map_.shape)} does not fit images {list(prediction.shape)}")
        try:
            loss, gradient = prepared.compute(prediction, target, map_, range_)
        except Exception as error:
            raise Failed from error
        if gradient is not None:
            ctx.prepared, ctx.gradient, saved = prepared, gradient, []
            for one in (prediction, target, map_, range_):  # of inference mode a copy, whose changes autograd can count
                saved.append(one.clone() if one is not None and one.is_inference() else one)
            ctx.save_for_backward(*saved)
        return loss

    @staticmethod
    def backward(ctx: Any, step: Tensor) -> Tuple[Optional[Tensor], ...]:
        gradient, ctx.gradient = ctx.gradient, None  # it is passed on, not copied
        if gradient is None:
            gradient = ctx.prepared.compute(*ctx.saved_tensors)[1]
        again = torch.is_grad_enabled()
        try:
            scaled = ctx.prepared.scaled(gradient, step.detach() if again else step)
        except RuntimeError:  # a batch of factors (is_grads_batched, vmap) has no number to read
            scaled = gradient * step
        if again:
            scaled = _Once.apply(scaled, ctx.saved_tensors[0], step)
        return scaled, None, None, None, None


class _Once(torch.autograd.Function):
    """A gradient in a graph of gradients, which depends on the prediction in a way that no backend differentiates."""

    @staticmethod
    def forward(ctx: Any, gradient: Tensor, *_: Tensor) -> Tensor:
        return gradient.view_as(gradient)

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> Any:
        raise LegsError(
            "this loss was computed by a backend, which gives no second derivative: set LEGS_BACKEND=torch "
            "(the gradient was taken with create_graph=True and is differentiated again)"
        )


# (prediction, target, map, range, prepared) -> the loss. Function.apply itself, which looks for torch.func first:
# no transform is around where a backend is asked.
node: Any = super(torch.autograd.Function, _FusedLoss).apply
