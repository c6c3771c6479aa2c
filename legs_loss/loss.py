"""The LEGS loss: the weighted L1 term and D-SSIM, as functions."""

from __future__ import annotations

from typing import Optional

import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.images import read_pair
from legs_loss.kernels.backends import fused_loss
from legs_loss.kernels.contract import Weights
from legs_loss.similarity import d_ssim
from legs_loss.spec import Spec, as_spec
from legs_loss.weights import weight_map

__all__ = ["legs_loss", "weighted_l1"]


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
            ``torch.abs(prediction - target).mean()`` to the last bit. It is not divided by its mean, as in the paper.
        mask: bool, or floats in [0, 1], in the weight's shapes: zeroes the weight where it is 0.
        renormalise: divide by the mask's mean, so that masked pixels do not count as pixels without error.
        channels_last: where the channel stands, for a shape that does not show it, as [3, 100, 4].

    Returns:
        A scalar, differentiable in prediction and target.

    Raises:
        LegsError: shapes or devices that do not fit; the message names both. A shape that may be read either way.

    Source: the LEGS paper, its weighted L1; the mean over channels (the paper writes a sum) is 3DGS's.

    Example:
        >>> prediction, target = torch.zeros(1, 1, 2), torch.ones(1, 1, 2)
        >>> weighted_l1(prediction, target, weight=torch.tensor([[1.0, 3.0]]))
        tensor(2.)
    """
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
        spec: a preset's name or a spec. With beta 0 the loss is 3DGS's own to the last bit. A spec that is normalised
            over the scene uses the images of this call as the scene; ``LEGSLoss`` and ``l1_loss`` use all so far.
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
        LegsError: shapes, ranges or names that do not fit, or a target with NaN or infinity (on the CPU).

    Source: the LEGS paper, its total loss; 3D Gaussian Splatting (Kerbl et al. 2023), equation 7.

    Example:
        >>> target = torch.rand(3, 16, 16)
        >>> prediction = torch.rand(3, 16, 16, requires_grad=True)
        >>> legs_loss(prediction, target).backward()
        >>> prediction.grad.shape
        torch.Size([3, 16, 16])
    """
    spec = as_spec(spec)
    if not 0.0 <= lambda_dssim <= 1.0:
        raise LegsError(f"lambda_dssim must be in [0, 1], got {lambda_dssim!r}")
    layout, prediction, target = read_pair(prediction, target, channels_last)
    weight, mask = layout.map_first(weight, target, "weight"), layout.map_first(mask, target, "mask")
    prediction, target = layout.channels_first(prediction), layout.channels_first(target)
    weights = Weights(spec if weight is None else None, None, weight, mask, renormalise)
    fused = fused_loss(prediction, target, weights, lambda_dssim, padding)
    if fused is not None:
        return fused
    if weight is None and not spec.unweighted:
        weight = weight_map(target, spec, False)
    photometric = weighted_l1(prediction, target, weight, mask, renormalise, False)
    if lambda_dssim == 0.0:
        return photometric
    return (1.0 - lambda_dssim) * photometric + lambda_dssim * d_ssim(prediction, target, padding, False)
