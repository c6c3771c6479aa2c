"""The weighted L1 term alone, value and gradient in one walk over the images: strips of rows, the channels together."""

from __future__ import annotations

import numpy as np

from legs_loss.kernels.compiling import claimed, compiled, part
from legs_loss.kernels.numba_tiles import error_row
from legs_loss.kernels.numba_weights import weights_of_row

__all__ = ["ROWS", "all_strips"]

ROWS = 16  # of a strip


@compiled(fastmath=False)
def all_strips(counter, tasks, images, source, scale, gradient, sums):  # type: ignore[no-untyped-def]
    """Compute the weighted L1 strip by strip, and its gradient if that has a size.

    Args:
        counter, tasks: of `in_threads`; a task is a strip.
        images: an Images.
        source: a WeightSource.
        scale: of the gradient.
        gradient: float32 [B * C * H * W], or empty.
        sums: float64 [B * strips]: the weighted absolute error of each strip is written.
    """
    strips, width = tasks // images.views, images.width
    weights, errors = np.empty(width, np.float32), np.empty(width, np.float32)
    task = claimed(counter)
    while task < tasks:
        view, strip = task // strips, task % strips
        errors[:] = np.float32(0)
        for row in range(strip * ROWS, min((strip + 1) * ROWS, images.height)):
            weights_of_row(images, source, view, row, np.int64(0), width, weights)
            for channel in range(images.channels):
                at = ((view * images.channels + channel) * images.height + row) * width
                x, y = images.x[at : at + width], images.y[at : at + width]
                error_row(x, y, weights, errors)
                if gradient.size > 0:
                    _gradient_row(x, y, weights, scale, gradient[at : at + width])
        total = 0.0
        for j in range(width):
            total += errors[j]
        sums[task] = total
        task = claimed(counter)


@part(fastmath=False)
def _gradient_row(x, y, weight, scale, out):  # type: ignore[no-untyped-def]
    for j in range(x.size):
        out[j] = scale * weight[j] * (np.float32(x[j] > y[j]) - np.float32(x[j] < y[j]))
