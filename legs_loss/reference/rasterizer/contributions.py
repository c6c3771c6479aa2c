"""Sum what each Gaussian contributed to a rendering: forks score, prune and densify by it."""

# mypy: ignore-errors
# (numba infers the types)

from __future__ import annotations

import numpy as np
from numba import prange

from legs_loss.kernels.compiling import compiled
from legs_loss.reference.conventions import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from legs_loss.reference.rasterizer.projection import TALL, WIDE
from legs_loss.reference.rasterizer.sorting import OWNER
from legs_loss.reference.rasterizer.strips import PIXELS, STATE, WORK, T, X, place, reach, respond

__all__ = ["COUNT", "DISTANCE", "FIELDS", "MOST", "VALUE", "WEIGHT", "contribute", "sensitivity"]

COUNT, WEIGHT, VALUE, DISTANCE, MOST, FIELDS = 0, 1, 2, 3, 4, 5
_MAX, _MIN, _LAST = np.float32(MAX_ALPHA), np.float32(MIN_ALPHA), np.float32(MIN_TRANSMITTANCE)
_ZERO, _ONE = np.float32(0), np.float32(1)


@compiled()
def _strip(left, top, wide, tall, begin, end, splats, draws, entries, values, sums):
    """Fill the sums of one strip's entries, [entries, FIELDS]."""
    before, finished = np.ones(PIXELS, np.float32), np.zeros(PIXELS, np.bool_)
    largest, whose = np.zeros(PIXELS, np.float32), np.full(PIXELS, -1, np.int64)
    state = np.empty(STATE, np.float32)
    place(state[X:], state[T : T + PIXELS], wide, tall)
    for k in range(begin, end):
        first, last, top_row = reach(draws, k)
        respond(state, first, last, top_row, entries, k)
        u, v = splats[draws[k, OWNER], 0] - left, splats[draws[k, OWNER], 1] - top
        count = weight = value = distance = 0.0
        for row in range(first, min(last, tall)):
            for column in range(wide):
                i = row * WIDE + column
                alpha = min(state[WORK + i], _MAX)
                if finished[i] or alpha < _MIN:
                    continue
                after = before[i] - alpha * before[i]
                if after < _LAST:
                    finished[i] = True
                    continue
                drawn = alpha * before[i]
                if drawn > largest[i]:
                    largest[i], whose[i] = drawn, k
                before[i] = after
                count += 1
                weight += drawn
                value += values[top + row, left + column]
                distance += np.sqrt((u - column) ** 2 + (v - row) ** 2)
        sums[k, 0], sums[k, 1], sums[k, 2], sums[k, 3], sums[k, 4] = count, weight, value, distance, 0
    for k in whose:
        if k >= 0:
            sums[k, 4] += 1


@compiled(parallel=True)
def contribute(across, ranges, ends, splats, draws, entries, values, sums):
    """Fill sums [N, FIELDS], over the pixels that each Gaussian is blended into.

    COUNT: how many; WEIGHT: of transmittance times alpha; VALUE: of ``values`` [H, W] there; DISTANCE: from its centre,
    in pixels; MOST: how many in which no other weighs more.
    """
    height, width = values.shape
    parts = np.empty((len(entries), FIELDS))
    for strip in prange(len(ends)):
        left, top = strip % across * WIDE, strip // across * TALL
        wide, tall = min(WIDE, width - left), min(TALL, height - top)
        _strip(left, top, wide, tall, ranges[strip], ends[strip], splats, draws, entries, values, parts)
    sums[:] = 0
    for strip in range(len(ends)):
        for k in range(ranges[strip], ends[strip]):
            for field in range(FIELDS):
                sums[draws[k, OWNER], field] += parts[k, field]


@compiled()
def _sensitive_strip(left, top, wide, tall, begin, end, draws, entries, image, g_image, squares):
    """Sum the squared derivative by its alpha over the pixels of each entry of a strip."""
    before, rest, g = np.ones(PIXELS, np.float32), np.zeros(PIXELS, np.float32), np.zeros((PIXELS, 3), np.float32)
    state = np.empty(STATE, np.float32)
    place(state[X:], state[T : T + PIXELS], wide, tall)
    for row in range(tall):
        for column in range(wide):
            for channel in range(3):
                i, gradient = row * WIDE + column, g_image[channel, top + row, left + column]
                g[i, channel] = gradient
                rest[i] += gradient * image[channel, top + row, left + column]
    for k in range(begin, end):
        first, last, top_row = reach(draws, k)
        respond(state, first, last, top_row, entries, k)
        total = 0.0
        for row in range(first, min(last, tall)):
            for column in range(wide):
                i = row * WIDE + column
                alpha = min(state[WORK + i], _MAX)
                if before[i] < _ZERO or alpha < _MIN:
                    continue
                after = before[i] - alpha * before[i]
                if after < _LAST:
                    before[i] = -before[i]
                    continue
                own = g[i, 0] * entries[k, 6] + g[i, 1] * entries[k, 7] + g[i, 2] * entries[k, 8]
                rest[i] -= alpha * before[i] * own
                slope = before[i] * own - rest[i] / (_ONE - alpha)
                total += slope * slope
                before[i] = after
        squares[k] = total


@compiled(parallel=True)
def sensitivity(across, ranges, ends, splats, draws, entries, image, g_image, sums):
    """Fill sums [N]: over pixels, of the squared derivative by a Gaussian's falloff there, `g_image` being the image's.

    Source: Speedy-Splat (Hanson et al. 2025).
    """
    height, width = image.shape[1], image.shape[2]
    parts = np.zeros(len(entries))
    for strip in prange(len(ends)):
        left, top = strip % across * WIDE, strip // across * TALL
        wide, tall = min(WIDE, width - left), min(TALL, height - top)
        _sensitive_strip(left, top, wide, tall, ranges[strip], ends[strip], draws, entries, image, g_image, parts)
    sums[:] = 0
    for strip in range(len(ends)):
        for k in range(ranges[strip], ends[strip]):
            opacity = np.exp(splats[draws[k, OWNER], 5])
            sums[draws[k, OWNER]] += opacity * opacity * parts[k]
