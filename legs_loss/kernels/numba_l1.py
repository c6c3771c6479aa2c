"""The weighted L1 term alone, value and gradient in one walk over the images: strips of rows, the channels together."""

from __future__ import annotations

import numpy as np
from numba import prange

from legs_loss.kernels.compiling import compiled
from legs_loss.kernels.numba_response import Piece
from legs_loss.kernels.numba_weights import weights_of_row
from legs_loss.kernels.simd import LANES, absolute, load, multiply_add, sign, splat, store, total

__all__ = ["ROWS", "all_strips"]

ROWS = 16  # of a strip
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@compiled(parallel=True, fastmath=False)
def all_strips(images, source, gradient, sums):  # type: ignore[no-untyped-def]
    """Compute the weighted L1 strip by strip, and its gradient if that has a size.

    Args:
        images: an Images.
        source: a WeightSource.
        gradient: float32 [B * C * H * W], or empty.
        sums: float64 [B * strips], zeros: the weighted absolute error of each strip is added.
    """
    strips = sums.size // images.views
    scale = _ONE / np.float32(images.x.size)
    for task in prange(sums.size):
        view, strip = task // strips, task % strips
        weights = np.empty(images.width + LANES if source.kind > 0 else 0, np.float32)
        for row in range(strip * ROWS, min((strip + 1) * ROWS, images.height)):
            weights_of_row(images, source, Piece(view, row, 0, images.width), weights, 0)
            for channel in range(images.channels):
                at = ((view * images.channels + channel) * images.height + row) * images.width
                sums[task] += _row(images.x, images.y, at, images.width, weights, scale, gradient)


@compiled(fastmath=False)
def _row(x, y, at, width, weights, scale, gradient):  # type: ignore[no-untyped-def]
    """Return the sum of a row's weighted errors, of x[at:] and y[at:]; write the row of the gradient."""
    wanted, weighted = gradient.size > 0, weights.size > 0
    scales, one, sums = splat(scale), splat(_ONE), splat(_ZERO)
    whole = width - width % LANES
    for j in range(0, whole, LANES):
        difference = load(x, at + j) - load(y, at + j)
        weight = load(weights, j) if weighted else one
        sums = multiply_add(weight, absolute(difference), sums)
        if wanted:
            store(gradient, at + j, scales * weight * sign(difference))
    result = total(sums)
    for j in range(whole, width):
        gap = x[at + j] - y[at + j]
        factor = weights[j] if weighted else _ONE
        result += factor * abs(gap)
        if wanted:
            gradient[at + j] = scale * factor * np.sign(gap)
    return result
