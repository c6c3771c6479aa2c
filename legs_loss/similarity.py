"""SSIM as 3D Gaussian Splatting computes it, pixel by pixel, and D-SSIM: by torch, the reference of every backend."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Optional, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from legs_loss.autograd import is_compiling, is_transformed
from legs_loss.errors import LegsError
from legs_loss.images import read_pair, shape_of

WINDOW_SIZE = 11
SIGMA = 1.5
LUMINANCE_CONSTANT = 0.01**2  # the C1 and C2 of Wang et al., where a curve has these names
CONTRAST_CONSTANT = 0.03**2
_PADDINGS = ("zeros", "reflect", "replicate", "valid")


def ssim_map(
    prediction: Tensor,
    target: Tensor,
    padding: str = "zeros",
    channels_last: Optional[bool] = None,
    window_size: int = WINDOW_SIZE,
) -> Tensor:
    """Return the SSIM of every pixel and channel, channels first; arguments as for :func:`~legs_loss.ssim`, their mean.

    Padding "valid" leaves out the pixels whose window is not inside the image.
    """
    check_window(window_size, padding)
    _, first, second = read_pair(prediction, target, channels_last)
    dtype = torch.promote_types(torch.promote_types(first.dtype, second.dtype), torch.float32)
    device = first.device.type if first.device.type in ("cpu", "cuda") else "cpu"
    with torch.autocast(device, enabled=False):
        # The order of operations is 3DGS's: in another one it rounds differently, and beta = 0 would not be its loss.
        first, second, margin = _padded(first.to(dtype), second.to(dtype), padding, window_size)
        window = _window(first.shape[-3], window_size, first)

        def blur(image: Tensor) -> Tensor:
            return F.conv2d(image, window, padding=margin, groups=image.shape[-3])

        mean1, mean2 = blur(first), blur(second)
        mean1_sq, mean2_sq, mean12 = mean1.pow(2), mean2.pow(2), mean1 * mean2
        variance1 = blur(first * first) - mean1_sq
        variance2 = blur(second * second) - mean2_sq
        covariance = blur(first * second) - mean12
        scale = (mean1_sq + mean2_sq + LUMINANCE_CONSTANT) * (variance1 + variance2 + CONTRAST_CONSTANT)
        return ((2 * mean12 + LUMINANCE_CONSTANT) * (2 * covariance + CONTRAST_CONSTANT)) / scale


def check_window(window_size: int, padding: str) -> None:
    """Check the settings of a window.

    Raises:
        LegsError: its size is no odd number, or no padding has that name.
    """
    if not isinstance(window_size, int) or window_size < 1 or window_size % 2 == 0:
        raise LegsError(f"window_size must be an odd number of pixels, got {window_size!r}")
    if not (isinstance(padding, str) and padding in _PADDINGS):
        raise LegsError(f"no padding is named {padding!r}: choose {', '.join(_PADDINGS)}")


def d_ssim(prediction: Tensor, target: Tensor, padding: str = "zeros", channels_last: Optional[bool] = None) -> Tensor:
    """Return 1 - SSIM, the structural term of 3DGS's loss, bit-identical; arguments as for :func:`~legs_loss.ssim`."""
    return 1.0 - ssim_map(prediction, target, padding, channels_last).mean()


def _window(channels: int, size: int, like: Tensor) -> Tensor:
    """Return the window [channels, 1, size, size] on the device and of the type of an image."""
    if is_compiling() or is_transformed():
        return _new_window(channels, size).to(like)  # part of the graph
    return _kept_window(channels, size, like.device, like.dtype)


@lru_cache(maxsize=64)
def _kept_window(channels: int, size: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Return a window that was made on the CPU once, and is not uploaded at every call."""
    with torch.inference_mode(False):  # autograd saves no tensor of inference mode
        return _new_window(channels, size).to(device, dtype)


def _new_window(channels: int, size: int) -> Tensor:
    # On the CPU whatever the default device: a sum that rounds the other way there moves SSIM by 1e-5.
    values = [math.exp(-((x - size // 2) ** 2) / float(2 * SIGMA**2)) for x in range(size)]
    taps = torch.tensor(values, dtype=torch.float32, device="cpu")
    taps = (taps / taps.sum()).unsqueeze(1)
    return taps.mm(taps.t()).expand(channels, 1, size, size).contiguous()


def _padded(first: Tensor, second: Tensor, padding: str, window_size: int) -> Tuple[Tensor, Tensor, int]:
    margin = window_size // 2
    if padding == "zeros":
        return first, second, margin
    height, width = first.shape[-2:]
    smallest = {"reflect": margin + 1, "replicate": 1, "valid": window_size}
    if min(height, width) < smallest[padding]:
        needed = f"images of at least {smallest[padding]} pixels a side"
        raise LegsError(f'padding "{padding}" needs {needed}, got {shape_of(first)}')
    if padding == "valid":
        return first, second, 0
    sides = (margin,) * 4
    return F.pad(first, sides, mode=padding), F.pad(second, sides, mode=padding), 0
