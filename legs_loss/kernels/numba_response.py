"""The response of a photograph and its weights, row by row, on the CPU: as torch computes it, but for the last bit.

The weight map of a view need not exist in memory: two numbers do, the least and the greatest response of the view. With
them :func:`weight_row` makes the weights where they are used, from pixels that are in the cache already.
"""

from __future__ import annotations

from typing import Dict, NamedTuple, Tuple

import numpy as np

from legs_loss.kernels.compiling import compiled, inlined
from legs_loss.kernels.simd import (
    LANES,
    absolute,
    lane,
    load,
    maximum,
    splat,
    square_root,
    store,
)
from legs_loss.spec import WeightSpec

__all__ = [
    "CURVES",
    "NORMS",
    "STENCILS",
    "Operator",
    "Piece",
    "Shape",
    "Weighting",
    "folded",
    "operator_of",
    "response_row",
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
# C5 needs a sine; it and curves of the user's own are applied by torch, to a map.
CURVES = {"C1": 1, "C2": 2, "C3": 3, "C4": 4}

_ZERO, _ONE, _TWO, _THREE = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(3.0)
_FOUR, _EIGHT = np.float32(4.0), np.float32(8.0)


class Shape(NamedTuple):
    """The shape of contiguous images, [views, channels, height, width]."""

    views: int
    channels: int
    height: int
    width: int


class Piece(NamedTuple):
    """The pixels left <= j < right of a row of a view."""

    view_index: int  # numba takes `view` for numpy's method
    row: int
    left: int
    right: int


class Operator(NamedTuple):
    """The operator of a response and its norm.

    stencil: 0 the Laplacian of four neighbours, 1 of eight, 2 a gradient.
    side, middle: the weights of a gradient's outer rows and of its middle one.
    norm: over the channels, as in NORMS; 4 is the square of the norm 2.
    """

    stencil: int
    side: np.float32
    middle: np.float32
    norm: int


class Weighting(NamedTuple):
    """The settings and the range that make a weight of a response.

    curve: as in CURVES.
    beta: of the spec.
    low, span: the view's least response, and its greatest less the least plus eps.
    """

    curve: int
    beta: np.float32
    low: np.float32
    span: np.float32


def supports_response(spec: WeightSpec) -> bool:
    """Return whether the response of a spec can be computed here; the functions below take no other."""
    return spec.operator in STENCILS and spec.p in NORMS


def operator_of(spec: WeightSpec) -> Operator:
    """Return a spec's operator and norm as the functions here take them."""
    stencil, side, middle = STENCILS[spec.operator]
    return Operator(stencil, np.float32(side), np.float32(middle), NORMS[spec.p])


@inlined
def folded(index, size):  # type: ignore[no-untyped-def]
    """Reflect an index that is one beyond the edge; a side of one pixel continues itself."""
    if index < 0:
        index = -index
    if index >= size:
        index = 2 * size - 2 - index
    return max(index, 0)


@compiled(fastmath=False)
def response_row(image, shape, piece, operator, out, at):  # type: ignore[no-untyped-def]
    """Write the response of a piece of a row to out[at:]. May write up to LANES - 1 values more."""
    left, right, width = piece.left, piece.right, shape.width
    inner = Piece(piece.view_index, piece.row, max(left, 1), min(right, width - 1))
    if inner.right - inner.left < LANES:
        for j in range(left, right):
            out[at + j - left] = _response_at(image, shape, piece, j, operator)
        return
    if left == 0:
        out[at] = _response_at(image, shape, piece, 0, operator)
    if (
        operator.stencil == 0 and shape.channels == 3
    ):  # the paper's, of photographs: with constants it takes a third less
        three = Shape(shape.views, 3, shape.height, width)
        laplacian = Operator(0, operator.side, operator.middle, operator.norm)
        _inner_responses(image, three, inner, laplacian, out, at - left)
    else:
        _inner_responses(image, shape, inner, operator, out, at - left)
    if right == width:
        out[at + right - 1 - left] = _response_at(image, shape, piece, right - 1, operator)


@inlined
def _inner_responses(image, shape, piece, operator, out, at):  # type: ignore[no-untyped-def]
    last = piece.right - LANES
    for j in range(piece.left, last, LANES):
        store(out, at + j, _responses(image, shape, piece, j, operator))
    store(out, at + last, _responses(image, shape, piece, last, operator))  # it may overlap the one before


@inlined
def _responses(image, shape, piece, j, operator):  # type: ignore[no-untyped-def]
    # Differences are taken in torch's order, which is exactly zero on a constant image.
    channels, height, width = shape.channels, shape.height, shape.width
    view, row, kind, norm = piece.view_index, piece.row, operator.stencil, operator.norm
    side, middle = operator.side, operator.middle
    first, second = splat(_ZERO), splat(_ZERO)
    for channel in range(channels):
        plane = (view * channels + channel) * height * width + j
        above = plane + folded(row - 1, height) * width
        here = plane + row * width
        below = plane + folded(row + 1, height) * width
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
def _response_at(image, shape, piece, j, operator):  # type: ignore[no-untyped-def]
    # At the edge of the image: eight copies of the reflected neighbourhood, three rows of it, and the same arithmetic.
    channels, height, width = shape.channels, shape.height, shape.width
    around = np.empty(channels * 3 * (LANES + 2), np.float32)
    for channel in range(channels):
        for i in range(3):
            source = ((piece.view_index * channels + channel) * height + folded(piece.row + i - 1, height)) * width
            for k in range(3):
                around[(channel * 3 + i) * (LANES + 2) + k] = image[source + folded(j + k - 1, width)]
            for k in range(3, LANES + 2):
                around[(channel * 3 + i) * (LANES + 2) + k] = _ZERO
    return lane(_responses(around, Shape(1, channels, 3, LANES + 2), Piece(0, 1, 1, 2), 1, operator), 0)


@compiled(fastmath=False)
def weight_row(image, shape, piece, operator, weighting, out, at):  # type: ignore[no-untyped-def]
    """Write the weights of a piece of a row to out[at:], rounded up to whole vectors.

    Args:
        image: float32 [views * channels * height * width].
        shape: a Shape.
        piece: a Piece.
        operator: an Operator.
        weighting: a Weighting.
        out: float32, with room for LANES - 1 values beyond the piece.
        at: where in it the piece begins.
    """
    response_row(image, shape, piece, operator, out, at)
    curve, one = weighting.curve, splat(_ONE)
    lows, scale, betas = splat(weighting.low), splat(_ONE / weighting.span), splat(weighting.beta)
    for j in range(at, at + piece.right - piece.left, LANES):
        x = (load(out, j) - lows) * scale
        if curve == 2:
            x = x * x
        elif curve == 3:
            x = square_root(x)
        elif curve == 4:
            x = x * x * (splat(_THREE) - splat(_TWO) * x)
        store(out, j, one + betas * x)
