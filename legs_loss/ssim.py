"""SSIM as 3D Gaussian Splatting computes it, and D-SSIM."""

from __future__ import annotations

import math
from typing import Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.images import channels_first, check_pair, shape_of

__all__ = ["d_ssim", "ssim"]

WINDOW_SIZE = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def ssim(prediction: Tensor, target: Tensor, padding: str = "zeros", channels_last: bool = False) -> Tensor:
    """Return the mean structural similarity of two images, 1 for equal ones.

    An 11x11 Gaussian window of sigma 1.5, each channel by itself, C1 = 0.01^2, C2 = 0.03^2. With the default
    padding it is 3DGS's own value to the last bit (source: Inria's utils/loss_utils.py; Wang et al. 2004).

    Args:
        prediction: floats in [0, 1], [C, H, W] or [B, C, H, W]; channels-last on request.
        target: the same shape.
        padding: "zeros" as in 3DGS's code, "reflect", "replicate", or "valid" (only windows inside the image).
        channels_last: where the channel stands.

    Returns:
        A scalar, differentiable in both images. Half precision is computed in float32, with autocast off: the
        variances are differences of near-equal numbers.

    Raises:
        LegsError: the shapes differ, the padding is unknown, or the image is too small for it.

    Example:
        >>> image = torch.rand(3, 16, 16)
        >>> round(float(ssim(image, image)), 5)
        1.0
    """
    return ssim_map(prediction, target, padding, channels_last).mean()


def ssim_map(prediction: Tensor, target: Tensor, padding: str = "zeros", channels_last: bool = False) -> Tensor:
    """Return the SSIM of every pixel and channel, channels first, whose mean :func:`ssim` is; arguments as there.

    Padding "valid" leaves out the pixels whose window is not inside the image.
    """
    check_pair(prediction, target)
    first = channels_first(prediction, channels_last)
    second = channels_first(target, channels_last)
    dtype = torch.promote_types(torch.promote_types(first.dtype, second.dtype), torch.float32)
    with _no_autocast(first):
        return _ssim_map(first.to(dtype), second.to(dtype), padding)


def d_ssim(prediction: Tensor, target: Tensor, padding: str = "zeros", channels_last: bool = False) -> Tensor:
    """Return 1 - SSIM, the structural term of 3DGS's loss; arguments as for :func:`ssim`."""
    return 1.0 - ssim(prediction, target, padding, channels_last)


def _ssim_map(first: Tensor, second: Tensor, padding: str) -> Tensor:
    # The order of operations is 3DGS's: another one rounds differently, and beta = 0 would not be 3DGS's loss.
    first, second, margin = _padded(first, second, padding)
    channels = first.shape[-3]
    window = _window(channels).to(first)

    def blur(image: Tensor) -> Tensor:
        return F.conv2d(image, window, padding=margin, groups=channels)

    mean1, mean2 = blur(first), blur(second)
    mean1_sq, mean2_sq, mean12 = mean1.pow(2), mean2.pow(2), mean1 * mean2
    variance1 = blur(first * first) - mean1_sq
    variance2 = blur(second * second) - mean2_sq
    covariance = blur(first * second) - mean12
    return ((2 * mean12 + C1) * (2 * covariance + C2)) / ((mean1_sq + mean2_sq + C1) * (variance1 + variance2 + C2))


def _window(channels: int) -> Tensor:
    taps = torch.tensor(
        [math.exp(-((x - WINDOW_SIZE // 2) ** 2) / float(2 * SIGMA**2)) for x in range(WINDOW_SIZE)],
        dtype=torch.float32,
    )
    taps = (taps / taps.sum()).unsqueeze(1)
    return taps.mm(taps.t()).expand(channels, 1, WINDOW_SIZE, WINDOW_SIZE).contiguous()


def _padded(first: Tensor, second: Tensor, padding: str) -> Tuple[Tensor, Tensor, int]:
    margin = WINDOW_SIZE // 2
    if padding == "zeros":
        return first, second, margin
    height, width = first.shape[-2:]
    smallest = {"reflect": margin + 1, "replicate": 1, "valid": WINDOW_SIZE}
    if padding not in smallest:
        raise LegsError(f"no padding is named {padding!r}: choose zeros, {', '.join(smallest)}")
    if min(height, width) < smallest[padding]:
        raise LegsError(
            f'padding "{padding}" needs images of at least {smallest[padding]} pixels a side, got {shape_of(first)}'
        )
    if padding == "valid":
        return first, second, 0
    sides = (margin,) * 4
    return F.pad(first, sides, mode=padding), F.pad(second, sides, mode=padding), 0


def _no_autocast(like: Tensor) -> torch.autocast:
    device = like.device.type
    return torch.autocast(device if device in ("cpu", "cuda") else "cpu", enabled=False)
