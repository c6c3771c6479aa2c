"""Passes over whole images: the response of every pixel, and the extremes for a view's weights."""

from __future__ import annotations

from typing import Optional, Tuple

import numpy as np
from numba import prange

from legs_loss.kernels.compiling import ONE_AT_A_TIME, compiled
from legs_loss.kernels.numba_response import NORMS, Piece, Shape, folded, operator_of, response_row
from legs_loss.kernels.simd import LANES, absolute, lane, load, maximum, minimum, multiply_add, splat
from legs_loss.spec import WeightSpec

__all__ = ["extremes", "map_of_responses", "photograph_response"]

_ROWS = 32  # of a task
_SQUARED = 4  # the norm of an Operator that is the square of the norm 2
_ZERO = np.float32(0.0)


def map_of_responses(image: np.ndarray, spec: WeightSpec) -> Tuple[np.ndarray, np.ndarray]:
    """Return the response of images float32 [B, C, H, W] as float32 [B, H, W], and :func:`extremes` of it."""
    views, _, height, width = image.shape
    out = np.empty((views, height, width), np.float32)
    return out, _reduced(image, spec, out)


def extremes(image: np.ndarray, spec: WeightSpec) -> np.ndarray:
    """Return the extremes of each view of float32 [B, C, H, W], as float32 [B, 4].

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
    _photograph(np.ascontiguousarray(image), full, operator_of(spec), planes, out.reshape(-1))
    return out


@compiled(fastmath=False)
def _photograph(image, full, operator, planes, out):  # type: ignore[no-untyped-def]
    height, width, channels = image.shape
    rows = planes.shape[1] - 2
    shape = Shape(1, channels, rows + 2, width)
    row = np.empty(width + LANES, np.float32)
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        for i in range(top - 1, bottom + 1):
            _row_in_planes(image[folded(i, height)].reshape(-1), full, planes, i - top + 1)
        for i in range(top, bottom):
            response_row(planes.reshape(-1), shape, Piece(0, i - top + 1, 0, width), operator, row, 0)
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
        operator = operator_of(spec)
        # The root of the greatest square is the greatest root: one a view is enough.
        rooted = out is None and operator.norm == NORMS[2.0]
        if rooted:
            operator = operator._replace(norm=_SQUARED)
        _strips(image.reshape(-1), Shape(views, channels, height, width), operator, strips, kept, found)
    if rooted:
        np.sqrt(found[:, :2], out=found[:, :2])
    found = found.reshape(views, strips, 4)
    return np.stack([found[..., 0].min(1), found[..., 1].max(1), found[..., 2].max(1), found[..., 3].sum(1)], 1)


@compiled(parallel=True, fastmath=False)
def _strips(image, shape, operator, strips, out, found):  # type: ignore[no-untyped-def]
    channels, height, width = shape.channels, shape.height, shape.width
    for task in prange(shape.views * strips):
        view, strip = task // strips, task % strips
        row = np.empty(width + LANES, np.float32)
        low, high = np.float32(np.inf), _ZERO
        largest, poison = _ZERO, _ZERO
        for i in range(strip * _ROWS, min((strip + 1) * _ROWS, height)):
            response_row(image, shape, Piece(view, i, 0, width), operator, row, 0)
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
