"""A loss whose gradient is known as soon as its value is, as one node of autograd's graph.

The loss is a scalar, so its gradient needs nothing of what comes after it but a factor: a backend computes both in
one pass over the images, and backward only scales.
"""

from __future__ import annotations

from typing import Any, Callable, Optional, Sequence, Tuple

import torch
from torch import Tensor

from legs_loss.errors import LegsError

__all__ = ["Compute", "Scale", "differentiable"]

# Whether the gradient is wanted, the prediction and the constants -> the loss, and the gradient or None.
Compute = Callable[[bool, Tensor, Sequence[Optional[Tensor]]], Tuple[Tensor, Optional[Tensor]]]
# The gradient, which may be overwritten, and the factor that arrives in backward -> their product.
Scale = Callable[[Tensor, Tensor], Tensor]


def differentiable(prediction: Tensor, constants: Sequence[Optional[Tensor]], compute: Compute, scale: Scale) -> Tensor:
    """Return a loss, differentiable once in the prediction.

    The first backward uses the gradient of the forward pass. A second one of a retained graph computes it anew, from
    tensors that autograd has saved: as everywhere in torch it raises a RuntimeError where one of them was changed in
    place meanwhile, or where the graph was not retained.

    Args:
        prediction: what the loss is differentiated in.
        constants: every other tensor that it depends on; None stands for one that is absent.
        compute: makes the loss and its gradient from them, detached.
        scale: applies the factor that arrives in backward.
    """
    wanted = prediction.requires_grad and torch.is_grad_enabled()
    return _FusedLoss.apply(prediction, wanted, compute, scale, *constants)


class _FusedLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, prediction: Tensor, wanted: bool, compute: Compute, scale: Scale, *constants: Optional[Tensor]
    ) -> Tensor:
        loss, gradient = compute(wanted, prediction.detach(), constants)
        if wanted:
            ctx.compute, ctx.scale, ctx.gradient = compute, scale, gradient
            # Of a tensor that was made in inference mode a copy, whose changes autograd can count.
            counted = [one.clone() if one is not None and one.is_inference() else one for one in constants]
            ctx.save_for_backward(prediction, *counted)
        return loss

    @staticmethod
    def backward(ctx: Any, grad_output: Tensor) -> Tuple[Optional[Tensor], ...]:
        gradient, ctx.gradient = ctx.gradient, None  # it is passed on, not copied
        if gradient is None:
            prediction, *constants = ctx.saved_tensors
            gradient = ctx.compute(True, prediction.detach(), constants)[1]
        again = torch.is_grad_enabled()
        try:
            scaled = ctx.scale(gradient, grad_output.detach() if again else grad_output)
        except RuntimeError:  # a batch of factors (is_grads_batched, vmap) has no number to read
            scaled = gradient * grad_output
        if again:
            scaled = _Once.apply(scaled, ctx.saved_tensors[0], grad_output)
        return (scaled, *[None] * (len(ctx.needs_input_grad) - 1))


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
