"""SSIM as 3D Gaussian Splatting computes it, and D-SSIM."""

from __future__ import annotations

import math
from typing import Any, Dict, Optional, Tuple, Union

import torch
import torch.nn.functional as F
from torch import Tensor

from legs_loss.config import is_off
from legs_loss.errors import LegsError
from legs_loss.images import is_compiling, read_pair, shape_of
from legs_loss.kernels.backends import fused_ssim

__all__ = ["d_ssim", "ssim"]

WINDOW_SIZE = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


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
    value to the last bit. In a training step value and gradient come from a backend where one takes the images
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

    Example:
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


def ssim_map(
    prediction: Tensor,
    target: Tensor,
    padding: str = "zeros",
    channels_last: Optional[bool] = None,
    window_size: int = WINDOW_SIZE,
) -> Tensor:
    """Return the SSIM of every pixel and channel, channels first, whose mean :func:`ssim` is; arguments as there.

    Padding "valid" leaves out the pixels whose window is not inside the image.
    """
    layout, prediction, target = read_pair(prediction, target, channels_last)
    first, second = layout.channels_first(prediction), layout.channels_first(target)
    dtype = torch.promote_types(torch.promote_types(first.dtype, second.dtype), torch.float32)
    with _no_autocast(first):
        return _ssim_map(first.to(dtype), second.to(dtype), padding, window_size)


def d_ssim(prediction: Tensor, target: Tensor, padding: str = "zeros", channels_last: Optional[bool] = None) -> Tensor:
    """Return 1 - SSIM, the structural term of 3DGS's loss, always to the last bit; arguments as for :func:`ssim`."""
    return 1.0 - ssim_map(prediction, target, padding, channels_last).mean()


def _ssim_map(first: Tensor, second: Tensor, padding: str, window_size: int) -> Tensor:
    # The order of operations is 3DGS's: in another order it rounds differently, and beta = 0 would not be 3DGS's loss.
    if not isinstance(window_size, int) or window_size < 1 or window_size % 2 == 0:
        raise LegsError(f"window_size must be an odd number of pixels, got {window_size!r}")
    first, second, margin = _padded(first, second, padding, window_size)
    channels = first.shape[-3]
    window = _window(channels, window_size, first)

    def blur(image: Tensor) -> Tensor:
        return F.conv2d(image, window, padding=margin, groups=channels)

    mean1, mean2 = blur(first), blur(second)
    mean1_sq, mean2_sq, mean12 = mean1.pow(2), mean2.pow(2), mean1 * mean2
    variance1 = blur(first * first) - mean1_sq
    variance2 = blur(second * second) - mean2_sq
    covariance = blur(first * second) - mean12
    return ((2 * mean12 + C1) * (2 * covariance + C2)) / ((mean1_sq + mean2_sq + C1) * (variance1 + variance2 + C2))


_windows: Dict[Tuple[Any, ...], Tensor] = {}  # made on the CPU once, not uploaded at every call


def _window(channels: int, size: int, like: Tensor) -> Tensor:
    """Return the window [channels, 1, size, size] on the device and of the type of an image."""
    if is_compiling():
        return _new_window(channels, size).to(like)  # part of the graph
    key = channels, size, like.device, like.dtype
    window = _windows.get(key)
    if window is None:
        with torch.inference_mode(False):  # autograd saves no tensor of inference mode
            window = _new_window(channels, size).to(like)
        if type(window) is Tensor:  # of a fake mode it stands for no values
            _windows[key] = window
    return window


def _new_window(channels: int, size: int) -> Tensor:
    taps = torch.tensor(
        [math.exp(-((x - size // 2) ** 2) / float(2 * SIGMA**2)) for x in range(size)],
        dtype=torch.float32,
    )
    taps = (taps / taps.sum()).unsqueeze(1)
    return taps.mm(taps.t()).expand(channels, 1, size, size).contiguous()


def _padded(first: Tensor, second: Tensor, padding: str, window_size: int) -> Tuple[Tensor, Tensor, int]:
    margin = window_size // 2
    if padding == "zeros":
        return first, second, margin
    height, width = first.shape[-2:]
    smallest = {"reflect": margin + 1, "replicate": 1, "valid": window_size}
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
