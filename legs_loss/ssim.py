"""SSIM as a drop-in for the ``ssim`` of 3D Gaussian Splatting: in a training step by the backend that is available."""

from __future__ import annotations

from typing import Optional, Union

import torch
from torch import Tensor

from legs_loss.config import is_off
from legs_loss.images import read_pair
from legs_loss.kernels.backends import fused_ssim
from legs_loss.similarity import WINDOW_SIZE, ssim_map

__all__ = ["ssim"]


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
