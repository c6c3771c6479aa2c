"""Sum what each Gaussian contributed to a rendering: forks score, prune and densify by it."""

# mypy: ignore-errors
# (numba infers the types)

from __future__ import annotations

from typing import Any

import numpy as np

from legs_loss.kernels.compiling import claimed, compiled, in_threads, inlined
from legs_loss.lab.conventions import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from legs_loss.lab.rasterizer.projection import WIDE
from legs_loss.lab.rasterizer.sorting import OWNER
from legs_loss.lab.rasterizer.strips import PIXELS, STATE, WORK, T, X, place, reach, respond

COUNT, WEIGHT, VALUE, DISTANCE, MOST, SLOPES, FIELDS = 0, 1, 2, 3, 4, 5, 6
_MAX, _MIN, _LAST, _ONE = np.float32(MAX_ALPHA), np.float32(MIN_ALPHA), np.float32(MIN_TRANSMITTANCE), np.float32(1)


@inlined
def _strip(strip, across, begin, end, splats, draws, entries, values, image, g_image, sums):
    """Fill the sums of one strip's entries, [entries, FIELDS]."""
    before, finished = np.ones(PIXELS, np.float32), np.zeros(PIXELS, np.bool_)
    largest, whose = np.zeros(PIXELS, np.float32), np.full(PIXELS, -1, np.int64)
    rest, g = np.zeros(PIXELS, np.float32), np.zeros((PIXELS, 3), np.float32)
    state = np.empty(STATE, np.float32)
    left, top, wide, tall = place(strip, across, image, state[X:], state[T : T + PIXELS])
    for row in range(tall):
        for column in range(wide):
            for channel in range(3):
                i, gradient = row * WIDE + column, g_image[channel, top + row, left + column]
                g[i, channel] = gradient
                rest[i] += gradient * image[channel, top + row, left + column]
    for k in range(begin, end):
        first, last, top_row = reach(draws, k)
        respond(state, first, last, top_row, entries, k)
        u, v = splats[draws[k, OWNER], 0] - left, splats[draws[k, OWNER], 1] - top
        count = weight = value = distance = slopes = 0.0
        for row in range(first, min(last, tall)):
            for column in range(wide):
                i = row * WIDE + column
                alpha = min(state[WORK + i], _MAX)
                if finished[i] or alpha < _MIN:
                    continue
                drawn = alpha * before[i]
                after = before[i] - drawn
                if after < _LAST:
                    finished[i] = True
                    continue
                if drawn > largest[i]:
                    largest[i], whose[i] = drawn, k
                own = g[i, 0] * entries[k, 6] + g[i, 1] * entries[k, 7] + g[i, 2] * entries[k, 8]
                rest[i] -= drawn * own
                slope = before[i] * own - rest[i] / (_ONE - alpha)
                before[i] = after
                count += 1
                weight += drawn
                value += values[top + row, left + column]
                distance += np.sqrt((u - column) ** 2 + (v - row) ** 2)
                slopes += slope * slope
        sums[k, COUNT], sums[k, WEIGHT], sums[k, VALUE] = count, weight, value
        sums[k, DISTANCE], sums[k, MOST], sums[k, SLOPES] = distance, 0, slopes
    for k in whose:
        if k >= 0:
            sums[k, MOST] += 1


@compiled(_nrt=True)
def _strips(counter, strips, across, ranges, ends, splats, draws, entries, values, image, g_image, sums):
    strip = claimed(counter)
    while strip < strips:
        _strip(strip, across, ranges[strip], ends[strip], splats, draws, entries, values, image, g_image, sums)
        strip = claimed(counter)


def contribute(
    across: int,
    ranges: np.ndarray,
    ends: np.ndarray,
    splats: Any,
    draws: np.ndarray,
    entries: np.ndarray,
    values: np.ndarray,
    image: np.ndarray,
    g_image: np.ndarray,
) -> np.ndarray:
    """Return sums [N, FIELDS], over the pixels that each Gaussian is blended into.

    COUNT: how many; WEIGHT: of transmittance times alpha; VALUE: of ``values`` [H, W] there; DISTANCE: from its centre,
    in pixels; MOST: how many in which no other weighs more; SLOPES: of the squared derivative by the Gaussian's alpha
    there, ``g_image`` being the image's.
    """
    parts = np.zeros((len(entries), FIELDS))
    in_threads(_strips, len(ends), across, ranges, ends, splats, draws, entries, values, image, g_image, parts)
    owners = draws[: len(entries), OWNER]
    return np.stack([np.bincount(owners, part, len(splats)) for part in parts.T], 1)
