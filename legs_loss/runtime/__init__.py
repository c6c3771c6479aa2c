"""The drop-in ``l1_loss``, which replaces the codebase's own in a training script.

It weights only a prediction that is being trained on; under ``no_grad`` it is the plain mean, so that reported metrics
do not change. call.py is the call, checked, and the loss that it gives; sources.py finds its weights in memo.py, in
stored.py or from the target; terms.py is what a store's masks do to other terms, and ``ssim``; state.py has the
settings and the counts of the process.
"""

from __future__ import annotations

from typing import Any, Callable, Optional, TypeVar

import torch
from torch import Tensor

from legs_loss.counting import Counts, counted
from legs_loss.errors import LegsError
from legs_loss.images import check_order, is_compiling, is_trained
from legs_loss.kernels.backends import fused_l1_of_target
from legs_loss.runtime.call import Call, Own, View
from legs_loss.runtime.state import active, configure, counts, current_run, spec_to_compile, thread, version
from legs_loss.weights import Weights, weight_map

__all__ = ["Counts", "active", "configure", "counts", "l1_loss", "unweighted"]

Result = TypeVar("Result")


def l1_loss(
    prediction: Tensor,
    target: Tensor,
    view: View = None,
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
        mask: one value a pixel, zeroes the weight where it is 0. A mask of the store is applied beside it: the loss is
            the mean over what that counts, and an image that the store does not know is said (docs/masks.md).
        channels_last: where the channel stands, for a shape that does not show it, as [3, 100, 4].
        reduction: "mean", or "none" for the map of weighted errors, in the prediction's shape.
        own: the codebase's own L1 of (prediction, target), where it is more than a mean: its mask or reduction is then
            applied to the weighted difference. It is called with the target and a prediction whose difference from it
            is scaled by the weight; without a weight, with the prediction itself.

    Returns:
        A scalar, or the result of ``reduction`` or ``own``. With beta 0 or LEGS_OFF it is
        ``torch.abs(prediction - target).mean()``, or ``own(prediction, target)``, bit-identical.

    Raises:
        LegsError: shapes that do not fit (both are named), that may be read either way, or that contradict
            ``channels_last``; the target alone requires a gradient: the two are swapped; on the CPU a target
            with NaN or infinity; a setting in legs.toml or LEGS_* that is out of range.

    Examples:
        >>> target = torch.rand(3, 8, 8)
        >>> prediction = torch.rand(3, 8, 8, requires_grad=True)
        >>> l1_loss(prediction, target) > torch.abs(prediction - target).mean()
        tensor(True)
    """
    call = Call(prediction, target, view, mask, channels_last, reduction, own)
    call.check_options()
    if is_compiling():
        return _compiled(call)
    trains = call.trains()
    run = None if thread.unweighted or not (trains or is_trained(target)) else current_run()
    if run is None or not run.active:
        counted.plain += 1
        counted.plain_steps += trains
        if run is not None:
            run.say_what_is_used()
        return call.plain()
    if not trains:
        check_order(prediction, target)
    call = call.aligned()
    counted.weighted += torch.is_grad_enabled()  # the second pass of a checkpoint counts, not the first
    bare = view is None and mask is None and own is None and reduction == "mean"
    if bare and run.config.store is None and target.device.type == "cpu":
        # Nothing is looked up: on the CPU a SHA-256 of an image's bytes takes longer than its range.
        loss = fused_l1_of_target(call.prediction, call.target, run.config.spec)
        if loss is not None:
            counted.computed += call.target.shape[0] if call.target.dim() == 4 else 1
            run.say_what_is_used()
            return loss
    with torch.no_grad():
        weights = run.source.weights(call)
    run.say_what_is_used()
    return call.weighted(weights)


def _compiled(call: Call) -> Tensor:
    """Return the loss for torch.compile: without a memo, the weight is part of the graph."""
    spec = None if thread.unweighted or not call.trains() else spec_to_compile(version[0])
    if spec is None:
        if not thread.unweighted:
            check_order(call.prediction, call.target)
        return call.plain()
    if spec.over == "scene":
        raise LegsError(
            "weights that are normalised over the scene are made of a store's levels, which a compiled graph cannot "
            "read: leave the loss out of torch.compile, or set LEGS_PRESET=legs"
        )
    call = call.aligned()
    return call.weighted(Weights(map=weight_map(call.target, spec, False)))


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

    def plain(*args: Any, **kwargs: Any) -> Result:
        thread.unweighted += 1
        try:
            return function(*args, **kwargs)
        finally:
            thread.unweighted -= 1

    return plain
