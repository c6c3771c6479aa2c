"""Pillow's default resampling of a colour photograph, on the CPU: the same pixels, in a quarter of the time.

A map must be of exactly the image that the training makes with Pillow, so this repeats Pillow's arithmetic:
cubic weights in units of 2^-22, a pass along the rows and then one along the columns, each rounded to 8 bits. (Source
of the formulas: src/libImaging/Resample.c of Pillow.) Other builds of Pillow round differently, and since version 13
images of some shapes are reduced along the columns first; so :func:`resized_as` compares once before it is used.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, Callable, Dict, Iterator, NamedTuple, Tuple

import numpy as np

from legs_loss.kernels.compiling import compiled, inlined
from legs_loss.kernels.simd import (
    LANES,
    halves_added,
    load,
    load_bytes,
    maximum,
    minimum,
    splat,
    store_bytes,
    without_fourths,
)

__all__ = ["resized", "resized_as"]

_BYTES = 4  # of a pixel, as Pillow hands out RGB in whole words
_STRIP = 32  # rows that are copied out of Pillow at a time
_BITS = np.int32(22)  # of a weight's fraction
_HALF = np.int32(1 << 21)
_ZERO, _MOST = np.int32(0), np.int32(255)

_same: Dict[Any, bool] = {}  # by the sizes of an image before and after


def resized_as(pillow: Callable[[Any, Tuple[int, int]], np.ndarray], image: Any, size: Tuple[int, int]) -> np.ndarray:
    """Return ``pillow(image, size)``, from :func:`resized` once that gave the same for an image of these sizes.

    Args:
        pillow: resizes a Pillow image to uint8 [H, W, 3].
        image, size: as for :func:`resized`.
    """
    sizes = image.size, size
    if sizes not in _same:
        expected = pillow(image, size)
        if np.ptp(expected) > 0:  # one colour comes out the same by any arithmetic
            _same[sizes] = np.array_equal(resized(image, size), expected)
        return expected
    return resized(image, size) if _same[sizes] else pillow(image, size)


def resized(image: Any, size: Tuple[int, int]) -> np.ndarray:
    """Return ``image.resize(size)`` as uint8 [H, W, 3].

    Args:
        image: a Pillow image of mode RGB.
        size: width and height in pixels; at least 8 wide, and at most the image's.
    """
    (width, height), (columns, rows) = image.size, size
    across, down = _taps(width, columns), _taps(height, rows)
    weights, first = _in_pairs(across, width)
    narrow = np.empty((height, 3 * columns + LANES), np.uint8)
    for top, pixels in _strips(image):
        _across(pixels, width * _BYTES, weights.reshape(-1), first, narrow[top:].reshape(-1), narrow.shape[1])
    out = np.empty((rows, columns, 3), np.uint8)
    _down(narrow.reshape(-1), narrow.shape[1], *down, out.reshape(-1))
    return out


def _strips(image: Any) -> Iterator[Tuple[int, np.ndarray]]:
    """Yield the pixels of an RGB image in strips from the top: a strip's first row, and uint8 [rows * width * 4]."""
    for top in range(0, image.height, _STRIP):
        strip = image.crop((0, top, image.width, min(top + _STRIP, image.height)))
        yield top, np.frombuffer(strip.tobytes("raw", "RGBX"), np.uint8)


class _Taps(NamedTuple):
    """Of each pixel of a shorter side: the first pixel it is made of, how many there are, and their weights."""

    first: np.ndarray
    counts: np.ndarray
    weights: np.ndarray  # int32 [pixels, the most there are]


@lru_cache(maxsize=8)
def _taps(length: int, shorter: int) -> _Taps:
    scale = length / shorter
    support = 2.0 * scale  # of the cubic
    centre = (np.arange(shorter) + 0.5) * scale
    first = np.maximum((centre - support + 0.5).astype(np.int64), 0)
    last = np.minimum((centre + support + 0.5).astype(np.int64), length)
    index = np.arange(2 * math.ceil(support) + 1)
    values = np.where(
        index < (last - first)[:, None],
        _cubic(np.abs(index + first[:, None] - centre[:, None] + 0.5) * (1.0 / scale)),
        0.0,
    )
    # Pillow adds them up one after the other, and the last bit may depend on it.
    values /= np.cumsum(values, 1)[:, -1:]
    weights = np.trunc(values * (1 << 22) + np.copysign(0.5, values)).astype(np.int32)
    return _Taps(first, last - first, weights)


def _cubic(x: np.ndarray) -> np.ndarray:
    a = -0.5
    near = ((a + 2.0) * x - (a + 3.0)) * x * x + 1.0
    far = (((x - 5.0) * x + 8.0) * x - 4.0) * a
    return np.where(x < 1.0, near, np.where(x < 2.0, far, 0.0))


def _in_pairs(taps: _Taps, length: int) -> Tuple[np.ndarray, np.ndarray]:
    """Weights [pixels, pairs * 8], each as often as a pixel has bytes, and where each pixel's first pair begins.

    The number of pixels is made even. A window that its last pair would carry over the edge begins sooner, with weights
    of zero in front.
    """
    pixels, pairs = len(taps.first), -(-int(taps.counts.max()) // 2)
    first = np.minimum(taps.first, length - 2 * pairs)
    weights = np.zeros((pixels + pixels % 2, 2 * pairs), np.int32)
    pixel, tap = np.nonzero(np.arange(taps.weights.shape[1]) < taps.counts[:, None])
    weights[pixel, tap + (taps.first - first)[pixel]] = taps.weights[pixel, tap]
    return np.repeat(weights, _BYTES, 1), np.pad(first, (0, pixels % 2), "edge")


@compiled(fastmath=False)
def _across(pixels, stride, weights, first, out, apart):  # type: ignore[no-untyped-def]
    """Make rows of pixels narrower, the results `apart` from one another. Two pixels of two rows share a loop."""
    columns, rows = first.size, pixels.size // stride
    reach = weights.size // columns
    for i in range(0, rows, 2):
        below = min(i + 1, rows - 1)
        step = (below - i) * stride
        for j in range(0, columns, 2):
            left, right = i * stride + first[j] * _BYTES, i * stride + first[j + 1] * _BYTES
            left0, right0, left1, right1 = splat(_ZERO), splat(_ZERO), splat(_ZERO), splat(_ZERO)
            for k in range(0, reach, LANES):
                weight = load(weights, j * reach + k)
                left0 = left0 + load_bytes(pixels, left + k) * weight
                left1 = left1 + load_bytes(pixels, left + step + k) * weight
                weight = load(weights, (j + 1) * reach + k)
                right0 = right0 + load_bytes(pixels, right + k) * weight
                right1 = right1 + load_bytes(pixels, right + step + k) * weight
            # Six bytes that count; the next pixels overwrite the others.
            store_bytes(out, i * apart + 3 * j, without_fourths(_rounded(halves_added(left0, right0))))
            store_bytes(out, below * apart + 3 * j, without_fourths(_rounded(halves_added(left1, right1))))


@compiled(fastmath=False)
def _down(image, apart, first, count, weights, out):  # type: ignore[no-untyped-def]
    """Make fewer rows of those that lie `apart` in an image."""
    breadth = out.size // first.size
    for i in range(first.size):
        for start in range(0, breadth, 2 * LANES):
            j = min(start, breadth - 2 * LANES)
            at = first[i] * apart + j
            left, right = splat(_ZERO), splat(_ZERO)
            for k in range(count[i]):
                weight = splat(weights[i, k])
                left = left + load_bytes(image, at + k * apart) * weight
                right = right + load_bytes(image, at + k * apart + LANES) * weight
            store_bytes(out, i * breadth + j, _rounded(left))
            store_bytes(out, i * breadth + j + LANES, _rounded(right))


@inlined
def _rounded(sums):  # type: ignore[no-untyped-def]
    whole = (sums + splat(_HALF)) >> splat(_BITS)
    return minimum(maximum(whole, splat(_ZERO)), splat(_MOST))
