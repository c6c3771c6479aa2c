"""The tiles of the fused loss: weighted L1 and SSIM, value and gradient in one walk over the images.

Each task walks down a tile, eight rows a step, and keeps only the rows that the window sees:

    rows of x, y, x^2 + y^2, xy -> blurred along the row -> blurred across rows -> SSIM and its three slopes
        -> blurred along the row -> blurred across rows -> gradient

SSIM needs the two variances only as their sum, so four blurs go in and three come back. The window is symmetric and
the padding zero, so the blur is its own adjoint. Loading is what the processor does most of here, so the blurs are
written to load little: see :func:`_blur_along` and :func:`_four_rows`. Loops are short, because a processor looks only
some hundred instructions ahead for work that need not wait. The weights of a tile are computed from the target once,
for all of its channels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange

from legs_loss.kernels.compiling import compiled
from legs_loss.kernels.numba_response import Piece
from legs_loss.kernels.numba_weights import weights_of_row
from legs_loss.kernels.simd import LANES, absolute, load, multiply_add, prefetch, shifted, sign, splat, store, total
from legs_loss.ssim import C1, C2, SIGMA, WINDOW_SIZE

__all__ = ["TILE_HEIGHT", "TILE_WIDTH", "all_tiles"]

_REACH = WINDOW_SIZE // 2
_TAPS = np.exp(-((np.arange(WINDOW_SIZE) - _REACH) ** 2) / (2 * SIGMA**2))
_TAPS = (_TAPS / _TAPS.sum()).astype(np.float32)
_T0, _T1, _T2, _T3, _T4, _T5 = (np.float32(tap) for tap in _TAPS[: _REACH + 1])
_C1, _C2 = np.float32(C1), np.float32(C2)
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)

# A tile's inner size, a width of whole vectors; it repeats ten rows and columns of its neighbours' work on each side.
TILE_HEIGHT, TILE_WIDTH = 128, 272
_STEP = 8  # rows
_KEPT = 3 * _STEP  # rows in a ring: those of this step and the ten before them
_BLOCK = 9  # vectors whose rows of all four quantities fit in the first cache

# A task's memory. SSIM is made _NEAR columns beyond the tile, from pixels up to _FAR beyond it: whole vectors.
_NEAR, _FAR = LANES, 2 * LANES
_LINE = 16  # floats; a row of an odd number of cache lines keeps rows out of one another's way in the cache
_PLAIN_ROW = TILE_WIDTH + 2 * _FAR
_WORK_ROW = TILE_WIDTH + 2 * _NEAR
_RING_ROW = 4 * _WORK_ROW + _LINE  # vector by vector of its three or four quantities
_PLAIN = 0  # a row of the four moments
_WORK = _PLAIN + 4 * _PLAIN_ROW  # a step's rows of four quantities: blurred moments, then slopes; blurred slopes
_MOMENTS = _WORK + _STEP * 4 * _WORK_ROW  # two rings, of what is blurred along the row
_SLOPES = _MOMENTS + _KEPT * _RING_ROW
_STATE = _SLOPES + _KEPT * _RING_ROW


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


class Weights(NamedTuple):
    """The weights of a tile's pixels, float32 [height * width], or empty; their row is of the widest tile."""

    values: np.ndarray
    width: int


@compiled(parallel=True, fastmath=False)
def all_tiles(images, down, across, share, source, gradient, sums):  # type: ignore[no-untyped-def]
    """Compute the whole loss tile by tile, and its gradient if that has a size.

    Args:
        images: an Images.
        down, across: how many tiles there are each way.
        share: lambda of D-SSIM.
        source: a WeightSource.
        gradient: float32 [B * C * H * W], or empty.
        sums: float64 [B * down * across, 2], zeros: the weighted absolute error and SSIM of each tile are added.
    """
    x, y = images.x, images.y
    views, channels, height, width = images.views, images.channels, images.height, images.width
    size = np.float32(x.size)
    scales = ((_ONE - share) / size, -_TWO * share / size)  # the second one, of halves of slopes
    # As even as whole vectors allow.
    tile_width = (width + across * LANES - 1) // (across * LANES) * LANES
    for task in prange(views * down * across):
        view, place = task // (down * across), task % (down * across)
        top, bottom = height * (place // across) // down, height * (place // across + 1) // down
        left = tile_width * (place % across)
        right = min(left + tile_width, width)
        if left < right:
            weights = np.empty((bottom - top) * tile_width if source.kind > 0 else 0, np.float32)
            for row in range(top, bottom):
                if source.kind == 2:
                    for channel in range(channels):
                        ahead = ((view * channels + channel) * height + row + _STEP) * width
                        for j in range(ahead + left, ahead + right, _LINE):
                            prefetch(y, j)
                weights_of_row(images, source, Piece(view, row, left, right), weights, (row - top) * tile_width)
            memory = np.empty(_STATE + _LINE, np.float32)
            state = memory[-(memory.ctypes.data // 4) % _LINE :]  # from the start of a cache line
            for channel in range(channels):
                tile = Tile((view * channels + channel) * height * width, top, bottom, left, right)
                _tile(images, tile, scales, Weights(weights, tile_width), state, gradient, sums[task])


@compiled(fastmath=False)
def _tile(images, tile, scales, weights, state, gradient, sums):  # type: ignore[no-untyped-def]
    x, y, height, width = images.x, images.y, images.height, images.width
    plane, top, bottom, left, right = tile
    inner = right - left
    vectors = (inner + LANES - 1) // LANES
    needed = LANES * vectors + 2 * _FAR
    # The columns that this tile reads; what is not of the image stays zero.
    first, last = max(0, left - _FAR), min(width, left - _FAR + needed)
    if last - first < needed:
        _clear(state, _PLAIN, 4 * _PLAIN_ROW)
    wanted = gradient.size > 0
    newest = 0
    for row in range(top - 3 * _STEP, bottom, _STEP):
        # The gradient's rows from `row` see SSIM up to the rows from `middle`, and these see the image up to `ahead`.
        middle, ahead = row + _REACH, row + 2 * _REACH
        newest = (newest + _STEP) % _KEPT
        for k in range(max(0, top - 2 * _REACH - ahead), min(_STEP, bottom + 2 * _REACH - ahead)):
            out = _MOMENTS + (newest + k) * _RING_ROW
            if 0 <= ahead + k < height:
                source = plane + (ahead + k) * width + first
                _moments(x, y, source, width, last - first, state, _PLAIN + first - (left - _FAR))
                for quantity in range(4):
                    at = _PLAIN + quantity * _PLAIN_ROW
                    _blur_along(state, at, out + quantity * LANES, 4 * LANES, vectors + 2)
            else:
                _clear(state, out, 4 * LANES * (vectors + 2))
        if row >= top - 2 * _STEP:
            for start in range(0, vectors + 2, _BLOCK):
                count = min(_BLOCK, vectors + 2 - start)
                _blur_across(state, _MOMENTS, newest, 4, start, count)
                for k in range(_STEP):
                    _similarity(state, _WORK + k * 4 * _WORK_ROW + start * LANES, count)
            for k in range(max(0, top - _REACH - middle), min(_STEP, bottom + _REACH - middle)):
                at = _WORK + k * 4 * _WORK_ROW
                out = _SLOPES + (newest + k) * _RING_ROW
                if 0 <= middle + k < height:
                    if top <= middle + k < bottom:
                        sums[1] += _sum(state, at + 3 * _WORK_ROW + _NEAR, inner)
                    if wanted:
                        for quantity in range(3):
                            _clear_outside(state, at + quantity * _WORK_ROW, left, width, vectors)
                            _blur_along(state, at + quantity * _WORK_ROW, out + quantity * LANES, 3 * LANES, vectors)
                elif wanted:
                    _clear(state, out, 3 * LANES * vectors)
        if row >= top:
            for start in range(0, vectors, _BLOCK):
                if wanted:
                    _blur_across(state, _SLOPES, newest, 3, start, min(_BLOCK, vectors - start))
                begin = start * LANES
                count = min(_BLOCK * LANES, inner - begin)
                for k in range(min(_STEP, bottom - row)):
                    source = plane + (row + k) * width + left + begin
                    weight = (row + k - top) * weights.width + begin
                    at = _WORK + k * 4 * _WORK_ROW + begin
                    sums[0] += _errors(images, source, count, scales, weights.values, weight, state, at, gradient)


@compiled(fastmath=False)
def _clear(state, at, count):  # type: ignore[no-untyped-def]
    zero = splat(_ZERO)
    for j in range(at, at + count, LANES):
        store(state, j, zero)


@compiled(fastmath=False)
def _clear_outside(state, at, left, width, vectors):  # type: ignore[no-untyped-def]
    # Column j of the image is at j - left + _NEAR.
    for j in range(_NEAR - left):
        state[at + j] = _ZERO
    for j in range(width - left + _NEAR, LANES * vectors + 2 * _NEAR):
        state[at + j] = _ZERO


@compiled(fastmath=False)
def _moments(x, y, source, width, count, state, at):  # type: ignore[no-untyped-def]
    whole = count - count % LANES
    for j in range(0, whole, LANES):
        # The next step's row. A tile's rows lie far apart in memory, and the processor does not foresee them.
        prefetch(x, source + j + _STEP * width)
        prefetch(y, source + j + _STEP * width)
        u, v = load(x, source + j), load(y, source + j)
        store(state, at + j, u)
        store(state, at + j + _PLAIN_ROW, v)
        store(state, at + j + 2 * _PLAIN_ROW, multiply_add(u, u, v * v))
        store(state, at + j + 3 * _PLAIN_ROW, u * v)
    for j in range(whole, count):
        p, q = x[source + j], y[source + j]
        state[at + j] = p
        state[at + j + _PLAIN_ROW] = q
        state[at + j + 2 * _PLAIN_ROW] = p * p + q * q
        state[at + j + 3 * _PLAIN_ROW] = p * q


@compiled(fastmath=False)
def _blur_along(state, at, out, apart, count):  # type: ignore[no-untyped-def]
    """Blur vectors along the row, the first of them around state[at + LANES]; write them a distance apart.

    Six of a window's eleven vectors are loaded anew. Two are made from their neighbours: a load across two cache lines,
    as every second one is, takes twice as long. Three come from the window before.
    """
    t0, t1, t2, t3, t4, t5 = splat(_T0), splat(_T1), splat(_T2), splat(_T3), splat(_T4), splat(_T5)
    before5, before4 = load(state, at + 3), load(state, at + 4)
    before3, here = load(state, at + 5), load(state, at + 8)
    for j in range(count):
        i = at + LANES * j
        before1, after1 = load(state, i + 7), load(state, i + 9)
        after3, after4 = load(state, i + 11), load(state, i + 12)
        after5, after8 = load(state, i + 13), load(state, i + 16)
        outer = multiply_add(t1, before4 + after4, t0 * (before5 + after5))
        between = multiply_add(t3, shifted(before4, here, 2) + shifted(here, after4, 2), t2 * (before3 + after3))
        middle = multiply_add(t5, here, t4 * (before1 + after1))
        store(state, out + j * apart, (outer + between) + middle)
        before5, before4, before3, here = after3, after4, after5, after8


@compiled(fastmath=False)
def _blur_across(state, ring, newest, quantities, start, count):  # type: ignore[no-untyped-def]
    """Blur the last eighteen rows of a ring to eight rows of each quantity."""
    apart = quantities * LANES
    for quantity in range(quantities):
        at = ring + start * apart + quantity * LANES
        one = at + ((newest + _STEP) % _KEPT + 6) * _RING_ROW
        two = at + (newest + 2 * _STEP) % _KEPT * _RING_ROW
        three = at + newest * _RING_ROW
        out = _WORK + quantity * _WORK_ROW + start * LANES
        half = 4 * _RING_ROW
        _four_rows(state, one, two, two + half, three, out, apart, count)
        _four_rows(state, two + 2 * _RING_ROW, two + half, three, three + half, out + 16 * _WORK_ROW, apart, count)


@compiled(fastmath=False)
def _four_rows(state, one, two, three, four, out, apart, count):  # type: ignore[no-untyped-def]
    """Blur fourteen rows to four: two rows from `one`, and four each from `two`, `three` and `four`.

    A row is loaded once for all four. From the outermost rows to the middle, few of them are in registers at a time.
    """
    for j in range(0, count * apart, apart):
        a, b = load(state, one + j), load(state, one + _RING_ROW + j)
        c, d = load(state, two + j), load(state, two + _RING_ROW + j)
        e, f = load(state, four + j), load(state, four + _RING_ROW + j)
        g, h = load(state, four + 2 * _RING_ROW + j), load(state, four + 3 * _RING_ROW + j)
        t = splat(_T0)
        p, q, r, s = t * (a + e), t * (b + f), t * (c + g), t * (d + h)
        a, h, t = load(state, two + 2 * _RING_ROW + j), load(state, three + 3 * _RING_ROW + j), splat(_T1)
        p, q = multiply_add(t, b + h, p), multiply_add(t, c + e, q)
        r, s = multiply_add(t, d + f, r), multiply_add(t, a + g, s)
        b, g, t = load(state, two + 3 * _RING_ROW + j), load(state, three + 2 * _RING_ROW + j), splat(_T2)
        p, q = multiply_add(t, c + g, p), multiply_add(t, d + h, q)
        r, s = multiply_add(t, a + e, r), multiply_add(t, b + f, s)
        c, f, t = load(state, three + j), load(state, three + _RING_ROW + j), splat(_T3)
        p, q = multiply_add(t, d + f, p), multiply_add(t, a + g, q)
        r, s = multiply_add(t, b + h, r), multiply_add(t, c + e, s)
        t = splat(_T4)
        p, q = multiply_add(t, a + c, p), multiply_add(t, b + f, q)
        r, s = multiply_add(t, c + g, r), multiply_add(t, f + h, s)
        t = splat(_T5)
        store(state, out, multiply_add(t, b, p))
        store(state, out + 4 * _WORK_ROW, multiply_add(t, c, q))
        store(state, out + 8 * _WORK_ROW, multiply_add(t, f, r))
        store(state, out + 12 * _WORK_ROW, multiply_add(t, g, s))
        out += LANES


@compiled(fastmath=False)
def _similarity(state, at, count):  # type: ignore[no-untyped-def]
    """Put the halves of SSIM's three slopes, the second one negated, and its values in the place of blurred moments."""
    one, two, c1, c2 = splat(_ONE), splat(_TWO), splat(_C1), splat(_C2)
    for j in range(at, at + LANES * count, LANES):
        mean1, mean2 = load(state, j), load(state, j + _WORK_ROW)
        squares, product = load(state, j + 2 * _WORK_ROW), load(state, j + 3 * _WORK_ROW)
        mean12, means = mean1 * mean2, multiply_add(mean1, mean1, mean2 * mean2)
        above1, above2 = multiply_add(two, mean12, c1), multiply_add(two, product - mean12, c2)
        below1, below2 = means + c1, (squares - means) + c2
        scale = one / (below1 * below2)
        slope = above1 * scale
        similarity = above2 * slope
        store(state, j, scale * multiply_add(mean2, above2 - above1, mean1 * similarity * (below1 - below2)))
        store(state, j + _WORK_ROW, similarity * below1 * scale)
        store(state, j + 2 * _WORK_ROW, slope)
        store(state, j + 3 * _WORK_ROW, similarity)


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
def _errors(images, source, count, scales, weights, weight, slopes, at, gradient):  # type: ignore[no-untyped-def]
    """Return the sum of the weighted errors of `count` pixels from `source`; write their gradient.

    Their weights begin at `weight`, the slopes of SSIM at `at`.
    """
    x, y, width = images.x, images.y, images.width
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
            prefetch(gradient, source + j + _STEP * width)  # see _moments; writing waits as well
            mixed = multiply_add(v, load(slopes, at + j + 2 * _WORK_ROW), load(slopes, at + j))
            mixed = mixed - u * load(slopes, at + j + _WORK_ROW)
            store(gradient, source + j, multiply_add(structural, mixed, l1 * w * sign(difference)))
    result = total(sums)
    for j in range(whole, count):
        p, q = x[source + j], y[source + j]
        gap = p - q
        factor = weights[weight + j] if weighted else _ONE
        result += factor * abs(gap)
        if wanted:
            slope = slopes[at + j] - p * slopes[at + j + _WORK_ROW] + q * slopes[at + j + 2 * _WORK_ROW]
            gradient[source + j] = ssim_scale * slope + l1_scale * factor * np.sign(gap)
    return result
