"""The response of a photograph and its weights, row by row, on the CPU: as torch computes it, but for the last bit.

The weight map of a view need not exist in memory: two numbers do, the least and the greatest response of the view. With
them :func:`weight_row` makes the weights where they are used, from pixels that are in the cache already.
"""

from __future__ import annotations

from typing import Dict, Optional, Tuple

import numpy as np
from numba import prange

from legs_loss.kernels.compiling import ONE_AT_A_TIME, compiled, inlined
from legs_loss.kernels.simd import (
    LANES,
    absolute,
    lane,
    load,
    maximum,
    minimum,
    multiply_add,
    splat,
    square_root,
    store,
)
from legs_loss.spec import WeightSpec

__all__ = [
    "CURVES",
    "NORMS",
    "STENCILS",
    "extremes",
    "map_of_responses",
    "photograph_response",
    "settings_of",
    "supports_response",
    "weight_row",
]

# The operators that are written here: kind of stencil, the weights of a gradient's outer and middle rows
STENCILS: Dict[str, Tuple[int, float, float]] = {
    "laplacian": (0, 0.0, 0.0),
    "laplacian8": (1, 0.0, 0.0),
    "central": (2, 0.0, 0.5),
    "sobel": (2, 1.0, 2.0),
    "scharr": (2, 3.0, 10.0),
}
NORMS = {1.0: 1, 2.0: 2, float("inf"): 3}
_SQUARED = 4  # the square of the norm 2
# C5 needs a sine; it and curves of the user's own are applied by torch, to a map.
CURVES = {"C1": 1, "C2": 2, "C3": 3, "C4": 4}

_ROWS = 32  # a task's rows, where only the response is wanted
_ZERO, _ONE, _TWO, _THREE = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(3.0)
_FOUR, _EIGHT = np.float32(4.0), np.float32(8.0)


def supports_response(spec: WeightSpec) -> bool:
    """Return whether the response of a spec can be computed here; the functions below take no other."""
    return spec.operator in STENCILS and spec.p in NORMS and spec.smooth == 0.0


def settings_of(spec: WeightSpec) -> Tuple[int, np.float32, np.float32, int]:
    """Return an operator and its norm as the functions here take them."""
    kind, side, middle = STENCILS[spec.operator]
    return kind, np.float32(side), np.float32(middle), NORMS[spec.p]


def map_of_responses(image: np.ndarray, spec: WeightSpec) -> Tuple[np.ndarray, np.ndarray]:
    """Return the response of images float32 [B, C, H, W] as float32 [B, H, W], and :func:`extremes` of it."""
    views, _, height, width = image.shape
    out = np.empty((views, height, width), np.float32)
    return out, _reduced(image, spec, out)


def extremes(image: np.ndarray, spec: WeightSpec) -> np.ndarray:
    """Return of each view of float32 [B, C, H, W] what its weights need, as float32 [B, 4].

    The least and the greatest response; a pixel's largest magnitude; 0, or NaN where a pixel is NaN or infinite.
    """
    return _reduced(image, spec, None)


def photograph_response(image: np.ndarray, spec: WeightSpec) -> np.ndarray:
    """Return the response of a photograph uint8 or uint16 [H, W, C], scaled to [0, 1], as float32 [H, W]."""
    height, width, channels = image.shape
    out = np.empty((height, width), np.float32)
    rows = max(1, min(height, (1 << 18) // (width * channels)))  # their floats stay in the cache
    planes = np.empty((channels, rows + 2, width), np.float32)
    full = np.float32(np.iinfo(image.dtype).max)
    _photograph(np.ascontiguousarray(image), full, settings_of(spec), planes, out.reshape(-1))
    return out


@compiled(fastmath=False)
def _photograph(image, full, settings, planes, out):  # type: ignore[no-untyped-def]
    height, width, channels = image.shape
    rows = planes.shape[1] - 2
    shape = (1, channels, rows + 2, width)
    row = np.empty(width + LANES, np.float32)
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        for i in range(top - 1, bottom + 1):
            _row_in_planes(image[_folded(i, height)].reshape(-1), full, planes, i - top + 1)
        for i in range(top, bottom):
            _response_row(planes.reshape(-1), 0, shape, i - top + 1, 0, width, settings, row, 0)
            out[i * width : (i + 1) * width] = row[:width]


@compiled(fastmath=False)
def _row_in_planes(source, full, planes, row):  # type: ignore[no-untyped-def]
    channels, _, width = planes.shape
    if channels == 3:  # a step that is known when it is compiled becomes shuffles of vectors
        red, green, blue = planes[0, row], planes[1, row], planes[2, row]
        for j in range(width):
            red[j] = np.float32(source[3 * j])
            green[j] = np.float32(source[3 * j + 1])
            blue[j] = np.float32(source[3 * j + 2])
    else:
        for channel in range(channels):
            for j in range(width):
                planes[channel, row, j] = np.float32(source[channels * j + channel])
    for channel in range(channels):
        plane = planes[channel, row]
        for j in range(width):
            plane[j] /= full


def _reduced(image: np.ndarray, spec: WeightSpec, out: Optional[np.ndarray]) -> np.ndarray:
    views, channels, height, width = image.shape
    strips = -(-height // _ROWS)
    found = np.empty((views * strips, 4), np.float32)
    kept = np.empty(0, np.float32) if out is None else out.reshape(-1)
    with ONE_AT_A_TIME:
        *operator, norm = settings_of(spec)
        # The root of the greatest square is the greatest root: one a view is enough.
        rooted = out is None and norm == NORMS[2.0]
        settings = (*operator, _SQUARED if rooted else norm)
        _strips(image.reshape(-1), (views, channels, height, width), settings, strips, kept, found)
    if rooted:
        np.sqrt(found[:, :2], out=found[:, :2])
    found = found.reshape(views, strips, 4)
    return np.stack([found[..., 0].min(1), found[..., 1].max(1), found[..., 2].max(1), found[..., 3].sum(1)], 1)


@compiled(parallel=True, fastmath=False)
def _strips(image, shape, settings, strips, out, found):  # type: ignore[no-untyped-def]
    views, channels, height, width = shape
    for task in prange(views * strips):
        view, strip = task // strips, task % strips
        row = np.empty(width + LANES, np.float32)
        low, high = np.float32(np.inf), _ZERO
        largest, poison = _ZERO, _ZERO
        for i in range(strip * _ROWS, min((strip + 1) * _ROWS, height)):
            _response_row(image, view, shape, i, 0, width, settings, row, 0)
            row_low, row_high = _range(row, width)
            low, high = min(low, row_low), max(high, row_high)
            for channel in range(channels):
                at = ((view * channels + channel) * height + i) * width
                row_largest, row_poison = _magnitude(image, at, width)
                largest = max(largest, row_largest)
                poison += row_poison
            if out.size > 0:
                out[(view * height + i) * width : (view * height + i + 1) * width] = row[:width]
        found[task, 0], found[task, 1], found[task, 2], found[task, 3] = low, high, largest, poison


@inlined
def _folded(index, size):  # type: ignore[no-untyped-def]
    """Reflect an index that is one beyond the edge; a side of one pixel continues itself."""
    if index < 0:
        index = -index
    if index >= size:
        index = 2 * size - 2 - index
    return max(index, 0)


@compiled(fastmath=False)
def _response_row(image, view, shape, row, left, right, settings, out, at):  # type: ignore[no-untyped-def]
    """Write the response of a row's pixels left <= j < right to out[at:]. May write up to LANES - 1 values more."""
    width = shape[3]
    inner_left, inner_right = max(left, 1), min(right, width - 1)
    if inner_right - inner_left < LANES:
        for j in range(left, right):
            out[at + j - left] = _response_at(image, view, shape, row, j, settings)
        return
    if left == 0:
        out[at] = _response_at(image, view, shape, row, 0, settings)
    views, channels, height, width = shape
    kind, side, middle, norm = settings
    if kind == 0 and channels == 3:  # the paper's, of photographs: with constants it takes a third less
        shape, settings = (views, 3, height, width), (0, side, middle, norm)
        _inner_responses(image, view, shape, row, inner_left, inner_right, settings, out, at - left)
    else:
        _inner_responses(image, view, shape, row, inner_left, inner_right, settings, out, at - left)
    if right == width:
        out[at + right - 1 - left] = _response_at(image, view, shape, row, right - 1, settings)


@inlined
def _inner_responses(image, view, shape, row, left, right, settings, out, at):  # type: ignore[no-untyped-def]
    last = right - LANES
    for j in range(left, last, LANES):
        store(out, at + j, _responses(image, view, shape, row, j, settings))
    store(out, at + last, _responses(image, view, shape, row, last, settings))  # it may overlap the one before


@inlined
def _responses(image, view, shape, row, j, settings):  # type: ignore[no-untyped-def]
    # Differences are taken in torch's order, which is exactly zero on a constant image.
    channels, height, width = shape[1], shape[2], shape[3]
    kind, side, middle, norm = settings
    first, second = splat(_ZERO), splat(_ZERO)
    for channel in range(channels):
        plane = (view * channels + channel) * height * width + j
        above = plane + _folded(row - 1, height) * width
        here = plane + row * width
        below = plane + _folded(row + 1, height) * width
        if kind == 2:
            across = splat(middle) * (load(image, here + 1) - load(image, here - 1))
            down = splat(middle) * (load(image, below) - load(image, above))
            if side != _ZERO:
                across = (
                    splat(side)
                    * (
                        (load(image, above + 1) - load(image, above - 1))
                        + (load(image, below + 1) - load(image, below - 1))
                    )
                    + across
                )
                down = (
                    splat(side)
                    * (
                        (load(image, below - 1) - load(image, above - 1))
                        + (load(image, below + 1) - load(image, above + 1))
                    )
                    + down
                )
            first = _accumulated(first, across, norm)
            second = _accumulated(second, down, norm)
        else:
            cross = (load(image, above) + load(image, below)) + (load(image, here - 1) + load(image, here + 1))
            if kind == 1:
                diagonal = (load(image, above - 1) + load(image, below + 1)) + (
                    load(image, above + 1) + load(image, below - 1)
                )
                value = (cross + diagonal) - splat(_EIGHT) * load(image, here)
            else:
                value = cross - splat(_FOUR) * load(image, here)
            first = _accumulated(first, value, norm)
    if norm == 3:
        return maximum(first, second)
    strength = first + second
    return square_root(strength) if norm == 2 else strength


@inlined
def _accumulated(sum, value, norm):  # type: ignore[no-untyped-def]
    if norm == 1:
        sum = sum + absolute(value)
    elif norm == 3:
        sum = maximum(sum, absolute(value))
    else:
        sum = sum + value * value
    return sum


@compiled(fastmath=False)
def _response_at(image, view, shape, row, j, settings):  # type: ignore[no-untyped-def]
    # At the edge of the image: eight copies of the reflected neighbourhood, three rows of it, and the same arithmetic.
    channels, height, width = shape[1], shape[2], shape[3]
    around = np.empty(channels * 3 * (LANES + 2), np.float32)
    for channel in range(channels):
        for i in range(3):
            source = ((view * channels + channel) * height + _folded(row + i - 1, height)) * width
            for k in range(3):
                around[(channel * 3 + i) * (LANES + 2) + k] = image[source + _folded(j + k - 1, width)]
            for k in range(3, LANES + 2):
                around[(channel * 3 + i) * (LANES + 2) + k] = _ZERO
    return lane(_responses(around, 0, (1, channels, 3, LANES + 2), 1, 1, settings), 0)


@compiled(fastmath=False)
def _range(row, count):  # type: ignore[no-untyped-def]
    low, high = np.float32(np.inf), _ZERO
    if count >= LANES:
        lows, highs = load(row, 0), load(row, 0)
        for j in range(LANES, count - LANES, LANES):
            lows, highs = minimum(lows, load(row, j)), maximum(highs, load(row, j))
        lows, highs = minimum(lows, load(row, count - LANES)), maximum(highs, load(row, count - LANES))
        for k in range(LANES):
            low, high = min(low, lane(lows, k)), max(high, lane(highs, k))
    else:
        for j in range(count):
            low, high = min(low, row[j]), max(high, row[j])
    return low, high


@compiled(fastmath=False)
def _magnitude(image, at, count):  # type: ignore[no-untyped-def]
    largest, poison = _ZERO, _ZERO
    whole = count - count % LANES
    largests, poisons, nothing = splat(_ZERO), splat(_ZERO), splat(_ZERO)
    for j in range(at, at + whole, LANES):
        values = load(image, j)
        largests = maximum(largests, absolute(values))
        poisons = multiply_add(values, nothing, poisons)
    for k in range(LANES):
        largest = max(largest, lane(largests, k))
        poison += lane(poisons, k)
    for j in range(at + whole, at + count):
        largest = max(largest, abs(image[j]))
        poison += image[j] * _ZERO
    return largest, poison


@compiled(fastmath=False)
def weight_row(image, view, shape, row, left, right, settings, curve, low, span, beta, out, at):  # type: ignore[no-untyped-def]
    """Write the weights of a row's pixels left <= j < right to out[at:], rounded up to whole vectors."""
    _response_row(image, view, shape, row, left, right, settings, out, at)
    lows, scale, betas, one = splat(low), splat(_ONE / span), splat(beta), splat(_ONE)
    for j in range(at, at + right - left, LANES):
        x = (load(out, j) - lows) * scale
        if curve == 2:
            x = x * x
        elif curve == 3:
            x = square_root(x)
        elif curve == 4:
            x = x * x * (splat(_THREE) - splat(_TWO) * x)
        store(out, j, one + betas * x)
