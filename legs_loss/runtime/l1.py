"""The drop-in ``l1_loss``, which replaces the codebase's own in a training script.

It weights only a prediction that is being trained on; under ``no_grad`` it is the plain mean, so that reported metrics
do not change.
"""

from __future__ import annotations

from typing import Any, Callable, Optional, TypeVar

import torch
from torch import Tensor

from legs_loss.autograd import backward_pass, check_order, is_compiling, is_trained
from legs_loss.counting import counted
from legs_loss.errors import LegsError
from legs_loss.images import read_pair
from legs_loss.kernels.backends import fused, plan_of
from legs_loss.kernels.contract import L1
from legs_loss.loss import mean_error
from legs_loss.responses import NEEDS_LEVELS
from legs_loss.runtime import state
from legs_loss.runtime.own import check_own
from legs_loss.runtime.state import ViewName, current_run, spec_to_compile, thread
from legs_loss.weights import Weights

Own = Callable[[Tensor, Tensor], Tensor]
Result = TypeVar("Result")


def l1_loss(
    prediction: Tensor,
    target: Tensor,
    view: ViewName = None,
    mask: Optional[Tensor] = None,
    channels_last: Optional[bool] = None,
    reduction: str = "mean",
    own: Optional[Own] = None,
) -> Tensor:
    """Return the LEGS-weighted L1 loss; a drop-in for the ``l1_loss`` of a 3DGS codebase.

    Args:
        prediction: the rendering, [H, W], [C, H, W], [H, W, C], or batches of these, as of the views of several scenes
            [B, V, C, H, W]. The channel stands last where that axis is 1, 3 or 4 and the one for [C, H, W] is not.
            Where it requires no gradient (evaluation, ``no_grad``) the result is
            ``torch.abs(prediction - target).mean()``, unweighted.
        target: the photograph of this step, the same shape; [C, H, W] beside [1, C, H, W] are both a batch of one,
            as in ``torch.abs(prediction - target)``.
        view: the name of the view, or its number (for a batch: one a view), for messages. Maps from ``legs precompute``
            are found by the target's fingerprint, and used only for the very image that they were made from.
        mask: one value a pixel, bool or floats in [0, 1], zeroes the weight where it is 0. A mask of the store is
            applied beside it: the loss is the mean over what that counts, and an image that the store does not know is
            said (docs/masks.md).
        channels_last: where the channel stands, for a shape that does not show it, as [3, 100, 4].
        reduction: "mean", or "none" for the map of weighted errors, in the prediction's shape.
        own: the codebase's own L1 of (prediction, target), where it is more than a mean: its mask or reduction is then
            applied to the weighted difference. It is called with the target and a prediction whose difference from it
            is scaled by the weight; without a weight, with the prediction itself. Twice the difference must make it
            twice as large, which is asked of it once: a squared, smooth, robust or clamped one is refused.

    Returns:
        A scalar, or the result of ``reduction`` or ``own``. With beta 0 or LEGS_OFF it is
        ``torch.abs(prediction - target).mean()``, or ``own(prediction, target)``, bit-identical.

    Raises:
        LegsError: shapes that do not fit (both are named), that may be read either way, or that contradict
            ``channels_last``; the target alone requires a gradient: the two are swapped; ``own`` is no L1; a mask of
            whole numbers; on the CPU a target with NaN or infinity, or a mask beyond [0, 1]; a setting in legs.toml or
            LEGS_* that is out of range; torch.func, a re-entrant checkpoint or an autograd.Function of the
            codebase together with torch.compile.

    Examples:
        >>> target = torch.rand(3, 8, 8)
        >>> prediction = torch.rand(3, 8, 8, requires_grad=True)
        >>> l1_loss(prediction, target) > torch.abs(prediction - target).mean()
        tensor(True)
    """
    if not (isinstance(prediction, Tensor) and isinstance(target, Tensor)):
        read_pair(prediction, target)  # the error names which
    if not isinstance(reduction, str) or reduction not in ("mean", "none"):
        raise LegsError(f'reduction must be "mean" or "none", got {reduction!r}')
    if own is not None and not (callable(own) and mask is None and reduction == "mean"):
        raise LegsError(f"own= must be a function, without mask= and reduction= beside it, got {own!r}")
    given = (mask, channels_last, reduction, own)
    if is_compiling():
        return _by_torch(prediction, target, _compiled_weights(prediction, target), *given)
    trains = (prediction.requires_grad and torch.is_grad_enabled()) or is_trained(prediction)
    run = None if thread.unweighted or not (trains or is_trained(target)) else current_run()
    if run is None or not (run.weighted or run.active):
        plain = _by_torch(prediction, target, Weights(), *given)
        counted.plain += 1
        counted.plain_steps += trains and backward_pass() == -1
        if run is not None:
            run.say_what_is_used()
        return plain
    if not trains:
        check_order(prediction, target)
    spec, mean = run.config.spec, own is None and reduction == "mean"
    plan, image, photograph = plan_of(L1 if mean else None, spec, prediction, target, channels_last)
    weights = masked = run.weights(photograph, view, plan.makes)
    if mask is not None:
        masked = weights.masked(plan.layout.map_first(mask, photograph, "mask"), renormalise=False)
    loss = fused(plan, image, photograph, masked) if mean else None
    if loss is None:
        loss = _by_torch(prediction, target, weights, *given)
    counted.weighted += backward_pass() == -1  # a checkpoint computes its loss again in the backward
    if not run.said:
        run.say_what_is_used()
    return loss


def _compiled_weights(prediction: Tensor, target: Tensor) -> Weights:
    """Return the weights for torch.compile: without a memo, they are part of the graph."""
    spec = None if thread.unweighted else spec_to_compile(state.generation, is_trained(prediction))
    if spec is None and not thread.unweighted:
        check_order(prediction, target)
    if spec is not None and spec.over == "scene":
        where, then = "a compiled graph cannot read", "and leave the loss out of torch.compile"
        raise LegsError(NEEDS_LEVELS.format(where=where, then=then))
    return Weights(spec)


def _by_torch(
    prediction: Tensor,
    target: Tensor,
    weights: Weights,
    mask: Optional[Tensor],
    channels_last: Optional[bool],
    reduction: str,
    own: Optional[Own],
) -> Tensor:
    """Return the loss by torch; without a weight the codebase's own."""
    mean = own is None and reduction == "mean"
    if weights.spec is None and weights.map is None:
        if own is not None:
            return own(prediction, target)
        if mean and mask is None:
            if prediction.is_complex() or target.is_complex():
                read_pair(prediction, target)  # it takes floats
            try:
                return torch.abs(prediction - target).mean()
            except RuntimeError:
                read_pair(prediction, target, channels_last)  # names what does not fit
                raise
    layout, prediction, target = read_pair(prediction, target, channels_last)
    weights = weights.with_map(target).masked(layout.map_first(mask, target, "mask"), renormalise=False)
    if mean:
        return mean_error(prediction, target, weights)
    error = prediction - target
    if weights.map is not None:  # where a codebase's reduction follows, its mean becomes the mean over what counts
        error = weights.of_what_counts(weights.map).to(error.dtype) * error
    if own is None:
        return layout.restored(torch.abs(error))
    # |F + W * (U - F) - F| = W * |U - F|: any L1 of the difference becomes the weighted one, and masks that the
    # codebase makes from the target stay as they are.
    check_own(own, layout.restored(target))
    own = own if is_compiling() else unweighted(own)  # it may be weighted itself
    return own(layout.restored(target + error), layout.restored(target))


def unweighted(function: Callable[..., Result]) -> Callable[..., Result]:
    """Return a function that calls another one in which ``l1_loss`` is not weighted, as with LEGS_OFF.

    For a loss that compares a rendering with its photograph in one call and with another rendering in the next, where
    nothing is to be weighted. It affects this thread only, until the call returns or raises.

    Args:
        function: the function or module to call.

    Examples:
        >>> def photometric(image, gt_image):
        ...     return 0.8 * l1_loss(image, gt_image) + 0.2 * (image - gt_image).square().mean()
        >>> image, other = torch.rand(3, 8, 8, requires_grad=True), torch.rand(3, 8, 8)
        >>> unweighted(photometric)(image, other) < photometric(image, other)
        tensor(True)
    """

    if not callable(function):
        raise LegsError(f"unweighted needs a function or a module, got {function!r}")

    def plain(*args: Any, **kwargs: Any) -> Result:
        thread.unweighted += 1
        try:
            return function(*args, **kwargs)
        finally:
            thread.unweighted -= 1

    return plain
