"""The response of a photograph, row by row, on the CPU: as torch computes it, but for the last bit.

The loops are plain and short, a channel at a time, so that LLVM makes vectors of them.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from legs_loss.kernels.codes import EIGHT, GRADIENT, NORMS, STENCILS
from legs_loss.kernels.compiling import claimed, compiled, in_threads, inlined, part
from legs_loss.spec import WeightSpec

_ROWS = 32  # of a task
NO_FLOATS = np.empty(0, np.float32)
_ZERO, _ONE, _FOUR, _EIGHT = np.float32(0.0), np.float32(1.0), np.float32(4.0), np.float32(8.0)


class Images(NamedTuple):
    """A prediction and its target, the photograph.

    x, y: float32 [views * channels * height * width], in this order.
    """

    x: np.ndarray
    y: np.ndarray
    views: int
    channels: int
    height: int
    width: int


class OperatorCode(NamedTuple):
    """The operator of a response and its norm.

    stencil, side, middle: as in STENCILS of codes.py: a kind, the weights of a gradient's outer rows and of its middle.
    norm: over the channels, as in NORMS there.
    """

    stencil: int
    side: np.float32
    middle: np.float32
    norm: int


def operator_of(spec: WeightSpec) -> OperatorCode:
    """Return a spec's operator and norm as the functions here take them."""
    stencil, side, middle = STENCILS[spec.operator]
    return OperatorCode(stencil, np.float32(side), np.float32(middle), NORMS[spec.p])


def extremes(image: np.ndarray, operator: OperatorCode, responses: np.ndarray = NO_FLOATS) -> np.ndarray:
    """Return the extremes of each view of float32 [B, C, H, W], as float32 [B, 3].

    The least and the greatest response; 0, or more (or NaN) where values exceed 1 in magnitude or are not finite.
    The responses themselves are written to `responses`, float32 [B * C * H * W], if it has a size: to the first
    channel of each view.
    """
    views, channels, height, width = image.shape
    strips = -(-height // _ROWS)
    found = np.empty((views * strips, 3), np.float32)
    images = Images(image.reshape(-1), image.reshape(-1), views, channels, height, width)
    own = partial(np.empty, (4, width), np.float32)
    in_threads(_strips, views * strips, images, operator, strips, responses, found, own=own)
    out, found = np.empty((views, 3), np.float32), found.reshape(views, strips, 3)
    for number, join in enumerate((np.minimum, np.maximum, np.add)):
        join.reduce(found[:, :, number], 1, out=out[:, number])
    return out


@compiled(fastmath=False)
def _strips(own, low, high, excess, counter, tasks, images, operator, strips, responses, found):  # type: ignore[no-untyped-def]
    height, width = images.height, images.width
    task = claimed(counter)
    while task < tasks:
        view, strip = task // strips, task % strips
        low[:], high[:], excess[:] = np.float32(np.inf), _ZERO, _ZERO
        for i in range(strip * _ROWS, min((strip + 1) * _ROWS, height)):
            row = responses[(view * images.channels * height + i) * width :][:width] if responses.size > 0 else own
            response_row(images, operator, view, i, np.int64(0), width, row)
            _join_extremes(row, low, high)
            for channel in range(images.channels):
                at = ((view * images.channels + channel) * height + i) * width
                _add_excess(images.y[at : at + width], excess)
        found[task, 0], found[task, 1], found[task, 2] = np.float32(np.inf), _ZERO, _ZERO
        for j in range(width):
            found[task, 0], found[task, 1] = min(found[task, 0], low[j]), max(found[task, 1], high[j])
            found[task, 2] += excess[j]
        task = claimed(counter)


@part(fastmath=False)
def _join_extremes(row, low, high):  # type: ignore[no-untyped-def]
    for j in range(row.size):
        low[j] = min(low[j], row[j])
        high[j] = max(high[j], row[j])


@part(fastmath=False)
def _add_excess(row, excess):  # type: ignore[no-untyped-def]
    for j in range(row.size):
        excess[j] += abs(row[j]) - min(abs(row[j]), _ONE)


@inlined
def _folded(index, size):  # type: ignore[no-untyped-def]
    """Reflect an index that is one beyond the edge; a side of one pixel continues itself."""
    return max(min(abs(index), 2 * size - 2 - abs(index)), 0)


@part(fastmath=False)
def response_row(images, operator, view, row, left, right, out):  # type: ignore[no-untyped-def]
    """Write the response of the pixels left <= j < right of a row of a photograph to out."""
    image, channels, height, width = images.y, images.channels, images.height, images.width
    out[: right - left] = _ZERO
    first, last = max(left, 1), min(right, width - 1)
    for channel in range(channels):
        plane = (view * channels + channel) * height * width
        above = image[plane + _folded(row - 1, height) * width :][:width]
        here = image[plane + row * width :][:width]
        below = image[plane + _folded(row + 1, height) * width :][:width]
        _join_inner(
            above[first - 1 :], here[first - 1 :], below[first - 1 :], last - first, operator, out[first - left :]
        )
        for j in range(0, width, max(1, width - 1)):  # the first and the last, whose neighbours are one
            if left <= j < right:
                beside, at = _folded(j + 1, width), j - left
                out[at] = _joined(out[at], above, here, below, beside, j, beside, operator)
    if operator.norm == 2:
        for j in range(right - left):
            out[j] = np.sqrt(out[j])


@part(fastmath=False)
def _join_inner(above, here, below, count, operator, out):  # type: ignore[no-untyped-def]
    for j in range(count):
        out[j] = _joined(out[j], above, here, below, j, j + 1, j + 2, operator)


@part(fastmath=False, forceinline=True)  # lowered once for both callers; their loops stay plain
def _joined(sum, above, here, below, west, j, east, operator):  # type: ignore[no-untyped-def]
    # Differences are taken in torch's order, which is exactly zero on a constant image.
    if operator.stencil == GRADIENT:
        across = operator.middle * (here[east] - here[west])
        down = operator.middle * (below[j] - above[j])
        if operator.side != _ZERO:
            across += operator.side * ((above[east] - above[west]) + (below[east] - below[west]))
            down += operator.side * ((below[west] - above[west]) + (below[east] - above[east]))
        sum = _accumulated(sum, across, operator.norm)
        value = down
    else:
        cross = (above[j] + below[j]) + (here[west] + here[east])
        if operator.stencil == EIGHT:
            diagonal = (above[west] + below[east]) + (above[east] + below[west])
            value = (cross + diagonal) - _EIGHT * here[j]
        else:
            value = cross - _FOUR * here[j]
    return _accumulated(sum, value, operator.norm)


@inlined
def _accumulated(sum, value, norm):  # type: ignore[no-untyped-def]
    if norm == 1:
        sum = sum + abs(value)
    elif norm == 3:
        sum = max(sum, abs(value))
    else:
        sum = sum + value * value
    return sum
