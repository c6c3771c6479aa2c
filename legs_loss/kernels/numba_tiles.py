"""The tiles of the fused loss: weighted L1 and SSIM, value and gradient in one walk over the images.

Each task walks down a tile, some rows a step, and keeps only the rows that the window sees:

    rows of x, y, x^2 + y^2, xy -> blurred along the row -> blurred across rows -> SSIM and its three slopes
        -> blurred along the row -> blurred across rows -> gradient

SSIM needs the two variances only as their sum, so four blurs go in and three come back. The window is symmetric and
the padding zero, so the blur is its own adjoint. The loops are plain: rows lie a constant pitch apart, so LLVM sees
that what is written does not overlap what is read, and makes vectors as wide as the processor has. Sums are taken by
column, which keeps their order whatever the width of a vector. (Vectors written down by hand took 0.88 of its time on
Zen 5, one thread, 1297x840, at three times the code.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from legs_loss.kernels.compiling import claimed, compiled, inlined, multiply_add, part
from legs_loss.kernels.numba_weights import weights_of_row
from legs_loss.similarity import CONTRAST_CONSTANT, LUMINANCE_CONSTANT, SIGMA, WINDOW_SIZE

_REACH = WINDOW_SIZE // 2
_TAPS = np.exp(-((np.arange(WINDOW_SIZE) - _REACH) ** 2) / (2 * SIGMA**2))
_TAPS = (_TAPS / _TAPS.sum()).astype(np.float32)
_T0, _T1, _T2, _T3, _T4, _T5 = (np.float32(tap) for tap in _TAPS[: _REACH + 1])
_LUMINANCE, _CONTRAST = np.float32(LUMINANCE_CONSTANT), np.float32(CONTRAST_CONSTANT)
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)

# A tile's inner size; it repeats ten rows and columns of its neighbours' work on each side.
TILE_HEIGHT, TILE_WIDTH = 256, 272
_HALO = 2 * _REACH
_STEP = 16  # rows
_GROUP = 4  # rows that are blurred across at once: a row is then loaded once for all four
_PITCH = TILE_WIDTH + 32  # floats of a row: with both halos, in whole cache lines


class Tile(NamedTuple):
    """A tile of a channel of a view.

    plane: where in memory the channel begins.
    top, bottom, left, right: the tile's edges, pixels.
    """

    plane: int
    top: int
    bottom: int
    left: int
    right: int


class Rows(NamedTuple):
    """A task's memory, rows of _PITCH floats.

    plain: a row of the four moments; the columns outside the image stay zero.
    moments, slopes: four and three quantities, blurred along the row: the rows of this step, below the ten before them.
    blurred: the four moments of a group of rows, blurred across rows; of the slopes three.
    made: SSIM's three slopes and its values, a group of rows.
    sums: column by column, the weighted absolute error and SSIM.
    """

    plain: np.ndarray
    moments: np.ndarray
    slopes: np.ndarray
    blurred: np.ndarray
    made: np.ndarray
    sums: np.ndarray


@compiled(fastmath=False)
def all_tiles(counter, tasks, images, down, across, scales, source, gradient, sums):  # type: ignore[no-untyped-def]
    """Compute the weighted L1 and SSIM tile by tile, and the gradient of the loss if that has a size.

    Args:
        counter, tasks: of `in_threads`; a task is a tile.
        images: an Images.
        down, across: how many tiles there are each way.
        scales: of the gradients of the weighted absolute errors and of SSIM.
        source: a WeightSource.
        gradient: float32 [B * C * H * W], or empty.
        sums: float64 [B * down * across, 2], zeros: the weighted absolute error and SSIM of each tile are added.
    """
    channels, height, width = images.channels, images.height, images.width
    tile_width = (width + across - 1) // across
    weights = np.empty((-(-height // down), tile_width), np.float32)
    rows = Rows(
        np.empty((4, _PITCH), np.float32),
        np.empty((4, (_HALO + _STEP) * _PITCH), np.float32),
        np.empty((3, (_HALO + _STEP) * _PITCH), np.float32),
        np.empty((4, _GROUP * _PITCH), np.float32),
        np.empty((4, _GROUP * _PITCH), np.float32),
        np.empty((2, _PITCH), np.float32),
    )
    task = claimed(counter)
    while task < tasks:
        view, place = task // (down * across), task % (down * across)
        top, bottom = height * (place // across) // down, height * (place // across + 1) // down
        left = tile_width * (place % across)
        right = min(left + tile_width, width)
        if left < right:
            rows.plain[:], rows.sums[:] = _ZERO, _ZERO
            for row in range(top, bottom):
                weights_of_row(images, source, view, row, left, right, weights[row - top])
            for channel in range(channels):
                tile = Tile((view * channels + channel) * height * width, top, bottom, left, right)
                _tile(images, tile, scales, weights, rows, gradient)
            _collect(rows.sums, sums[task])
        task = claimed(counter)


@part(fastmath=False)
def _collect(rows, sums):  # type: ignore[no-untyped-def]
    for k in range(2):
        for j in range(_PITCH):
            sums[k] += rows[k, j]


@inlined
def _tile(images, tile, scales, weights, rows, gradient):  # type: ignore[no-untyped-def]
    for base in range(tile.top - _HALO - _STEP, tile.bottom, _STEP):
        # The gradient's rows from `base` see SSIM's up to base + 5, and these see the image's up to base + 10.
        _moments_of_step(images, tile, base + _HALO, rows)
        for group in range(0, _STEP, _GROUP):
            _similarity_of_group(images, tile, base + _REACH, group, rows, gradient.size > 0)
        for group in range(0, _STEP, _GROUP):
            _gradient_of_group(images, tile, base, group, scales, weights, rows, gradient)
        for quantity in range(4):
            _shift_up(rows.moments[quantity])
        for quantity in range(3):
            _shift_up(rows.slopes[quantity])


@part(fastmath=False)
def _moments_of_step(images, tile, base, rows):  # type: ignore[no-untyped-def]
    """Blur the moments of the image's rows from `base` along the row."""
    first, last = max(0, tile.left - _HALO), min(images.width, tile.right + _HALO)
    start, count = first - tile.left + _HALO, tile.right - tile.left + 2 * _REACH
    plain = rows.plain
    for k in range(_STEP):
        row, at = base + k, (_HALO + k) * _PITCH
        if not tile.top - _HALO <= row < tile.bottom + _HALO:
            continue
        if 0 <= row < images.height:
            source = tile.plane + row * images.width
            x, y = images.x[source + first : source + last], images.y[source + first : source + last]
            _moments(x, y, plain[0, start:], plain[1, start:], plain[2, start:], plain[3, start:])
            for quantity in range(4):
                _blur_along(plain[quantity], rows.moments[quantity, at:], count)
        else:
            rows.moments[:, at : at + _PITCH] = _ZERO


@part(fastmath=False)
def _similarity_of_group(images, tile, base, group, rows, wanted):  # type: ignore[no-untyped-def]
    """Add the SSIM of a group of the rows from `base`; blur its slopes along the row."""
    top, bottom = tile.top - _REACH, tile.bottom + _REACH
    if base + group + _GROUP <= top or base + group >= bottom:
        return
    inner = tile.right - tile.left
    blurred, made = rows.blurred, rows.made
    for quantity in range(4):
        _blur_across(rows.moments[quantity, group * _PITCH :], blurred[quantity], inner + 2 * _REACH)
    _similarity(blurred[0], blurred[1], blurred[2], blurred[3], made[0], made[1], made[2], made[3])
    outside, beyond = max(0, _REACH - tile.left), min(inner + 2 * _REACH, images.width - tile.left + _REACH)
    for k in range(_GROUP):
        row, at, here = base + group + k, (_HALO + group + k) * _PITCH, k * _PITCH
        if tile.top <= row < tile.bottom:
            _add(made[3, here + _REACH :], rows.sums[1], inner)
        if not (wanted and top <= row < bottom):
            continue
        if 0 <= row < images.height:
            for quantity in range(3):
                made[quantity, here : here + outside] = _ZERO
                made[quantity, here + beyond : here + inner + 2 * _REACH] = _ZERO
                _blur_along(made[quantity, here:], rows.slopes[quantity, at:], inner)
        else:
            rows.slopes[:, at : at + _PITCH] = _ZERO


@part(fastmath=False)
def _gradient_of_group(images, tile, base, group, scales, weights, rows, gradient):  # type: ignore[no-untyped-def]
    """Add the weighted errors of a group of the rows from `base`; write their gradient."""
    if base + group + _GROUP <= tile.top or base + group >= tile.bottom:
        return
    inner, slopes = tile.right - tile.left, rows.blurred
    if gradient.size > 0:
        for quantity in range(3):
            _blur_across(rows.slopes[quantity, group * _PITCH :], slopes[quantity], inner)
    for k in range(max(0, tile.top - base - group), min(_GROUP, tile.bottom - base - group)):
        row, here = base + group + k, k * _PITCH
        at = tile.plane + row * images.width + tile.left
        x, y, weight = images.x[at : at + inner], images.y[at : at + inner], weights[row - tile.top]
        error_row(x, y, weight, rows.sums[0])
        if gradient.size > 0:
            out = gradient[at : at + inner]
            _gradient_row(x, y, weight, slopes[0, here:], slopes[1, here:], slopes[2, here:], scales, out)


@part(fastmath=False)
def _shift_up(rows):  # type: ignore[no-untyped-def]
    for j in range(_HALO * _PITCH):
        rows[j] = rows[j + _STEP * _PITCH]


@part(fastmath=False)
def _add(row, sums, count):  # type: ignore[no-untyped-def]
    for j in range(count):
        sums[j] += row[j]


@part(fastmath=False)
def _moments(x, y, first, second, squares, product):  # type: ignore[no-untyped-def]
    for j in range(x.size):
        u, v = x[j], y[j]
        first[j], second[j] = u, v
        squares[j] = multiply_add(u, u, v * v)
        product[j] = u * v


@inlined
def _window(a, b, c, d, e, f, g, h, i, j, k):  # type: ignore[no-untyped-def]
    outer = multiply_add(_T1, b + j, _T0 * (a + k))
    between = multiply_add(_T3, d + h, _T2 * (c + i))
    middle = multiply_add(_T5, f, _T4 * (e + g))
    return (outer + between) + middle


@part(fastmath=False)
def _blur_along(row, out, count):  # type: ignore[no-untyped-def]
    """Blur a row to the values whose windows lie in it."""
    for j in range(count):
        out[j] = _window(
            row[j], row[j + 1], row[j + 2], row[j + 3], row[j + 4], row[j + 5],
            row[j + 6], row[j + 7], row[j + 8], row[j + 9], row[j + 10],
        )  # fmt: skip


@part(fastmath=False)
def _blur_across(rows, out, count):  # type: ignore[no-untyped-def]
    """Blur fourteen rows to a group of four."""
    for j in range(count):
        a, b, c = rows[j], rows[j + _PITCH], rows[j + 2 * _PITCH]
        d, e, f = rows[j + 3 * _PITCH], rows[j + 4 * _PITCH], rows[j + 5 * _PITCH]
        g, h, i = rows[j + 6 * _PITCH], rows[j + 7 * _PITCH], rows[j + 8 * _PITCH]
        k, l, m = rows[j + 9 * _PITCH], rows[j + 10 * _PITCH], rows[j + 11 * _PITCH]
        n, o = rows[j + 12 * _PITCH], rows[j + 13 * _PITCH]
        out[j] = _window(a, b, c, d, e, f, g, h, i, k, l)
        out[j + _PITCH] = _window(b, c, d, e, f, g, h, i, k, l, m)
        out[j + 2 * _PITCH] = _window(c, d, e, f, g, h, i, k, l, m, n)
        out[j + 3 * _PITCH] = _window(d, e, f, g, h, i, k, l, m, n, o)


@part(fastmath=False)
def _similarity(means1, means2, squares, products, slope1, slope2, slope3, values):  # type: ignore[no-untyped-def]
    """Write the halves of SSIM's three slopes, the second one negated, and its values."""
    for j in range(means1.size):
        mean1, mean2 = means1[j], means2[j]
        mean12, means = mean1 * mean2, multiply_add(mean1, mean1, mean2 * mean2)
        above1, above2 = multiply_add(_TWO, mean12, _LUMINANCE), multiply_add(_TWO, products[j] - mean12, _CONTRAST)
        below1, below2 = means + _LUMINANCE, (squares[j] - means) + _CONTRAST
        scale = _ONE / (below1 * below2)
        slope = above1 * scale
        similarity = above2 * slope
        slope1[j] = scale * multiply_add(mean2, above2 - above1, mean1 * similarity * (below1 - below2))
        slope2[j] = similarity * below1 * scale
        slope3[j] = slope
        values[j] = similarity


@part(fastmath=False)
def error_row(x, y, weight, sums):  # type: ignore[no-untyped-def]
    """Add the weighted absolute errors of a row to the sums of its columns."""
    for j in range(x.size):
        sums[j] = multiply_add(weight[j], abs(x[j] - y[j]), sums[j])


@part(fastmath=False)
def _gradient_row(x, y, weight, slope1, slope2, slope3, scales, out):  # type: ignore[no-untyped-def]
    l1, ssim = scales
    for j in range(x.size):
        u, v = x[j], y[j]
        sign = np.float32(u > v) - np.float32(u < v)
        slope = multiply_add(v, slope3[j], slope1[j]) - u * slope2[j]
        out[j] = multiply_add(ssim, slope, l1 * weight[j] * sign)
