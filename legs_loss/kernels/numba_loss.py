"""The whole LEGS loss and its gradient in one pass over the images, on the CPU.

The loss is a scalar, so its gradient is known as soon as the images are: the forward pass computes both, and the
backward pass scales. Each task walks down a tile, four rows a step, and keeps only the rows that the window sees:

    rows of x, y, x^2 + y^2, xy -> blurred across rows -> blurred along the row -> SSIM and its three slopes
        -> blurred along the row -> blurred across rows -> gradient

SSIM needs the two variances only as their sum, so four blurs go in and three come back. The window is symmetric and
the padding zero, so the blur is its own adjoint. Four rows a step, because four neighbouring windows share most of the
rows they read. The weights of a tile are computed from the target once, for all of its channels.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Optional, Tuple, Union

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from legs_loss.errors import LegsError
from legs_loss.images import check_values, shape_of
from legs_loss.kernels.compiling import ONE_AT_A_TIME, compiled
from legs_loss.kernels.numba_response import CURVES, extremes, settings_of, weight_row
from legs_loss.kernels.vectors import LANES, absolute, load, multiply_add, sign, splat, store, total
from legs_loss.spec import WeightSpec
from legs_loss.ssim import C1, C2, SIGMA, WINDOW_SIZE
from legs_loss.weights import weight_map

__all__ = ["fused_loss"]

_REACH = WINDOW_SIZE // 2
_TAPS = np.exp(-((np.arange(WINDOW_SIZE) - _REACH) ** 2) / (2 * SIGMA**2))
_TAPS = (_TAPS / _TAPS.sum()).astype(np.float32)
_T0, _T1, _T2, _T3, _T4, _T5 = (np.float32(tap) for tap in _TAPS[: _REACH + 1])
_C1, _C2 = np.float32(C1), np.float32(C2)
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)

# A tile's inner size, a width of whole vectors; it repeats ten rows and columns of its neighbours' work on each side.
_TILE_HEIGHT, _TILE_WIDTH = 128, 272
_STEP = 4  # rows
# A row of a task's memory: the tile, its reach, and what the last vector writes beyond it.
_ROW = _TILE_WIDTH + 4 * _REACH + 2 * LANES + 4
# The rows of one quantity lie one after the other, eleven that the window sees first; every _RUN rows these are moved
# back to the start. (A ring would need no move, but its rows would not be a constant distance apart.)
_SEEN = WINDOW_SIZE - 1
_RUN = 8 * _STEP
_QUANTITY = (_SEEN + _RUN) * _ROW
_MOMENTS = 0  # four quantities
_SLOPES = _MOMENTS + 4 * _QUANTITY  # three, blurred along the row
_BLURRED = _SLOPES + 3 * _QUANTITY  # what a step has blurred across rows: four quantities of _STEP rows
_SLOPE_ROW = _BLURRED + 4 * _STEP * _ROW  # one row of the three slopes and of SSIM
_STATE = _SLOPE_ROW + 4 * _ROW


def fused_loss(
    prediction: Tensor,
    target: Tensor,
    weight: Union[Tensor, WeightSpec, None] = None,
    lambda_dssim: float = 0.2,
) -> Tensor:
    """Return (1 - lambda) * L_w + lambda * (1 - SSIM), as :func:`legs_loss.legs_loss` with zero padding.

    Args:
        prediction: on the CPU, [C, H, W] or [B, C, H, W]; what is not float32 is converted.
        target: the same shape; no gradient flows to it.
        weight: [1, H, W] or [B, 1, H, W]; a spec computes it from the target (without a map in memory where the curve
            is one of C1 to C4, the percentile 100 and ``normalise`` "none"); None is 1 everywhere.
        lambda_dssim: the share of D-SSIM.

    Returns:
        A scalar, differentiable once in the prediction. It repeats bit for bit, whatever the number of threads.

    Raises:
        LegsError: a spec, and a target with NaN, infinity or plainly of 0..255.
    """
    if isinstance(weight, WeightSpec) and not _in_kernel(weight):
        weight = weight_map(target, weight)
    return _FusedLoss.apply(prediction.float(), target.float(), weight, lambda_dssim)


def _in_kernel(spec: WeightSpec) -> bool:
    return spec.curve in CURVES and spec.percentile == 100.0 and spec.normalise == "none"


class _Weights(NamedTuple):
    """Where the weights come from: nowhere (kind 0), ``stored`` (1), or the target with all the others (2)."""

    kind: int
    stored: np.ndarray
    ranges: np.ndarray
    stencil: int
    side: np.float32
    middle: np.float32
    norm: int
    curve: int
    beta: np.float32


_EMPTY = np.empty(0, np.float32)
_NONE = _Weights(0, _EMPTY, _EMPTY.reshape(0, 2), 0, _ZERO, _ZERO, 0, 0, _ZERO)


class _FusedLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        prediction: Tensor,
        target: Tensor,
        weight: Union[Tensor, WeightSpec, None],
        lambda_dssim: float,
    ) -> Tensor:
        ctx.inputs = prediction.detach(), target.detach(), weight, lambda_dssim
        loss, ctx.gradient = _loss_and_gradient(prediction, target, weight, lambda_dssim, ctx.needs_input_grad[0])
        return prediction.new_tensor(loss)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_output: Tensor) -> Tuple[Optional[Tensor], ...]:
        # The gradient is handed over, not copied; a second backward of a retained graph makes it anew.
        gradient, ctx.gradient = ctx.gradient, None
        if gradient is None:
            prediction, target, weight, lambda_dssim = ctx.inputs
            gradient = _loss_and_gradient(prediction, target, weight, lambda_dssim, True)[1]
            assert gradient is not None
        return gradient if grad_output.item() == 1.0 else gradient.mul_(grad_output), None, None, None


def _loss_and_gradient(
    prediction: Tensor,
    target: Tensor,
    weight: Union[Tensor, WeightSpec, None],
    lambda_dssim: float,
    wanted: bool,
) -> Tuple[float, Optional[Tensor]]:
    channels, height, width = prediction.shape[-3:]
    views = prediction.numel() // (channels * height * width)
    x, y = _flat(prediction), _flat(target)
    weights = _NONE
    if isinstance(weight, WeightSpec):
        ranges = _ranges(target, y.reshape(views, channels, height, width), weight)
        weights = _Weights(2, _EMPTY, ranges, *settings_of(weight), CURVES[weight.curve], np.float32(weight.beta))
    elif weight is not None:
        weights = _NONE._replace(kind=1, stored=_flat(weight))
        if weights.stored.size not in (height * width, views * height * width):
            raise LegsError(f"weight {shape_of(weight)} does not fit images {shape_of(prediction)}")
    gradient = np.empty(x.size if wanted else 0, np.float32)
    tiles = (-(-height // _TILE_HEIGHT), -(-width // _TILE_WIDTH))
    sums = np.zeros((views * tiles[0] * tiles[1], 2))
    with ONE_AT_A_TIME:
        _all_tiles(x, y, (views, channels, height, width), tiles, np.float32(lambda_dssim), weights, gradient, sums)
    absolute_error, similarity = sums.sum(0) / x.size
    loss = (1.0 - lambda_dssim) * absolute_error + lambda_dssim * (1.0 - similarity)
    return loss, torch.from_numpy(gradient).reshape(prediction.shape) if wanted else None


def _flat(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().contiguous().numpy().reshape(-1)


def _ranges(target: Tensor, y: np.ndarray, spec: WeightSpec) -> np.ndarray:
    """Return of each view the least response and max - min + eps."""
    found = extremes(y, spec)
    if not (found[:, 2].max() <= 1.0 and found[:, 3].sum() == 0.0):
        check_values(target)  # overshoots are fine; it raises for what is not
    return np.stack([found[:, 0], found[:, 1] - found[:, 0] + np.float32(spec.eps)], 1)


@njit(parallel=True, cache=True)
def _all_tiles(x, y, shape, tiles, share, source, gradient, sums):  # type: ignore[no-untyped-def]
    views, channels, height, width = shape
    down, across = tiles
    size = np.float32(x.size)
    scales = ((_ONE - share) / size, -share / size)
    # As even as whole vectors allow.
    tile_width = (width + across * LANES - 1) // (across * LANES) * LANES
    for task in prange(views * down * across):
        view, tile = task // (down * across), task % (down * across)
        top, bottom = height * (tile // across) // down, height * (tile // across + 1) // down
        left = tile_width * (tile % across)
        right = min(left + tile_width, width)
        if left < right:
            weights = np.empty((bottom - top) * tile_width if source.kind > 0 else 0, np.float32)
            for row in range(top, bottom):
                _weights_of_row(y, view, shape, row, left, right, source, weights, (row - top) * tile_width)
            state = np.empty(_STATE, np.float32)
            for channel in range(channels):
                plane = (view * channels + channel) * height * width
                _tile(
                    x,
                    y,
                    plane,
                    (height, width),
                    (top, bottom, left, right),
                    scales,
                    weights,
                    tile_width,
                    state,
                    gradient,
                    sums[task],
                )


@compiled(fastmath=False)
def _weights_of_row(y, view, shape, row, left, right, source, out, at):  # type: ignore[no-untyped-def]
    height, width = shape[2], shape[3]
    if source.kind == 1:
        one_for_all = source.stored.size == height * width
        start = (row if one_for_all else view * height + row) * width
        out[at : at + right - left] = source.stored[start + left : start + right]
    elif source.kind == 2:
        low, span = source.ranges[view, 0], source.ranges[view, 1]
        settings = (source.stencil, source.side, source.middle, source.norm)
        weight_row(y, view, shape, row, left, right, settings, source.curve, low, span, source.beta, out, at)


@compiled(fastmath=False)
def _tile(x, y, plane, size, edges, scales, weights, weight_width, state, gradient, sums):  # type: ignore[no-untyped-def]
    height, width = size
    top, bottom, left, right = edges
    inner = right - left
    # The columns that this tile reads. Column j of the image is at j - left + 2 * _REACH of the moments; what is not of
    # the image is zero.
    first, last = max(0, left - 2 * _REACH), min(width, right + 2 * _REACH)
    margin = first - left + 2 * _REACH
    needed = inner + 4 * _REACH
    wanted = gradient.size > 0
    # While row `ahead` of the image is read, SSIM's row ahead - _REACH and the gradient's ahead - 2 * _REACH are made.
    run = 0
    for ahead in range(top - 2 * _REACH, bottom + 2 * _REACH, _STEP):
        if run == _RUN:
            for quantity in range(7):
                at = _MOMENTS + quantity * _QUANTITY
                state[at : at + _SEEN * _ROW] = state[at + _RUN * _ROW : at + (_RUN + _SEEN) * _ROW]
            run = 0
        for k in range(_STEP):
            at = _MOMENTS + (_SEEN + run + k) * _ROW
            inside = 0 <= ahead + k < height
            if not (inside and last - first == needed):
                for quantity in range(4):
                    _clear(state, at + quantity * _QUANTITY, needed)
            if inside:
                source = plane + (ahead + k) * width + first
                _moments(x, y, source, last - first, state, at + margin)
        middle = ahead - _REACH
        if middle + _STEP > top - _REACH:
            for quantity in range(4):
                at = _MOMENTS + quantity * _QUANTITY + run * _ROW
                _blur_across(state, at, _BLURRED + quantity * _STEP * _ROW, needed)
            for k in range(_STEP):
                slopes = _SLOPES + (_SEEN + run + k) * _ROW
                if 0 <= middle + k < height:
                    # Slopes are needed _REACH columns beyond the tile; similarity counts within it.
                    _slopes(state, _BLURRED + k * _ROW, _SLOPE_ROW, inner + 2 * _REACH)
                    if top <= middle + k < bottom:
                        sums[1] += _sum(state, _SLOPE_ROW + 3 * _ROW + _REACH, inner)
                    if wanted:
                        for quantity in range(3):
                            row = _SLOPE_ROW + quantity * _ROW
                            _clear_outside(state, row, left, width, inner)
                            _blur_along(state, row, slopes + quantity * _QUANTITY, inner)
                elif wanted:
                    for quantity in range(3):
                        _clear(state, slopes + quantity * _QUANTITY, inner)
        row = middle - _REACH
        if row + _STEP > top:
            if wanted:
                for quantity in range(3):
                    at = _SLOPES + quantity * _QUANTITY + run * _ROW
                    _blur_across(state, at, _BLURRED + quantity * _STEP * _ROW, inner)
            for k in range(_STEP):
                if top <= row + k < bottom:
                    source = plane + (row + k) * width + left
                    weight = (row + k - top) * weight_width
                    sums[0] += _errors(
                        x, y, source, inner, scales, weights, weight, state, _BLURRED + k * _ROW, gradient
                    )
        run += _STEP


@compiled(fastmath=False)
def _clear(state, at, count):  # type: ignore[no-untyped-def]
    zero = splat(_ZERO)
    for j in range(at, at + count, LANES):
        store(state, j, zero)


@compiled(fastmath=False)
def _clear_outside(state, at, left, width, inner):  # type: ignore[no-untyped-def]
    # Column j of the image is at j - left + _REACH; the window at the tile's last column sees inner + 2 * _REACH.
    for j in range(_REACH - left):
        state[at + j] = _ZERO
    for j in range(width - left + _REACH, inner + 2 * _REACH):
        state[at + j] = _ZERO


@compiled(fastmath=False)
def _moments(x, y, source, count, state, at):  # type: ignore[no-untyped-def]
    whole = count - count % LANES
    for j in range(0, whole, LANES):
        u, v = load(x, source + j), load(y, source + j)
        store(state, at + j, u)
        store(state, at + j + _QUANTITY, v)
        store(state, at + j + 2 * _QUANTITY, multiply_add(u, u, v * v))
        store(state, at + j + 3 * _QUANTITY, u * v)
    for j in range(whole, count):
        p, q = x[source + j], y[source + j]
        state[at + j] = p
        state[at + j + _QUANTITY] = q
        state[at + j + 2 * _QUANTITY] = p * p + q * q
        state[at + j + 3 * _QUANTITY] = p * q


@njit(inline="always")
def _window(a, b, c, d, e, f, g, h, i, k, l):  # type: ignore[no-untyped-def]
    outer = multiply_add(splat(_T2), c + i, multiply_add(splat(_T1), b + k, splat(_T0) * (a + l)))
    return multiply_add(splat(_T5), f, multiply_add(splat(_T4), e + g, multiply_add(splat(_T3), d + h, outer)))


@compiled(fastmath=False)
def _blur_across(state, at, out, count):  # type: ignore[no-untyped-def]
    """Blur four rows, from fourteen."""
    for j in range(0, count, LANES):
        row = at + j
        a, b, c = load(state, row), load(state, row + _ROW), load(state, row + 2 * _ROW)
        d, e, f = load(state, row + 3 * _ROW), load(state, row + 4 * _ROW), load(state, row + 5 * _ROW)
        g, h, i = load(state, row + 6 * _ROW), load(state, row + 7 * _ROW), load(state, row + 8 * _ROW)
        k, l, m = load(state, row + 9 * _ROW), load(state, row + 10 * _ROW), load(state, row + 11 * _ROW)
        n, o = load(state, row + 12 * _ROW), load(state, row + 13 * _ROW)
        store(state, out + j, _window(a, b, c, d, e, f, g, h, i, k, l))
        store(state, out + j + _ROW, _window(b, c, d, e, f, g, h, i, k, l, m))
        store(state, out + j + 2 * _ROW, _window(c, d, e, f, g, h, i, k, l, m, n))
        store(state, out + j + 3 * _ROW, _window(d, e, f, g, h, i, k, l, m, n, o))


@njit(inline="always")
def _along(state, at):  # type: ignore[no-untyped-def]
    return _window(
        load(state, at),
        load(state, at + 1),
        load(state, at + 2),
        load(state, at + 3),
        load(state, at + 4),
        load(state, at + 5),
        load(state, at + 6),
        load(state, at + 7),
        load(state, at + 8),
        load(state, at + 9),
        load(state, at + 10),
    )


@compiled(fastmath=False)
def _blur_along(state, at, out, count):  # type: ignore[no-untyped-def]
    for j in range(0, count, LANES):
        store(state, out + j, _along(state, at + j))


@compiled(fastmath=False)
def _slopes(state, at, out, count):  # type: ignore[no-untyped-def]
    """Blur the four moments along the row; write SSIM's three slopes, and its values after them."""
    one, two, c1, c2 = splat(_ONE), splat(_TWO), splat(_C1), splat(_C2)
    for j in range(0, count, LANES):
        mean1, mean2 = _along(state, at + j), _along(state, at + j + _STEP * _ROW)
        squares, product = _along(state, at + j + 2 * _STEP * _ROW), _along(state, at + j + 3 * _STEP * _ROW)
        mean12, means = mean1 * mean2, multiply_add(mean1, mean1, mean2 * mean2)
        above1, above2 = multiply_add(two, mean12, c1), multiply_add(two, product - mean12, c2)
        below1, below2 = means + c1, (squares - means) + c2
        scale = one / (below1 * below2)
        inverse1, inverse2 = below2 * scale, below1 * scale
        similarity = above1 * above2 * scale
        slope = multiply_add(mean2 * (above2 - above1), scale, mean1 * similarity * (inverse2 - inverse1))
        store(state, out + j, two * slope)
        store(state, out + j + _ROW, splat(-_TWO) * similarity * inverse2)
        store(state, out + j + 2 * _ROW, two * above1 * scale)
        store(state, out + j + 3 * _ROW, similarity)


@compiled(fastmath=False)
def _sum(state, at, count):  # type: ignore[no-untyped-def]
    whole = count - count % LANES
    sums = splat(_ZERO)
    for j in range(at, at + whole, LANES):
        sums = sums + load(state, j)
    result = total(sums)
    for j in range(at + whole, at + count):
        result += state[j]
    return result


@compiled(fastmath=False)
def _errors(x, y, source, count, scales, weights, weight, slopes, at, gradient):  # type: ignore[no-untyped-def]
    """Return the sum of a row's weighted errors; write the row of the gradient."""
    l1_scale, ssim_scale = scales
    l1, structural, one = splat(l1_scale), splat(ssim_scale), splat(_ONE)
    wanted, weighted = gradient.size > 0, weights.size > 0
    whole = count - count % LANES
    sums = splat(_ZERO)
    for j in range(0, whole, LANES):
        u, v = load(x, source + j), load(y, source + j)
        difference = u - v
        w = load(weights, weight + j) if weighted else one
        sums = multiply_add(w, absolute(difference), sums)
        if wanted:
            mixed = multiply_add(u, load(slopes, at + j + _STEP * _ROW), load(slopes, at + j))
            mixed = multiply_add(v, load(slopes, at + j + 2 * _STEP * _ROW), mixed)
            store(gradient, source + j, multiply_add(structural, mixed, l1 * w * sign(difference)))
    result = total(sums)
    for j in range(whole, count):
        p, q = x[source + j], y[source + j]
        gap = p - q
        factor = weights[weight + j] if weighted else _ONE
        result += factor * abs(gap)
        if wanted:
            slope = slopes[at + j] + p * slopes[at + j + _STEP * _ROW] + q * slopes[at + j + 2 * _STEP * _ROW]
            gradient[source + j] = ssim_scale * slope + l1_scale * factor * np.sign(gap)
    return result
