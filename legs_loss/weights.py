"""The weight map of a photograph: W = 1 + beta * f(E^)."""

from __future__ import annotations

import math
from typing import Optional, Tuple

import torch
from torch import Tensor

from legs_loss.curves import curve
from legs_loss.errors import LegsError
from legs_loss.images import channels_first, check_image, check_values, is_compiling
from legs_loss.response import gaussian_blur, normalise_response, response
from legs_loss.spec import Spec, WeightSpec, as_spec

__all__ = ["error_weight_map", "weight_from_response", "weight_map"]


def weight_map(image: Tensor, spec: Spec = "legs", channels_last: bool = False) -> Tensor:
    """Return the weight map of a training image.

    Args:
        image: the photograph as the training uses it, floats in [0, 1], [C, H, W] or [B, C, H, W]; [H, W, C] or
            [B, H, W, C] with ``channels_last``.
        spec: a preset's name or a :class:`~legs_loss.WeightSpec`.
        channels_last: where the channel stands.

    Returns:
        The image's shape with one channel, in [1, 1 + beta] (with ``normalise="mean"``: of mean 1), float32
        (float64 for float64). It carries no gradient. A constant image gets 1 everywhere.

    Raises:
        LegsError: not an image, or (on the CPU) values that are NaN, infinite or plainly of 0..255. On other
            devices the values are not looked at, since that would wait for the device: a NaN in the image
            makes the whole map NaN instead.

    Source: the LEGS paper, its weighted loss; the reflect border and the constant image are decided here.

    Example:
        >>> dot = torch.zeros(1, 3, 3)
        >>> dot[0, 1, 1] = 1.0
        >>> weight_map(dot, "legs-l")
        tensor([[[ 1.,  6.,  1.],
                 [ 6., 11.,  6.],
                 [ 1.,  6.,  1.]]])
    """
    spec = as_spec(spec)
    if spec.error > 0.0:
        raise LegsError("weights that follow the error (error > 0) need the rendering too: see error_weight_map")
    check_image(image)
    if image.device.type == "cpu" and not is_compiling():
        check_values(image, "image")
    strength = response(image, spec.operator, spec.p, channels_last)
    return weight_from_response(normalise_response(strength, spec.eps), spec)


def weight_from_response(normalised: Tensor, spec: Spec = "legs") -> Tensor:
    """Return the weight map of a normalised response, computed now or read from a store.

    Args:
        normalised: E^ in [0, 1], [1, H, W] or [B, 1, H, W] (or channels-last), any float type.
        spec: a preset's name or a spec; its operator and p are those that E^ was made with.

    Returns:
        The same shape, float32 (float64 for float64).

    Example:
        >>> weight_from_response(torch.tensor([[[0.0, 0.25, 1.0]]]), "legs")
        tensor([[[ 1.,  6., 11.]]])
    """
    spec = as_spec(spec)
    normalised = normalised.to(torch.promote_types(normalised.dtype, torch.float32))
    if spec.percentile < 100.0:
        normalised = (normalised / (_percentile(normalised, spec) + spec.eps)).clamp(max=1.0)
    weight = 1.0 + spec.beta * curve(spec.curve)(normalised)
    if spec.normalise == "mean":
        weight = weight / weight.mean(_pixels(weight), keepdim=True)
    return weight if spec.scale == 1.0 else spec.scale * weight


def error_weight_map(
    prediction: Tensor,
    target: Tensor,
    spec: WeightSpec,
    channels_last: bool = False,
    normalised: Optional[Tensor] = None,
) -> Tensor:
    """Return the weight map of this step for a spec whose weights follow the rendering's error (``spec.error``).

    The curve is applied to E^ ** (1 - s) * e ** s, normalised to [0, 1] an image at a time, where s is ``spec.error``
    and e the mean over channels of the absolute error, averaged with a Gaussian of ``spec.error_blur`` pixels.

    Args:
        prediction, target: the rendering and the photograph, [C, H, W] or [B, C, H, W]; [H, W, C] or [B, H, W, C] with
            ``channels_last``.
        spec: the settings.
        channels_last: where the channel stands.
        normalised: E^ of the target where it is known already, in the shape of the map.

    Returns:
        One value a pixel, as :func:`weight_map` returns it. It carries no gradient. A rendering without any error gets
        the weight of a constant image.

    Example:
        >>> target = torch.zeros(1, 1, 4)
        >>> prediction = torch.tensor([[[0.0, 0.1, 0.2, 0.4]]])
        >>> error_weight_map(prediction, target, WeightSpec(curve="C1", error=1.0, error_blur=0.0))
        tensor([[[ 1.0000,  3.5000,  6.0000, 11.0000]]])
    """
    if normalised is None:
        normalised = normalise_response(response(target, spec.operator, spec.p, channels_last), spec.eps)
    wrong = (channels_first(prediction, channels_last) - channels_first(target, channels_last)).detach().abs()
    wrong = gaussian_blur(wrong.mean(-3, keepdim=True).to(normalised.dtype), spec.error_blur)
    mixed = channels_first(normalised, channels_last) ** (1.0 - spec.error) * wrong**spec.error
    weight = weight_from_response(normalise_response(mixed, spec.eps), spec)
    return weight.movedim(-3, -1) if channels_last else weight


def _pixels(maps: Tensor) -> Tuple[int, ...]:
    return tuple(range(maps.dim() - 3, maps.dim()))


def _percentile(normalised: Tensor, spec: WeightSpec) -> Tensor:
    # The nearest rank, not torch.quantile: that refuses images of more than 16 million pixels.
    values = normalised.flatten(-3)
    rank = max(1, math.ceil(spec.percentile / 100.0 * values.shape[-1]))
    threshold = values.kthvalue(rank, dim=-1).values
    return threshold.reshape(threshold.shape + (1, 1, 1))
