"""The rasterizer's blending of one strip: with the vectors of lab/simd, and as plain loops for LLVM's vectoriser.

    python -m benchmarks.vectors

The plain loops are the same formulas on the same state, pixel by pixel; the sums of the backward pass are taken by
column. Both take turns; a line a pass: microseconds of the processor, medians, and their ratio.
"""

from __future__ import annotations

import time

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from legs_loss.kernels.compiling import compiled, multiply_add
from legs_loss.lab.rasterizer import strips
from legs_loss.lab.rasterizer.projection import WIDE
from legs_loss.lab.rasterizer.strips import BLUE, GREEN, PIXELS, RED, REST, STATE, T, X, _blend, _blend_backward

SPLATS, TURNS, CALLS = 200, 25, 200
SUMS = STATE  # behind the state: six sums a column
NONE, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)
MOST, LEAST, LAST = strips._MAX, strips._MIN, strips._LAST
P0, P1, P2, P3, P4, P5 = (getattr(strips, f"_P{k}") for k in range(6))
UNDERFLOW, ROUNDING = strips._UNDERFLOW, strips._ROUNDING


@intrinsic
def _bits(typingctx, a):
    return types.int32(types.float32), lambda context, builder, sig, args: builder.bitcast(args[0], ir.IntType(32))


@intrinsic
def _float(typingctx, a):
    return types.float32(types.int32), lambda context, builder, sig, args: builder.bitcast(args[0], ir.FloatType())


@numba.njit(inline="always")
def _exp2(x):
    x = max(x, UNDERFLOW)
    rounded = x + ROUNDING
    f = x - (rounded - ROUNDING)
    value = multiply_add(multiply_add(multiply_add(P5, f, P4), f, P3), f, P2)
    value = multiply_add(multiply_add(value, f, P1), f, P0)
    return _float(_bits(value) + (_bits(rounded) << np.int32(23)))


@numba.njit(inline="always")
def _rows(rows):
    first, last = np.uint32(rows) & 63, np.uint32(rows >> 8) & 63
    return np.int64(first), np.int64(last), (np.float32(first) - np.float32(last) + ONE) * HALF


@numba.njit(inline="always")
def _respond(entries, k, x, y):
    across = multiply_add(entries[k, 5], x, entries[k, 4])
    w = multiply_add(entries[k, 3], y, multiply_add(entries[k, 2], x, entries[k, 1]))
    return _exp2(multiply_add(-w, w, multiply_add(-across, across, entries[k, 0]))), w


@numba.njit(inline="always")
def _cover(state, i, response):
    alpha = min(response, MOST)
    alpha = alpha if alpha >= LEAST else NONE
    before = state[T + i]
    weight = alpha * before
    after = before - weight
    drawn = after >= LAST
    state[T + i] = after if drawn else NONE - abs(before)
    return weight if drawn else NONE, alpha, before


@compiled()
def blend(state, begin, end, draws, entries):
    for k in range(begin, end):
        first, last, y = _rows(draws[k, 1])
        for row in range(first, last):
            for x in range(WIDE):
                i = row * WIDE + x
                response, _ = _respond(entries, k, state[X + x], y)
                weight, _, _ = _cover(state, i, response)
                state[RED + i] = multiply_add(weight, entries[k, 6], state[RED + i])
                state[GREEN + i] = multiply_add(weight, entries[k, 7], state[GREEN + i])
                state[BLUE + i] = multiply_add(weight, entries[k, 8], state[BLUE + i])
            y += ONE


@compiled()
def blend_backward(state, begin, end, draws, entries, moments, sums):
    for k in range(begin, end):
        first, last, y = _rows(draws[k, 1])
        for x in range(6 * WIDE):
            state[SUMS + x] = NONE
        for row in range(first, last):
            for x in range(WIDE):
                i = row * WIDE + x
                response, w = _respond(entries, k, state[X + x], y)
                weight, alpha, before = _cover(state, i, response)
                red, green, blue = state[RED + i], state[GREEN + i], state[BLUE + i]
                own = multiply_add(red, entries[k, 6], multiply_add(green, entries[k, 7], blue * entries[k, 8]))
                rest = multiply_add(NONE - weight, own, state[REST + i])
                state[REST + i] = rest
                h = response * multiply_add(before, own, NONE - rest / (ONE - alpha))
                h = h if weight > NONE else NONE
                state[SUMS + x] += h
                state[SUMS + WIDE + x] += h * w
                state[SUMS + 2 * WIDE + x] = multiply_add(h * w, w, state[SUMS + 2 * WIDE + x])
                state[SUMS + 3 * WIDE + x] = multiply_add(weight, red, state[SUMS + 3 * WIDE + x])
                state[SUMS + 4 * WIDE + x] = multiply_add(weight, green, state[SUMS + 4 * WIDE + x])
                state[SUMS + 5 * WIDE + x] = multiply_add(weight, blue, state[SUMS + 5 * WIDE + x])
            y += ONE
        at = np.uint64(draws[k, 2]) * moments
        for x in range(WIDE):
            across = multiply_add(entries[k, 5], state[X + x], entries[k, 4])
            h, hw = state[SUMS + x], state[SUMS + WIDE + x]
            sums[at] += h
            sums[at + 1] += hw
            sums[at + 2] += across * h
            sums[at + 3] += state[SUMS + 2 * WIDE + x]
            sums[at + 4] += across * hw
            sums[at + 5] += across * across * h
            for channel in range(3):
                sums[at + 6 + channel] += state[SUMS + (3 + channel) * WIDE + x]


@compiled()  # Python has no entry to a part
def vectors(state, begin, end, draws, entries):
    _blend(state, begin, end, draws, entries)


@compiled()
def vectors_backward(state, begin, end, draws, entries, moments, sums):
    _blend_backward(state, begin, end, draws, entries, moments, sums)


def main() -> None:
    """Compare the two, value and time."""
    random = np.random.default_rng(0)
    entries = np.zeros((SPLATS, strips.FIELDS), np.float32)
    entries[:, 0] = np.log2(random.uniform(0.05, 0.5, SPLATS))
    entries[:, 1:6], entries[:, 6:] = random.normal(0, 0.2, (SPLATS, 5)), random.uniform(0, 1, (SPLATS, 3))
    first = random.integers(0, 24, SPLATS)
    last = np.minimum(first + random.integers(2, 14, SPLATS), 32)
    draws = np.stack([np.zeros(SPLATS), first | last << 8, np.arange(SPLATS)], 1).astype(np.int32)
    forward = np.zeros(STATE + 6 * WIDE, np.float32)
    forward[T : T + PIXELS], forward[X : X + WIDE] = 1, np.arange(WIDE) - 3.5
    backward = forward.copy()
    backward[RED : REST + PIXELS] = random.normal(0, 1, 4 * PIXELS)
    span = np.uint64(0), np.uint64(SPLATS), draws, entries
    moments = strips.MOMENTS
    passes = {
        "forward": (forward, (), vectors, blend),
        "backward": (
            backward,
            (moments, np.zeros(SPLATS * moments, np.float32)),
            vectors_backward,
            blend_backward,
        ),
    }
    for name, (state, more, *both) in passes.items():
        results, times = [], ([], [])
        for function in both:  # which compiles them
            copy = state.copy()
            function(copy, *span, *more)
            results.append((more[1].copy() if more else copy[T:REST]).astype(np.float64))
            if more:
                more[1][:] = 0
        assert np.abs(results[0] - results[1]).max() <= 1e-5 * np.abs(results[0]).max()
        for _ in range(TURNS):
            for function, taken in zip(both, times):
                begun = time.process_time()
                for _ in range(CALLS):
                    function(state.copy(), *span, *more)
                taken.append((time.process_time() - begun) / CALLS * 1e6)
        ours, plain = (float(np.median(taken)) for taken in times)
        print(f"{name}: vectors {ours:.0f} us, plain loops {plain:.0f} us, ratio {plain / ours:.1f}", flush=True)


if __name__ == "__main__":
    main()
