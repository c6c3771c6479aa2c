"""Degrade training views, out of focus, moved or noisy: for experiments.

Every third training view is degraded, in turn by one of KINDS, the same ones whatever the seed of a run; held-out views
stay as they are.
"""

from __future__ import annotations

from typing import Callable, List, Sequence, Tuple

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

__all__ = ["EVERY", "KINDS", "degraded", "moved", "noisy", "out_of_focus"]

EVERY = 3


def out_of_focus(image: Tensor, index: int = 0) -> Tensor:
    """Return an image [C, H, W] blurred with a disc of 1/40 of its longer side across, as a lens out of focus does."""
    radius = max(1.0, max(image.shape[1:]) / 80.0)
    steps = torch.arange(-int(radius) - 1, int(radius) + 2)
    distance = (steps[:, None] ** 2 + steps[None] ** 2).sqrt()
    return _filtered(image, (radius + 0.5 - distance).clamp(0.0, 1.0))


def moved(image: Tensor, index: int = 0) -> Tensor:
    """Return an image [C, H, W] moved by 1/30 of its longer side while it was taken, across or down."""
    kernel = torch.ones(2 * max(1, max(image.shape[1:]) // 60) + 1, 1)
    return _filtered(image, kernel if index % 2 else kernel.T)


def noisy(image: Tensor, index: int = 0) -> Tensor:
    """Return an image [C, H, W] with noise of 10 of 255, rounded to 8 bits as a camera does."""
    generator = torch.Generator().manual_seed(7_000_003 + index)
    noise = torch.randn(image.shape, generator=generator) * 10.0 / 255.0
    return ((image + noise).clamp(0.0, 1.0) * 255.0).round() / 255.0


KINDS: Tuple[Callable[[Tensor, int], Tensor], ...] = (out_of_focus, moved, noisy)


def degraded(images: Sequence[Tensor]) -> List[Tensor]:
    """Return training images of which every third, from the second on, is degraded.

    >>> dot = torch.zeros(3, 32, 32)
    >>> dot[:, 16, 16] = 1.0
    >>> [index for index, image in enumerate(degraded([dot] * 9)) if not torch.equal(image, dot)]
    [1, 4, 7]
    """
    out = list(images)
    for turn, index in enumerate(range(1, len(out), EVERY)):
        out[index] = KINDS[turn % len(KINDS)](out[index], turn // len(KINDS))
    return out


def _filtered(image: Tensor, kernel: Tensor) -> Tensor:
    """Correlate each channel with a kernel [odd, odd], divided by its sum; the border is reflected."""
    kernel = (kernel / kernel.sum()).to(image)
    rows, columns = kernel.shape[0] // 2, kernel.shape[1] // 2
    padded = pad(image[:, None], (columns, columns, rows, rows), mode="reflect")
    return conv2d(padded, kernel[None, None])[:, 0].contiguous()
