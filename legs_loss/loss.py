"""The LEGS loss and its weighted L1 as functions; similarity.py has the other term."""

from __future__ import annotations

from typing import Optional

import torch
from torch import Tensor

from legs_loss.autograd import backward_pass, check_order, is_compiling, is_trained
from legs_loss.counting import counted, note_graph, said, say_first
from legs_loss.errors import LegsError
from legs_loss.images import read_pair
from legs_loss.kernels.backends import LossPlan, fused, plan_of
from legs_loss.kernels.contract import Terms, terms_of
from legs_loss.responses import NEEDS_LEVELS
from legs_loss.similarity import WINDOW_SIZE, check_window, d_ssim
from legs_loss.spec import PRESETS, Spec, as_spec
from legs_loss.weights import Weights


def weighted_l1(
    prediction: Tensor,
    target: Tensor,
    weight: Optional[Tensor] = None,
    mask: Optional[Tensor] = None,
    renormalise: bool = False,
    channels_last: Optional[bool] = None,
) -> Tensor:
    """Return the mean over pixels of W times the mean over channels of |prediction - target|.

    Args:
        prediction: floats, [H, W], [C, H, W], [H, W, C], or batches of these, as of the views of several scenes
            [B, V, C, H, W]. The channel stands last where that axis is 1, 3 or 4 and the one for [C, H, W] is not.
        target: the same shape; an image beside a batch of one image is a batch of one.
        weight: one value a pixel, in the images' shape with one channel or without the channel, and for a batch one a
            view or one for all; None is 1 everywhere, and then the result is
            ``torch.abs(prediction - target).mean()``, bit-identical. It is not divided by its mean, as in the paper.
        mask: bool, or floats in [0, 1], in the weight's shapes: zeroes the weight where it is 0.
        renormalise: divide by the mask's mean, so that masked pixels do not count as pixels without error.
        channels_last: where the channel stands, for a shape that does not show it, as [3, 100, 4].

    Returns:
        A scalar, differentiable in prediction and target.

    Raises:
        LegsError: shapes or devices that do not fit; the message names both. A shape that may be read either way.

    Source: the LEGS paper, its weighted L1; the mean over channels (the paper writes a sum) is 3DGS's.

    Examples:
        >>> prediction, target = torch.zeros(1, 1, 2), torch.ones(1, 1, 2)
        >>> weighted_l1(prediction, target, weight=torch.tensor([[1.0, 3.0]]))
        tensor(2.)
    """
    layout, first, second = read_pair(prediction, target, channels_last)
    weights = Weights().times(layout.map_first(weight, target, "weight"))
    weights = weights.masked(layout.map_first(mask, target, "mask"), renormalise)
    loss = torch.abs(prediction - target).mean() if weights.map is None else mean_error(first, second, weights)
    _note(first, second, Weights(), "" if weight is None else "the map given to weighted_l1")
    return loss


def mean_error(prediction: Tensor, target: Tensor, weights: Weights) -> Tensor:
    """Return the weighted L1 of images [C, H, W] or [B, C, H, W] by torch, with weights that have no spec."""
    error = torch.abs(prediction - target)
    if weights.map is not None:
        # A float64 map must not turn a float32 loss into a float64 one.
        error = weights.map.to(torch.promote_types(error.dtype, torch.float32)) * error
    return weights.of_what_counts(error.mean())


def legs_loss(
    prediction: Tensor,
    target: Tensor,
    spec: Spec = "legs",
    weight: Optional[Tensor] = None,
    mask: Optional[Tensor] = None,
    lambda_dssim: float = 0.2,
    padding: str = "zeros",
    renormalise: bool = False,
    channels_last: Optional[bool] = None,
) -> Tensor:
    """Return (1 - lambda) * L_w + lambda * (1 - SSIM), the loss of a training step.

    Args:
        prediction: the rendering, floats in [0, 1], in a shape that :func:`weighted_l1` takes.
        target: the photograph of the same view, the same shape.
        spec: a preset's name or a spec. With beta 0 the loss is 3DGS's own, bit-identical. One that is normalised over
            the scene needs ``weight``: one call does not know the scene.
        weight: the target's weight map, if known; the spec is not used then.
        mask: zeroes the L1 weight where it is 0, and there SSIM sees no difference. A grey pixel counts in part in the
            L1, whole in SSIM.
        lambda_dssim: in [0, 1], the share of D-SSIM; 3DGS's name and value.
        padding: of SSIM, see :func:`~legs_loss.ssim`.
        renormalise: make both terms the mean over what counts: a masked pixel dilutes neither.
        channels_last: where the channel stands, for a shape that does not show it.

    Returns:
        A scalar, differentiable in the prediction. With a weight it is computed by a backend where one is
        installed and takes the images (docs/performance.md): equal up to rounding, differentiable once.

    Raises:
        LegsError: shapes, ranges or names that do not fit, or a target with NaN or infinity (on the CPU); or the
            target alone requires a gradient, where the weights come from it: the two are swapped.

    Source: the LEGS paper, its total loss; 3D Gaussian Splatting (Kerbl et al. 2023), equation 7.

    Examples:
        >>> target = torch.rand(3, 16, 16)
        >>> prediction = torch.rand(3, 16, 16, requires_grad=True)
        >>> legs_loss(prediction, target).backward()
        >>> prediction.grad.shape
        torch.Size([3, 16, 16])
    """
    spec = PRESETS[spec] if spec.__class__ is str and spec in PRESETS else as_spec(spec)
    terms = whole(lambda_dssim, padding)
    made_by = None if weight is not None or spec.beta == 0.0 or lambda_dssim == 1.0 else spec
    if made_by is not None and made_by.over == "scene":
        raise LegsError(NEEDS_LEVELS.format(where="one call does not know", then="and give LEGSLoss that store="))
    plan, image, photograph = plan_of(terms, made_by, prediction, target, channels_last)
    if made_by is not None and not (prediction.requires_grad and torch.is_grad_enabled()):
        check_order(prediction, target)
    weights, made = Weights(made_by), "" if made_by is None else "by legs_loss"
    if weight is not None:
        weights, made = weights.times(plan.layout.map_first(weight, photograph, "weight")), "the map given to legs_loss"
    if mask is not None:
        weights = weights.masked(plan.layout.map_first(mask, photograph, "mask"), renormalise)
    return total_loss(plan, image, photograph, weights, lambda_dssim, padding, made)


def whole(lambda_dssim: float, padding: str) -> Optional[Terms]:
    """Return the terms of a plan of :func:`total_loss`; None where it is torch's.

    Raises:
        LegsError: the share is no number in [0, 1], or no padding has that name.
    """
    if not (isinstance(lambda_dssim, (int, float, Tensor)) and 0.0 <= lambda_dssim <= 1.0):
        raise LegsError(f"lambda_dssim must be in [0, 1], got {lambda_dssim!r}")
    if padding != "zeros":
        check_window(WINDOW_SIZE, padding)
    by_torch = padding != "zeros" or lambda_dssim == 0.0 or is_compiling()
    return None if by_torch else terms_of(float(lambda_dssim))  # a tensor's hash is its place


def total_loss(
    plan: LossPlan, prediction: Tensor, target: Tensor, weights: Weights, lambda_dssim: float, padding: str, made: str
) -> Tensor:
    """Return :func:`legs_loss` of images [C, H, W] or [B, C, H, W], and count the step.

    Args:
        made: in words, for the first step's line, where a map comes from or who makes the weights of a spec; empty
            where there are none.
    """
    seen = weights.hidden(prediction, target) if weights.seen is not None else prediction
    loss = fused(plan, seen, target, weights)
    if loss is None:
        loss = mean_error(prediction, target, weights.with_map(target))
        if lambda_dssim > 0.0:
            structural = d_ssim(seen, target, padding, False)
            structural = weights.of_what_counts(structural, WINDOW_SIZE // 2 if padding == "valid" else 0)
            loss = (1.0 - lambda_dssim) * loss + lambda_dssim * structural
    if lambda_dssim < 1.0:  # else there is no L1
        _note(prediction, target, weights, made)
    return loss


def _note(prediction: Tensor, target: Tensor, weights: Weights, made: str) -> None:
    if not ((prediction.requires_grad and torch.is_grad_enabled()) or is_trained(prediction) or is_trained(target)):
        return
    if is_compiling():
        if made:
            note_graph()
        return
    first = backward_pass() == -1  # a checkpoint computes its loss again in the backward
    counted.weighted += first and made != ""
    counted.plain_steps += first and made == ""
    if not said:
        spec = weights.spec
        made = made if spec is None else f"{spec.operator}, {spec.curve}, beta {spec.beta:g}, {made}"
        say_first(f"L1 weighted: {made}" if made else "L1 plain: beta 0, or no weight is given")
