"""The compiled rasterizer's work for each strip of the image: blending the splats that reach it, both ways.

A strip is 8 pixels wide and 32 tall: a row of it fills one register, and the rows that a splat reaches are one
contiguous loop. (3DGS's own tiles of 16x16 matter to the result only where they cut off a splat; projection.py sees to
that.) All of a strip's state is one array, a plane of 256 numbers each.

Within a strip a splat is

    log2(alpha) = e - (w1 + p x + q y)^2 - (w2 + r x)^2         x, y in pixels from `origin`

in its own coordinates (geometry.py), of which the second is the same in all rows. They are computed in float64 and at
most 4 or so where the splat is seen: so alpha, and the moments by these coordinates, are as precise for a needle a
thousand pixels long as for a dot.

Indices are unsigned where it counts: of any other, Python's rules for negative ones are looked after at every access.
"""

# mypy: ignore-errors
# (numba infers the types, by its own rules: arrays of float32, or of float64 for geometry, and of integers)

from __future__ import annotations

import math
from typing import Tuple

import numpy as np

from legs_loss.kernels.compiling import aligned, claimed, compiled, inlined, part
from legs_loss.kernels.compiling import multiply_add as multiply_add_one
from legs_loss.lab.conventions import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from legs_loss.lab.rasterizer.projection import TALL, WIDE, origin
from legs_loss.lab.rasterizer.sorting import OWNER, ROWS, SUM
from legs_loss.lab.simd.arithmetic import (
    absolute,
    as_floats,
    as_integers,
    at_least,
    maximum,
    minimum,
    multiply_add,
    splat,
    where,
)
from legs_loss.lab.simd.lanes import total, totals
from legs_loss.lab.simd.memory import load, prefetch, store

PIXELS = WIDE * TALL
AHEAD = 16  # entries whose memory is asked for while another is worked on
CHECK = 16  # splats between two looks at whether a strip is finished
FIELDS = 9  # of an entry: e, w1, p, q, w2, r, red, green, blue
# Of a gradient: h = dL/dpower, its moments h w1, h w2, h w1^2, h w1 w2, h w2^2; red, green, blue; if wanted, |u|, |v|.
MOMENTS, ABSOLUTE_MOMENTS = 9, 11

# Planes of a strip's state. T: transmittance, its sign turned once the pixel is finished (or is outside the image).
T = 0
RED, GREEN, BLUE = PIXELS, 2 * PIXELS, 3 * PIXELS  # forward: the colour so far; backward: the gradient to it
REST = 4 * PIXELS  # backward: the gradient's product with the colour that is still to come
WORK = 5 * PIXELS  # what one loop leaves for the next: short loops overlap in the processor, one long loop does not
X = 6 * PIXELS  # one row: its pixels' x
STATE = X + WIDE

_MAX, _MIN, _LAST = np.float32(MAX_ALPHA), np.float32(MIN_ALPHA), np.float32(MIN_TRANSMITTANCE)
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_LOG2E = 1 / math.log(2)
UNIT = math.sqrt(_LOG2E / 2)  # of the entries' own coordinates: log2(alpha) falls by the sum of their squares
# 2^f on [-1/2, 1/2]: least relative error, 2e-7 with float32's rounding.
_P0, _P1, _P2, _P3, _P4, _P5 = (
    np.float32(p) for p in (1.0, 0.693146892, 0.240221543, 0.0555083761, 0.00967473918, 0.00132408877)
)
_UNDERFLOW = np.float32(-32)
_MANTISSA = np.int32(23)
_ROUNDING = np.float32(3 << 22)  # added to a number, it leaves the nearest integer in the last bits


@inlined
def exp2(x):
    """Return 2^x for x <= 0 in each lane, to 2e-7 relative."""
    x = maximum(x, splat(_UNDERFLOW))
    rounded = x + splat(_ROUNDING)
    f = x - (rounded - splat(_ROUNDING))
    fraction = multiply_add(splat(_P5), f, splat(_P4))
    fraction = multiply_add(fraction, f, splat(_P3))
    fraction = multiply_add(fraction, f, splat(_P2))
    fraction = multiply_add(fraction, f, splat(_P1))
    fraction = multiply_add(fraction, f, splat(_P0))
    return as_floats(as_integers(fraction) + (as_integers(rounded) << splat(_MANTISSA)))


@part()
def _expand(begin, end, strip_x, strip_y, splats, draws, entries):
    """Write a strip's entries."""
    for k in range(np.uint64(begin), np.uint64(end)):
        prefetch(splats, draws[min(np.int64(k) + AHEAD, len(draws) - 1), OWNER])
        i = np.uint64(draws[k, OWNER])
        p, q, r = UNIT * splats[i, 2], UNIT * splats[i, 3], UNIT * splats[i, 4]
        x, y = origin(strip_x * WIDE, strip_y * TALL, draws[k, ROWS])
        x -= splats[i, 0]
        y -= splats[i, 1]
        entries[k, 0] = _LOG2E * splats[i, 5]
        entries[k, 1], entries[k, 2], entries[k, 3] = p * x + q * y, p, q
        entries[k, 4], entries[k, 5] = r * x, r
        entries[k, 6], entries[k, 7], entries[k, 8] = splats[i, 6], splats[i, 7], splats[i, 8]


# Blending


@part()
def place(strip, across, image, xs, transmittance):
    """Return a strip's first column and row, and how many of each are in an image [3, H, W] of so many strips across.

    Fills a row's pixel coordinates and full transmittance; pixels outside the image count as finished.
    """
    tall = len(transmittance) // WIDE
    left, top = strip % across * WIDE, strip // across * tall
    columns, rows = min(WIDE, image.shape[2] - left), min(tall, image.shape[1] - top)
    for x in range(WIDE):
        xs[x] = x - (WIDE - 1) / 2
    for pixel in range(len(transmittance)):
        transmittance[pixel] = _ONE if pixel % WIDE < columns and pixel // WIDE < rows else -_ONE
    return left, top, columns, rows


@part()
def unfinished(transmittance):
    """Return whether a pixel of the strip still takes colour: as a rule, already the first one does."""
    for pixel in range(len(transmittance)):  # noqa: SIM110 (numba compiles no any() of a generator)
        if transmittance[pixel] > _ZERO:
            return True
    return False


@inlined
def reach(draws, k):
    """Return an entry's first row, the one past its last, and the first row's y, counted from the middle of them."""
    first, last = np.uint32(draws[k, ROWS]) & 63, np.uint32(draws[k, ROWS] >> 8) & 63
    return first, last, splat((np.float32(first) - np.float32(last) + _ONE) * _HALF)


@inlined
def coordinates(state, entries, k):
    """Return a splat's own coordinates along a row: the first at y = 0, what it gains with y, and the second."""
    xs = load(state, X)
    first = multiply_add(splat(entries[k, 2]), xs, splat(entries[k, 1]))
    return first, splat(entries[k, 3]), multiply_add(splat(entries[k, 5]), xs, splat(entries[k, 4]))


@inlined
def respond(state, first, last, ys, entries, k):
    """Leave an entry's alpha, not yet held at its most, in WORK; `ys`: the first row's."""
    along, down, across = coordinates(state, entries, k)
    most = multiply_add(-across, across, splat(entries[k, 0]))
    for i in range(first * WIDE, last * WIDE, WIDE):
        w = multiply_add(down, ys, along)
        store(state, WORK + i, exp2(multiply_add(-w, w, most)))
        ys = ys + splat(_ONE)


@inlined
def cover(alpha, before):
    """Return the weight of a row's colour, given its transmittance `before`, and T after it."""
    none, weight = splat(_ZERO), alpha * before
    after = before - weight
    drawn = at_least(after, splat(_LAST))  # false for a finished pixel too, whose transmittance is negative
    return where(drawn, weight, none), where(drawn, after, none - absolute(before))


@inlined
def _cover(state, i):
    """Take a row's alpha in WORK from its transmittance: the weight of the colour, alpha as it counts, and T before."""
    alpha, before = minimum(load(state, WORK + i), splat(_MAX)), load(state, T + i)
    alpha = where(at_least(alpha, splat(_MIN)), alpha, splat(_ZERO))
    weight, after = cover(alpha, before)
    store(state, T + i, after)
    return weight, alpha, before


@part()
def _blend(state, begin, end, draws, entries):
    """Blend entries of a strip, in their order."""
    for k in range(begin, end):
        first, last, top = reach(draws, k)
        red, green, blue = splat(entries[k, 6]), splat(entries[k, 7]), splat(entries[k, 8])
        respond(state, first, last, top, entries, k)
        for i in range(first * WIDE, last * WIDE, WIDE):
            weight, _, _ = _cover(state, i)
            store(state, RED + i, multiply_add(weight, red, load(state, RED + i)))
            store(state, GREEN + i, multiply_add(weight, green, load(state, GREEN + i)))
            store(state, BLUE + i, multiply_add(weight, blue, load(state, BLUE + i)))


@inlined
def _render_strip(strip, across, state, ranges, splats, draws, entries, ends, background, image):
    left, top, wide, tall = place(strip, across, image, state[X:], state[T : T + PIXELS])
    state[RED : RED + 3 * PIXELS] = 0
    end = ranges[strip]
    while end < ranges[strip + 1] and unfinished(state[T : T + PIXELS]):
        begin, end = end, min(end + CHECK, ranges[strip + 1])
        _expand(begin, end, strip % across, strip // across, splats, draws, entries)
        _blend(state, begin, end, draws, entries)
    ends[strip] = end
    for channel in range(3):
        for y in range(tall):
            for x in range(wide):
                i = y * WIDE + x
                colour = state[RED + channel * PIXELS + i]
                image[channel, top + y, left + x] = multiply_add_one(abs(state[T + i]), background[channel], colour)


def memory() -> Tuple[np.ndarray]:
    """Return the state of a strip."""
    return (aligned(STATE),)


@compiled()
def render(state, counter, tasks, bands, across, ranges, splats, draws, entries, ends, background, image):
    """Fill the image, and for each strip its entries, up to the end of those that mattered: `in_threads`."""
    band = claimed(counter)
    while band < tasks:
        for strip in range(bands[band, 0], bands[band, 1]):
            _render_strip(strip, across, state, ranges, splats, draws, entries, ends, background, image)
        band = claimed(counter)


@part()
def _blend_backward(state, begin, end, draws, entries, moments, sums):
    """Go front to back as `_blend`, adding to the owners' sums: moments of h = dL/dpower, and the colour's gradient.

    dL/dalpha = T (g . colour) - rest / (1 - alpha), where rest = g . (all the colour behind this splat): what is left
    of g . (the pixel's colour) after what came before. Nothing is carried from back to front.
    """
    none, one = splat(_ZERO), splat(_ONE)
    for k in range(begin, end):
        prefetch(sums, np.uint64(draws[min(k + np.uint64(AHEAD), end - np.uint64(1)), SUM]) * moments)
        first, last, top = reach(draws, k)
        red, green, blue = splat(entries[k, 6]), splat(entries[k, 7]), splat(entries[k, 8])
        respond(state, first, last, top, entries, k)
        r = g = b = none
        for i in range(first * WIDE, last * WIDE, WIDE):
            response = load(state, WORK + i)
            weight, alpha, before = _cover(state, i)
            g_red, g_green, g_blue = load(state, RED + i), load(state, GREEN + i), load(state, BLUE + i)
            own = multiply_add(g_red, red, multiply_add(g_green, green, g_blue * blue))
            rest = multiply_add(none - weight, own, load(state, REST + i))
            store(state, REST + i, rest)
            h = response * multiply_add(before, own, none - rest / (one - alpha))
            store(state, WORK + i, where(at_least(none, weight), none, h))
            r, g, b = multiply_add(weight, g_red, r), multiply_add(weight, g_green, g), multiply_add(weight, g_blue, b)
        along, down, across = coordinates(state, entries, k)
        to_u, p = splat(entries[k, 5]) * across, splat(entries[k, 2])
        m = m1 = m11 = along_u = along_v = none
        ys = top
        for i in range(first * WIDE, last * WIDE, WIDE):
            h, w = load(state, WORK + i), multiply_add(down, ys, along)
            hw = h * w
            m, m1, m11 = m + h, m1 + hw, multiply_add(hw, w, m11)
            if moments == ABSOLUTE_MOMENTS:
                along_u, along_v = along_u + absolute(h * multiply_add(p, w, to_u)), along_v + absolute(hw)
            ys = ys + one
        m2 = across * m
        at = np.uint64(draws[k, SUM]) * moments
        store(sums, at, load(sums, at) + totals(m, m1, m2, m11, across * m1, across * m2, r, g))
        sums[at + 8] += total(b)
        if moments == ABSOLUTE_MOMENTS:
            sums[at + 9] += total(along_u)
            sums[at + 10] += total(along_v) * entries[k, 3]


@inlined
def _render_backward_strip(strip, across, state, ranges, draws, entries, ends, image, g_image, moments, sums):
    left, top, wide, tall = place(strip, across, image, state[X:], state[T : T + PIXELS])
    state[RED:X] = 0
    for channel in range(3):
        for y in range(tall):
            for x in range(wide):
                i, gradient = y * WIDE + x, g_image[channel, top + y, left + x]
                state[RED + channel * PIXELS + i] = gradient
                state[REST + i] = multiply_add_one(gradient, image[channel, top + y, left + x], state[REST + i])
    _blend_backward(state, ranges[strip], ends[strip], draws, entries, moments, sums)


@compiled()
def render_backward(state, counter, tasks, bands, across, ranges, draws, entries, ends, image, g_image, moments, sums):
    """Add the gradient of every entry to its Gaussian's sums; the absolute ones too, where there is room for them."""
    band = claimed(counter)
    while band < tasks:
        for strip in range(bands[band, 0], bands[band, 1]):
            _render_backward_strip(strip, across, state, ranges, draws, entries, ends, image, g_image, moments, sums)
        band = claimed(counter)
