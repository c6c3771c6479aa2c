"""The tiles of the fused loss: weighted L1 and SSIM, value and gradient in one walk over the images.

Each task walks down a tile, some rows a step, and keeps only the rows that the window sees:

    rows of x, y, x^2 + y^2, xy -> blurred across rows -> blurred along the row -> SSIM and its three slopes
        -> blurred across rows -> blurred along the row -> gradient

SSIM needs the two variances only as their sum, so four blurs go in and three come back. The window is symmetric and
the padding zero, so the blur is its own adjoint. The loops are plain: rows lie a constant pitch apart, so LLVM sees
that what is written does not overlap what is read, and makes vectors as wide as the processor has. A row's columns are
dealt to four planes, the fifth to the first again: so four windows along the row share their fourteen values, as four
across rows do. Sums are taken by column, which keeps their order whatever the width of a vector.
"""

from __future__ import annotations

from itertools import accumulate
from typing import NamedTuple, Tuple

import numpy as np

from legs_loss.kernels.compiling import aligned, claimed, compiled, inlined, multiply_add, part
from legs_loss.kernels.numba_weights import copy_row, weights_of_row
from legs_loss.similarity import CONTRAST_CONSTANT, LUMINANCE_CONSTANT, SIGMA, WINDOW_SIZE

_REACH = WINDOW_SIZE // 2
_TAPS = np.exp(-((np.arange(WINDOW_SIZE) - _REACH) ** 2) / (2 * SIGMA**2))
_TAPS = (_TAPS / _TAPS.sum()).astype(np.float32)
_T0, _T1, _T2, _T3, _T4, _T5 = (np.float32(tap) for tap in _TAPS[: _REACH + 1])
_LUMINANCE, _CONTRAST = np.float32(LUMINANCE_CONSTANT), np.float32(CONTRAST_CONSTANT)
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)

_HALO = 2 * _REACH
_STEP = 16  # rows
_GROUP = 4  # windows that share their values: rows of a group, and planes of a row
_LINE = 16  # floats of a cache line: what is computed of a plane, a multiple of each vector's width
_PLANE = 7 * _LINE
_PITCH = _GROUP * _PLANE  # floats of a row
_FIELD, _BLURRED = (_HALO + _STEP) * _PITCH, _STEP * _PITCH
# A tile's inner size; it repeats ten rows and columns of its neighbours' work on each side.
TILE_HEIGHT, TILE_WIDTH = 256, _PITCH - 2 * _HALO


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
    """A task's memory, rows of _PITCH floats; their columns are dealt to planes, but for plain and weights.

    plain: a row of x, of y and of the gradient; of x and y the columns outside the image stay zero.
    weights: of the tile's rows; what lies beyond its columns counts in no sum.
    fields: four moments, then three slopes: the rows of this step, below the ten before them.
    across: the four moments of a step's rows, blurred across rows; of the slopes three.
    along: a row of these, blurred along the row as well.
    inside: 1 where SSIM's columns lie in the image, else 0; then a row of zeros.
    sums: column by column, the weighted absolute error and SSIM.
    """

    plain: np.ndarray
    weights: np.ndarray
    fields: np.ndarray
    across: np.ndarray
    along: np.ndarray
    inside: np.ndarray
    sums: np.ndarray


def tile_memory(height: int) -> Tuple[Rows]:
    """Return the memory of a thread whose tiles have this height."""
    sizes = 3 * _PITCH, height * _PITCH, 7 * _FIELD, 4 * _BLURRED + _LINE, 4 * _PITCH + _LINE, 2 * _PITCH, 2 * _PITCH
    ends = [*accumulate(sizes)]
    return (Rows(*map(aligned(ends[-1]).__getitem__, map(slice, [0, *ends], ends))),)


@compiled(fastmath=False)
def all_tiles(rows, counter, tasks, images, down, across, scales, source, gradient, sums):  # type: ignore[no-untyped-def]
    """Compute the weighted L1 and SSIM tile by tile, and the gradient of the loss if that has a size.

    Args:
        rows, counter, tasks: of `tile_memory` and `in_threads`; a task is a tile.
        images: an Images.
        down, across: how many tiles there are each way.
        scales: of the gradients of the weighted absolute errors and of SSIM.
        source: a WeightSource.
        gradient: float32 [B * C * H * W], or empty.
        sums: float64 [B * down * across, 2], zeros: the weighted absolute error and SSIM of each tile are added.
    """
    task = claimed(counter)
    while task < tasks:
        _task(task, images, down, across, scales, source, rows, gradient, sums[task])
        task = claimed(counter)


@inlined
def _task(task, images, down, across, scales, source, rows, gradient, sums):  # type: ignore[no-untyped-def]
    channels, height, width = images.channels, images.height, images.width
    view, place = task // (down * across), task % (down * across)
    top, bottom = height * (place // across) // down, height * (place // across + 1) // down
    left = TILE_WIDTH * (place % across)
    right = min(left + TILE_WIDTH, width)
    rows.plain[:], rows.inside[:], rows.sums[:] = _ZERO, _ZERO, _ZERO
    for column in range(max(0, _REACH - left), min(right + _HALO, width + _REACH) - left):
        rows.inside[_dealt(column)] = _ONE
    for row in range(top, bottom):
        weights_of_row(images, source, view, row, left, right, rows.weights[(row - top) * _PITCH :])
    for channel in range(channels):
        tile = Tile((view * channels + channel) * height * width, top, bottom, left, right)
        # The gradient's rows from `base` see SSIM's up to base + 5, and these see the image's up to base + 10.
        for base in range(top - _HALO - _STEP, bottom, _STEP):
            _moments_of_step(images, tile, base + _HALO, rows)
            _similarity_of_step(images, tile, base + _REACH, rows)
            _gradient_of_step(images, tile, base, scales, rows, gradient)
            _shift_up(rows.fields)
    for j in range(right - left):
        sums[0] += rows.sums[_dealt(j)]
        sums[1] += rows.sums[_PITCH + _dealt(j + _REACH)]


@inlined
def _dealt(column):  # type: ignore[no-untyped-def]
    return column % _GROUP * _PLANE + column // _GROUP


@inlined
def _lines(columns):  # type: ignore[no-untyped-def]
    """Return how many floats of each plane hold so many columns, in whole lines."""
    return -(-columns // (_GROUP * _LINE)) * _LINE


@part(fastmath=False)
def _moments_of_step(images, tile, base, rows):  # type: ignore[no-untyped-def]
    """Write the moments of the image's rows from `base`."""
    first, last = max(0, tile.left - _HALO), min(images.width, tile.right + _HALO)
    start, count = first - tile.left + _HALO, _lines(tile.right - tile.left + 2 * _HALO)
    for row in range(max(base, tile.top - _HALO), min(base + _STEP, tile.bottom + _HALO)):
        x, y, at = rows.inside[_PITCH:], rows.inside[_PITCH:], tile.plane + row * images.width + first
        if 0 <= row < images.height:
            x, y = images.x[at:], images.y[at:]
        copy_row(x, rows.plain[start:], last - first)
        copy_row(y, rows.plain[_PITCH + start :], last - first)
        _moments(rows.plain, rows.fields[(_HALO + row - base) * _PITCH :], count)


@part(fastmath=False)
def _similarity_of_step(images, tile, base, rows):  # type: ignore[no-untyped-def]
    """Add the SSIM of the rows from `base`; write its slopes."""
    inner = tile.right - tile.left
    first, last = max(0, tile.top - _REACH - base), min(_STEP, tile.bottom + _REACH - base)
    _blur_across(rows.fields, rows.across, np.int64(4), first, last, _lines(inner + 2 * _HALO))
    for k in range(first, last):
        inside = rows.inside[0 if 0 <= base + k < images.height else _PITCH :]
        counted, out = np.float32(tile.top <= base + k < tile.bottom), rows.fields[4 * _FIELD + (_HALO + k) * _PITCH :]
        _blur_along(rows.across[k * _PITCH :], rows.along, np.int64(4), _lines(inner + _HALO))
        _similarity(rows.along, inside, counted, out, rows.sums[_PITCH:])


@part(fastmath=False)
def _gradient_of_step(images, tile, base, scales, rows, gradient):  # type: ignore[no-untyped-def]
    """Add the weighted errors of the rows from `base`; write their gradient."""
    inner = tile.right - tile.left
    first, last = max(0, tile.top - base), min(_STEP, tile.bottom - base)
    quantities, columns = (3, inner) if gradient.size > 0 else (0, 0)
    _blur_across(rows.fields[4 * _FIELD :], rows.across, quantities, first, last, _lines(inner + _HALO))
    for k in range(first, last):
        pixels, out = rows.fields[k * _PITCH :], rows.plain[2 * _PITCH :]
        weight = rows.weights[(base + k - tile.top) * _PITCH :]
        _blur_along(rows.across[k * _PITCH :], rows.along, quantities, _lines(inner))
        _gradient_row(pixels, weight, rows.along, scales, rows.sums, out, _lines(inner))
        copy_row(out, gradient[tile.plane + (base + k) * images.width + tile.left :], columns)


@part(fastmath=False)
def _shift_up(fields):  # type: ignore[no-untyped-def]
    for field in range(0, 7 * _FIELD, _FIELD):
        rows = fields[field:]
        for j in range(_HALO * _PITCH):
            rows[j] = rows[j + _STEP * _PITCH]


@part(fastmath=False)
def _moments(plain, out, count):  # type: ignore[no-untyped-def]
    for j in range(min(count, _PLANE)):  # which LLVM must know, or 4 * j could be less than zero
        _moment(plain[4 * j], plain[4 * j + _PITCH], out, j)
        _moment(plain[4 * j + 1], plain[4 * j + 1 + _PITCH], out, j + _PLANE)
        _moment(plain[4 * j + 2], plain[4 * j + 2 + _PITCH], out, j + 2 * _PLANE)
        _moment(plain[4 * j + 3], plain[4 * j + 3 + _PITCH], out, j + 3 * _PLANE)


@part(fastmath=False)
def _moment(x, y, out, j):  # type: ignore[no-untyped-def]
    out[j], out[j + _FIELD] = x, y
    out[j + 2 * _FIELD] = multiply_add(x, x, y * y)
    out[j + 3 * _FIELD] = x * y


@part(fastmath=False)
def _windows(a, b, c, d, e, f, g, h, i, j, k, l, m, n):  # type: ignore[no-untyped-def]
    """Return the four windows of fourteen values: tap by tap, since then few registers are in use."""
    p, q, r, s = _T0 * (a + k), _T0 * (b + l), _T0 * (c + m), _T0 * (d + n)
    p, q = multiply_add(_T1, b + j, p), multiply_add(_T1, c + k, q)
    r, s = multiply_add(_T1, d + l, r), multiply_add(_T1, e + m, s)
    p, q = multiply_add(_T2, c + i, p), multiply_add(_T2, d + j, q)
    r, s = multiply_add(_T2, e + k, r), multiply_add(_T2, f + l, s)
    p, q = multiply_add(_T3, d + h, p), multiply_add(_T3, e + i, q)
    r, s = multiply_add(_T3, f + j, r), multiply_add(_T3, g + k, s)
    p, q = multiply_add(_T4, e + g, p), multiply_add(_T4, f + h, q)
    r, s = multiply_add(_T4, g + i, r), multiply_add(_T4, h + j, s)
    return multiply_add(_T5, f, p), multiply_add(_T5, g, q), multiply_add(_T5, h, r), multiply_add(_T5, i, s)


@part(fastmath=False)
def _blur_across(fields, out, quantities, first, last, count):  # type: ignore[no-untyped-def]
    """Blur quantities across rows to the rows first <= k < last of a step."""
    span = _PITCH if count == _PLANE else _PLANE  # full planes are one loop
    for quantity in range(quantities):
        for k in range(first // _GROUP * _GROUP, last, _GROUP):
            for at in range(k * _PITCH, (k + 1) * _PITCH, span):
                rows, blurred = fields[quantity * _FIELD + at :], out[quantity * _BLURRED + at :]
                for j in range(span // _PLANE * count):
                    blurred[j], blurred[j + _PITCH], blurred[j + 2 * _PITCH], blurred[j + 3 * _PITCH] = _windows(
                        rows[j], rows[j + _PITCH], rows[j + 2 * _PITCH], rows[j + 3 * _PITCH], rows[j + 4 * _PITCH],
                        rows[j + 5 * _PITCH], rows[j + 6 * _PITCH], rows[j + 7 * _PITCH], rows[j + 8 * _PITCH],
                        rows[j + 9 * _PITCH], rows[j + 10 * _PITCH], rows[j + 11 * _PITCH], rows[j + 12 * _PITCH],
                        rows[j + 13 * _PITCH],
                    )  # fmt: skip


@part(fastmath=False)
def _blur_along(rows, out, quantities, count):  # type: ignore[no-untyped-def]
    """Blur a row of quantities to the columns whose windows lie in it."""
    for quantity in range(quantities):
        row, blurred = rows[quantity * _BLURRED :], out[quantity * _PITCH :]
        for j in range(count):
            blurred[j], blurred[j + _PLANE], blurred[j + 2 * _PLANE], blurred[j + 3 * _PLANE] = _windows(
                row[j], row[j + _PLANE], row[j + 2 * _PLANE], row[j + 3 * _PLANE], row[j + 1],
                row[j + _PLANE + 1], row[j + 2 * _PLANE + 1], row[j + 3 * _PLANE + 1], row[j + 2],
                row[j + _PLANE + 2], row[j + 2 * _PLANE + 2], row[j + 3 * _PLANE + 2], row[j + 3],
                row[j + _PLANE + 3],
            )  # fmt: skip


@part(fastmath=False)
def _similarity(rows, inside, counted, out, sums):  # type: ignore[no-untyped-def]
    """Write the halves of SSIM's three slopes, the second one negated; add its values if they are counted: 1 or 0."""
    for j in range(_PITCH):
        mean1, mean2, squares, products = rows[j], rows[j + _PITCH], rows[j + 2 * _PITCH], rows[j + 3 * _PITCH]
        mean12, means = mean1 * mean2, multiply_add(mean1, mean1, mean2 * mean2)
        above1, above2 = multiply_add(_TWO, mean12, _LUMINANCE), multiply_add(_TWO, products - mean12, _CONTRAST)
        below1, below2 = means + _LUMINANCE, (squares - means) + _CONTRAST
        scale = inside[j] / (below1 * below2)
        slope = above1 * scale
        similarity = above2 * slope
        out[j] = scale * multiply_add(mean2, above2 - above1, mean1 * similarity * (below1 - below2))
        out[j + _FIELD] = similarity * below1 * scale
        out[j + 2 * _FIELD] = slope
        sums[j] = multiply_add(counted, similarity, sums[j])


@part(fastmath=False)
def _gradient_row(pixels, weight, slopes, scales, sums, out, count):  # type: ignore[no-untyped-def]
    """Add the weighted absolute errors of a row to the sums of its columns; write the gradient."""
    for j in range(min(count, _PLANE)):
        one, two, three = j + _PLANE, j + 2 * _PLANE, j + 3 * _PLANE  # the first column is the eleventh of the pixels
        out[4 * j] = _gradient(pixels, two + 2, weight[4 * j], slopes, j, scales, sums)
        out[4 * j + 1] = _gradient(pixels, three + 2, weight[4 * j + 1], slopes, one, scales, sums)
        out[4 * j + 2] = _gradient(pixels, j + 3, weight[4 * j + 2], slopes, two, scales, sums)
        out[4 * j + 3] = _gradient(pixels, one + 3, weight[4 * j + 3], slopes, three, scales, sums)


@part(fastmath=False)
def _gradient(pixels, at, weight, slopes, j, scales, sums):  # type: ignore[no-untyped-def]
    (l1, ssim), x, y = scales, pixels[at], pixels[at + _FIELD]
    sums[j] = multiply_add(weight, abs(x - y), sums[j])
    sign = np.float32(x > y) - np.float32(x < y)
    slope = multiply_add(y, slopes[j + 2 * _PITCH], slopes[j]) - x * slopes[j + _PITCH]
    return multiply_add(ssim, slope, l1 * weight * sign)
