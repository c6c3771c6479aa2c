"""The LEGS loss and its two terms as functions: the weighted L1, and SSIM as a drop-in for the ``ssim`` of 3DGS."""

from __future__ import annotations

from typing import Optional, Union

import torch
from torch import Tensor

from legs_loss.config import is_off
from legs_loss.counting import note_graph, note_step
from legs_loss.errors import LegsError
from legs_loss.images import check_order, is_compiling, is_trained, read_pair
from legs_loss.kernels.backends import fused_loss, fused_ssim
from legs_loss.kernels.contract import Weights
from legs_loss.levels import NEEDS_LEVELS
from legs_loss.similarity import WINDOW_SIZE, d_ssim, ssim_map
from legs_loss.spec import Spec, as_spec
from legs_loss.weights import weight_map

__all__ = ["legs_loss", "mean_error", "ssim", "weighted_l1"]


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
    loss = mean_error(prediction, target, weight, mask, renormalise, channels_last)
    _note(prediction, target, "" if weight is None else "the map given to weighted_l1")
    return loss


def mean_error(
    prediction: Tensor,
    target: Tensor,
    weight: Optional[Tensor] = None,
    mask: Optional[Tensor] = None,
    renormalise: bool = False,
    channels_last: Optional[bool] = None,
) -> Tensor:
    """Return :func:`weighted_l1`, as a part of a loss that is counted already."""
    layout, prediction, target = read_pair(prediction, target, channels_last)
    weight, mask = layout.map_first(weight, target, "weight"), layout.map_first(mask, target, "mask")
    if weight is None and mask is None:
        return torch.abs(prediction - target).mean()
    error = torch.abs(layout.channels_first(prediction) - layout.channels_first(target))
    if weight is not None:
        # A float64 map must not turn a float32 loss into a float64 one.
        weight = weight.to(torch.promote_types(error.dtype, torch.float32))
        error = weight * error
    if mask is None:
        return error.mean()
    mask = mask.to(torch.promote_types(error.dtype, torch.float32))
    loss = (mask * error).mean()
    if not renormalise:
        return loss
    covered = mask.expand_as(error).mean()
    return loss / covered.clamp(min=torch.finfo(covered.dtype).tiny)


def ssim(
    img1: Tensor,
    img2: Tensor,
    padding: Union[str, int] = "zeros",
    channels_last: Optional[bool] = None,
    *,
    window_size: int = WINDOW_SIZE,
    size_average: bool = True,
) -> Tensor:
    """Return the mean structural similarity of two images, 1 for equal ones; a drop-in for the ``ssim`` of 3DGS.

    A Gaussian window of 11x11 and sigma 1.5, each channel by itself, C1 = 0.01^2, C2 = 0.03^2 (source: Inria's
    utils/loss_utils.py; Wang et al. 2004). Where neither image is trained on (``no_grad``, evaluation) it is 3DGS's own
    value, bit-identical. In a training step value and gradient come from a backend where one takes the images
    (docs/performance.md): equal up to rounding, differentiable once; with LEGS_OFF=1 they are 3DGS's own there, too.

    Args:
        img1, img2: the two images, in either order, by 3DGS's names: floats in [0, 1], of one shape, [H, W],
            [C, H, W], [H, W, C] or batches of these; or an image beside a batch of one image, as 3DGS's takes them.
        padding: "zeros" as in 3DGS's code, "reflect", "replicate", or "valid" (only windows inside the image). A
            number is interpreted as 3DGS's third argument, ``window_size``, and the next one as ``size_average``.
        channels_last: where the channel stands, for a shape that does not show it.
        window_size: the window's side in pixels, odd.
        size_average: the mean over all images; False is one value an image, [B].

    Returns:
        A scalar (or [B]), differentiable in both images. Half precision is computed in float32, with autocast off: the
        variances are differences of near-equal numbers.

    Raises:
        LegsError: the shapes differ or may be read either way, the padding is unknown, the window is even, or the image
            is too small for it.

    Examples:
        >>> image = torch.rand(3, 16, 16)
        >>> round(float(ssim(image, image)), 5)
        1.0
    """
    if not isinstance(padding, str):
        if channels_last is not None:
            size_average = bool(channels_last)
        window_size, padding, channels_last = padding, "zeros", None
    if window_size == WINDOW_SIZE and size_average and torch.is_grad_enabled() and not is_off():
        layout, first, second = read_pair(img1, img2, channels_last)
        trained, constant = (first, second) if first.requires_grad else (second, first)
        if trained.requires_grad:
            fused = fused_ssim(layout.channels_first(trained), layout.channels_first(constant), padding)
            if fused is not None:
                return fused
    similarity = ssim_map(img1, img2, padding, channels_last, window_size)
    return similarity.mean() if size_average else similarity.mean(-3).mean(-2).mean(-1)


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
        mask: zeroes the L1 weight where it is 0. SSIM is not masked, as in 3DGS's code.
        lambda_dssim: in [0, 1], the share of D-SSIM; 3DGS's name and value.
        padding: of SSIM, see :func:`~legs_loss.ssim`.
        renormalise: divide the masked L1 term by the mask's mean.
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
    spec = as_spec(spec)
    if not 0.0 <= lambda_dssim <= 1.0:
        raise LegsError(f"lambda_dssim must be in [0, 1], got {lambda_dssim!r}")
    if weight is None and spec.over == "scene" and not spec.unweighted:
        raise LegsError(NEEDS_LEVELS.format(where="one call does not know", then="and give LEGSLoss that store="))
    layout, prediction, target = read_pair(prediction, target, channels_last)
    if weight is None and not spec.unweighted:
        check_order(prediction, target)
    made = "the map given to legs_loss"
    if weight is None and not is_compiling():  # a graph may have numbers that no text can have
        made = f"{spec.operator}, {spec.curve}, beta {spec.beta:g}, by legs_loss"
    _note(prediction, target, "" if weight is None and spec.unweighted else made)
    weight, mask = layout.map_first(weight, target, "weight"), layout.map_first(mask, target, "mask")
    prediction, target = layout.channels_first(prediction), layout.channels_first(target)
    weights = Weights(spec if weight is None else None, None, weight, mask, renormalise)
    fused = fused_loss(prediction, target, weights, lambda_dssim, padding)
    if fused is not None:
        return fused
    if weight is None and not spec.unweighted:
        weight = weight_map(target, spec, False)
    photometric = mean_error(prediction, target, weight, mask, renormalise, False)
    if lambda_dssim == 0.0:
        return photometric
    return (1.0 - lambda_dssim) * photometric + lambda_dssim * d_ssim(prediction, target, padding, False)


def _note(prediction: Tensor, target: Tensor, weights: str) -> None:
    if not (torch.is_grad_enabled() and (is_trained(prediction) or is_trained(target))):
        return
    if not is_compiling():
        note_step(weights)
    elif weights:
        note_graph(0)
