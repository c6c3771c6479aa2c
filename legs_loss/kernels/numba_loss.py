"""The whole LEGS loss and its gradient in one pass over the images, on the CPU.

The loss is a scalar, so its gradient is known as soon as the images are: the forward pass computes both, and the
backward pass scales. Each task walks down a tile of one channel and keeps only the eleven rows that the window sees:

    row -> blur along the row of x, y, x^2 + y^2, xy -> blur across eleven rows -> SSIM and its three derivatives
        -> blur along the row -> blur across eleven rows -> gradient

SSIM needs the two variances only as their sum, so four blurs go in and three come back. The window is symmetric and
the padding zero, so the blur is its own adjoint.

A task's rows live in one flat array, most of them a constant distance apart: LLVM vectorises a loop only if it can show
with a few comparisons that what is written is not what is read.
"""

from __future__ import annotations

from typing import Any, Optional, Tuple

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from legs_loss.ssim import C1, C2, SIGMA, WINDOW_SIZE

__all__ = ["fused_loss"]

_REACH = WINDOW_SIZE // 2
_TAPS = np.exp(-((np.arange(WINDOW_SIZE) - _REACH) ** 2) / (2 * SIGMA**2))
_TAPS = (_TAPS / _TAPS.sum()).astype(np.float32)
_T0, _T1, _T2, _T3, _T4, _T5 = (np.float32(tap) for tap in _TAPS[: _REACH + 1])
_C1, _C2 = np.float32(C1), np.float32(C2)
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)

# A tile's inner size; it repeats ten rows and columns of its neighbours' work on each side.
_TILE_HEIGHT, _TILE_WIDTH = 128, 256
# Where a task keeps its rows: the four moments; a ring of eleven rows of their blurs along the row; these summed across
# rows; SSIM's three slopes; a ring of eleven rows of their blurs; these summed across rows.
_ROW = _TILE_WIDTH + 32
_MOMENTS = 0
_RING = _MOMENTS + 4 * _ROW
_SUMMED = _RING + WINDOW_SIZE * 4 * _ROW
_SLOPES = _SUMMED + 4 * _ROW
_SLOPE_RING = _SLOPES + 3 * _ROW
_SLOPE_SUMMED = _SLOPE_RING + WINDOW_SIZE * 3 * _ROW
_STATE = _SLOPE_SUMMED + 3 * _ROW


def fused_loss(
    prediction: Tensor, target: Tensor, weight: Optional[Tensor] = None, lambda_dssim: float = 0.2
) -> Tensor:
    """Return (1 - lambda) * L_w + lambda * (1 - SSIM), as :func:`legs_loss.legs_loss` with zero padding.

    Args:
        prediction: float32 on the CPU, [C, H, W] or [B, C, H, W].
        target: the same shape; no gradient flows to it.
        weight: [1, H, W] or [B, 1, H, W]; None is 1 everywhere.
        lambda_dssim: the share of D-SSIM.

    Returns:
        A scalar, differentiable in the prediction. It repeats bit for bit, whatever the number of threads.
    """
    return _FusedLoss.apply(prediction, target, weight, lambda_dssim)


class _FusedLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, prediction: Tensor, target: Tensor, weight: Optional[Tensor], lambda_dssim: float) -> Tensor:
        planes = (-1,) + tuple(prediction.shape[-2:])
        x = _array(prediction).reshape(planes)
        y = _array(target).reshape(planes)
        w = np.empty((0, 0, 0), np.float32) if weight is None else _array(weight).reshape(planes)
        loss, gradient = _loss_and_gradient(x, y, w, np.float32(lambda_dssim))
        ctx.save_for_backward(torch.from_numpy(gradient).reshape(prediction.shape))
        return prediction.new_tensor(loss)

    @staticmethod
    def backward(ctx: Any, grad_output: Tensor) -> Tuple[Optional[Tensor], ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * grad_output, None, None, None


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _loss_and_gradient(x: np.ndarray, y: np.ndarray, w: np.ndarray, share: np.float32) -> Tuple[float, np.ndarray]:
    planes, height, width = x.shape
    down, across = _tiles(height, _TILE_HEIGHT), _tiles(width, _TILE_WIDTH)
    gradient = np.empty_like(x)
    sums = np.zeros((planes * down * across, 2))
    _all_tiles(x, y, w, share, down, across, gradient, sums)
    absolute, structural = sums.sum(0) / x.size
    return (1.0 - share) * absolute + share * (1.0 - structural), gradient


def _tiles(pixels: int, size: int) -> int:
    return (pixels + size - 1) // size


@njit(parallel=True, fastmath=True, cache=True)
def _all_tiles(x, y, w, share, down, across, gradient, sums):  # type: ignore[no-untyped-def]
    planes, height, width = x.shape
    size = np.float32(x.size)
    l1_scale, ssim_scale = (_ONE - share) / size, -share / size
    views = max(1, w.shape[0])
    for task in prange(planes * down * across):
        plane, tile = task // (down * across), task % (down * across)
        row, column = tile // across, tile % across
        weight = w[plane // (planes // views)] if w.shape[0] > 0 else w[:0, 0]
        _tile(
            x[plane],
            y[plane],
            weight,
            (height * row // down, height * (row + 1) // down),
            (width * column // across, width * (column + 1) // across),
            l1_scale,
            ssim_scale,
            gradient[plane],
            sums[task],
        )


@njit(fastmath=True, cache=True)
def _tile(x, y, weight, rows, columns, l1_scale, ssim_scale, gradient, sums):  # type: ignore[no-untyped-def]
    height, width = x.shape
    (top, bottom), (left, right) = rows, columns
    inner = right - left
    # The columns that this tile reads, and those whose SSIM it needs; outside the image the state stays zero.
    first, last = max(0, left - 2 * _REACH), min(width, right + 2 * _REACH)
    near, far = max(0, left - _REACH), min(width, right + _REACH)
    state = np.zeros(_STATE, np.float32)
    for ahead in range(top - 2 * _REACH, bottom + 2 * _REACH):
        slot = _RING + (ahead % WINDOW_SIZE) * 4 * _ROW
        if 0 <= ahead < height:
            _moments(x[ahead, first:last], y[ahead, first:last], state[_MOMENTS + first - left + 2 * _REACH :])
            for q in range(4):
                _blur_along(state[_MOMENTS + q * _ROW :], state[slot + q * _ROW :], inner + 2 * _REACH)
        else:
            state[slot : slot + 4 * _ROW] = _ZERO
        middle = ahead - _REACH
        if middle < top - _REACH:
            continue
        slope_slot = _SLOPE_RING + (middle % WINDOW_SIZE) * 3 * _ROW
        if 0 <= middle < height:
            for q in range(4):
                _blur_across(
                    state[_RING + q * _ROW :], 4 * _ROW, middle, state[_SUMMED + q * _ROW :], inner + 2 * _REACH
                )
            _slopes(state[_SUMMED + near - left + _REACH :], far - near)
            if top <= middle < bottom:
                sums[1] += _sum(state[_SUMMED + _REACH : _SUMMED + _REACH + inner])
            for q in range(3):
                _blur_along(state[_SLOPES + q * _ROW :], state[slope_slot + q * _ROW :], inner)
        else:
            state[slope_slot : slope_slot + 3 * _ROW] = _ZERO
        row = middle - _REACH
        if row >= top:
            for q in range(3):
                _blur_across(state[_SLOPE_RING + q * _ROW :], 3 * _ROW, row, state[_SLOPE_SUMMED + q * _ROW :], inner)
            u, v, out = x[row, left:right], y[row, left:right], gradient[row, left:right]
            _structural_gradient(state[_SLOPE_SUMMED:], u, v, ssim_scale, out)
            if weight.shape[0] > 0:
                sums[0] += _weighted_error(u, v, weight[row, left:right], l1_scale, out)
            else:
                sums[0] += _error(u, v, l1_scale, out)


# Each function below gets slices, so that its indices run from 0: numba lets a negative index count from the end, and
# where it cannot rule one out the loop is not vectorised.


@njit(fastmath=True)
def _moments(x, y, out):  # type: ignore[no-untyped-def]
    for j in range(x.shape[0]):
        u, v = x[j], y[j]
        out[j] = u
        out[j + _ROW] = v
        out[j + 2 * _ROW] = u * u + v * v
        out[j + 3 * _ROW] = u * v


@njit(fastmath=True)
def _blur_along(row, out, count):  # type: ignore[no-untyped-def]
    for j in range(count):
        out[j] = (
            _T0 * (row[j] + row[j + 10])
            + _T1 * (row[j + 1] + row[j + 9])
            + _T2 * (row[j + 2] + row[j + 8])
            + _T3 * (row[j + 3] + row[j + 7])
            + _T4 * (row[j + 4] + row[j + 6])
            + _T5 * row[j + 5]
        )


@njit(fastmath=True)
def _blur_across(ring, stride, middle, out, count):  # type: ignore[no-untyped-def]
    a = ring[((middle - 5) % WINDOW_SIZE) * stride :]
    b = ring[((middle - 4) % WINDOW_SIZE) * stride :]
    c = ring[((middle - 3) % WINDOW_SIZE) * stride :]
    d = ring[((middle - 2) % WINDOW_SIZE) * stride :]
    e = ring[((middle - 1) % WINDOW_SIZE) * stride :]
    f = ring[(middle % WINDOW_SIZE) * stride :]
    g = ring[((middle + 1) % WINDOW_SIZE) * stride :]
    h = ring[((middle + 2) % WINDOW_SIZE) * stride :]
    i = ring[((middle + 3) % WINDOW_SIZE) * stride :]
    k = ring[((middle + 4) % WINDOW_SIZE) * stride :]
    l = ring[((middle + 5) % WINDOW_SIZE) * stride :]
    for j in range(count):  # in two loops: one would read more rows than LLVM is willing to compare
        out[j] = _T0 * (a[j] + l[j]) + _T1 * (b[j] + k[j]) + _T2 * (c[j] + i[j])
    for j in range(count):
        out[j] += _T3 * (d[j] + h[j]) + _T4 * (e[j] + g[j]) + _T5 * f[j]


@njit(fastmath=True)
def _slopes(rows, count):  # type: ignore[no-untyped-def]
    # rows: the four summed moments, then the place of the three slopes. The first is overwritten with the similarity.
    for j in range(count):
        mean1, mean2 = rows[j], rows[j + _ROW]
        squares, product = rows[j + 2 * _ROW], rows[j + 3 * _ROW]
        mean12, means = mean1 * mean2, mean1 * mean1 + mean2 * mean2
        above1, above2 = _TWO * mean12 + _C1, _TWO * (product - mean12) + _C2
        below1, below2 = means + _C1, (squares - means) + _C2
        inverse1, inverse2 = _ONE / below1, _ONE / below2
        scale = inverse1 * inverse2
        similarity = above1 * above2 * scale
        rows[j + 4 * _ROW] = _TWO * (mean2 * (above2 - above1) * scale + mean1 * similarity * (inverse2 - inverse1))
        rows[j + 5 * _ROW] = -_TWO * similarity * inverse2
        rows[j + 6 * _ROW] = _TWO * above1 * scale
        rows[j] = similarity


@njit(fastmath=True)
def _sum(row):  # type: ignore[no-untyped-def]
    total = _ZERO
    for j in range(row.shape[0]):
        total += row[j]
    return total


@njit(fastmath=True)
def _structural_gradient(rows, x, y, scale, out):  # type: ignore[no-untyped-def]
    for j in range(out.shape[0]):
        out[j] = scale * (rows[j] + x[j] * rows[j + _ROW] + y[j] * rows[j + 2 * _ROW])


@njit(fastmath=True)
def _weighted_error(x, y, weight, scale, out):  # type: ignore[no-untyped-def]
    total = _ZERO
    for j in range(out.shape[0]):
        difference = x[j] - y[j]
        total += weight[j] * abs(difference)
        out[j] += scale * weight[j] * _sign(difference)
    return total


@njit(fastmath=True)
def _error(x, y, scale, out):  # type: ignore[no-untyped-def]
    total = _ZERO
    for j in range(out.shape[0]):
        difference = x[j] - y[j]
        total += abs(difference)
        out[j] += scale * _sign(difference)
    return total


@njit(fastmath=True, inline="always")
def _sign(value):  # type: ignore[no-untyped-def]
    return np.float32(value > _ZERO) - np.float32(value < _ZERO)
