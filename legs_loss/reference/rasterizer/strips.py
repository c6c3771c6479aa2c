"""The compiled rasterizer's work for each strip of the image: which splats reach it, and blending them, both ways.

A strip is 8 pixels wide and 32 tall: a row of it fills one register, and the rows that a splat reaches are one
contiguous loop. (3DGS's own tiles of 16x16 matter to the result only where they cut off a splat; projection.py sees to
that.) All of a strip's state is one array, a plane of 256 numbers each.

Within a strip a splat is the polynomial

    log2(alpha) = e + gx x + gy y + a x^2 + b x y + c y^2        x, y in pixels from `origin`

whose coefficients are computed in float64: as precise for a needle a thousand pixels long as for a dot.

Indices are unsigned where it counts: of any other, Python's rules for negative ones are looked after at every access.
"""

# mypy: ignore-errors
# (numba infers the types, by its own rules: arrays of float32, or of float64 for geometry, and of integers)

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from legs_loss.kernels.compiling import compiled
from legs_loss.kernels.vectors import (
    absolute,
    as_floats,
    as_integers,
    at_least,
    lane,
    load,
    maximum,
    minimum,
    multiply_add,
    splat,
    store,
    total,
    totals,
    where,
)
from legs_loss.reference.conventions import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from legs_loss.reference.rasterizer.intrinsics import prefetch
from legs_loss.reference.rasterizer.projection import BLOCK, FAINTEST, TALL, WIDE, origin

PIXELS = WIDE * TALL
AHEAD = 16  # entries whose memory is asked for while another is worked on
CHECK = 16  # splats between two looks at whether a strip is finished
FIELDS = 9  # of an entry: e, gx, gy, a, b, c, red, green, blue
MOMENTS = 11  # of an entry's gradient: h, hx, hy, hxx, hxy, hyy, red, green, blue, |u|, |v|

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
# 2^f on [-1/2, 1/2]: least relative error, 2e-7 with float32's rounding.
_P0, _P1, _P2, _P3, _P4, _P5 = (
    np.float32(p)
    for p in (
        1.0000000555094926,
        0.693146891996,
        0.2402215426512,
        0.05550837614390,
        0.009674739176515,
        0.001324088770716,
    )
)
_UNDERFLOW = np.float32(-32)
_MANTISSA = np.int32(23)
_ROUNDING = np.float32(3 << 22)  # added to a number, it leaves the nearest integer in the last bits


@njit(inline="always")
def exp2(x):
    """2^x for x <= 0 in each lane, to 2e-7 relative."""
    x = maximum(x, splat(_UNDERFLOW))
    rounded = x + splat(_ROUNDING)
    f = x - (rounded - splat(_ROUNDING))
    fraction = multiply_add(splat(_P5), f, splat(_P4))
    fraction = multiply_add(fraction, f, splat(_P3))
    fraction = multiply_add(fraction, f, splat(_P2))
    fraction = multiply_add(fraction, f, splat(_P1))
    fraction = multiply_add(fraction, f, splat(_P0))
    return as_floats(as_integers(fraction) + (as_integers(rounded) << splat(_MANTISSA)))


# Which splats reach which strip


@compiled()
def order_by_depth(depths, slots):
    """Indices of the Gaussians that are drawn, front to back; equal depths keep their order. A radix sort."""
    bits, count = depths.view(np.uint32), 0
    order = np.empty(len(slots), np.int32)
    for i in range(len(slots)):
        if slots[i] > 0:
            order[count] = i
            count += 1
    order = order[:count]
    other = np.empty_like(order)
    for shift in (0, 11, 22):  # depths are positive: their bits, as integers, sort as they do
        starts = np.zeros(2049, np.int64)
        for i in order:
            starts[((bits[i] >> shift) & 2047) + 1] += 1
        for k in range(1, 2049):
            starts[k] += starts[k - 1]
        for i in order:
            digit = (bits[i] >> shift) & 2047
            other[starts[digit]] = i
            starts[digit] += 1
        order, other = other, order
    return order


@compiled()
def _find_rows_block(first, end, splats, boxes, slots, first_slots, across, slot_strips, slot_rows):
    for i in range(np.uint64(first), np.uint64(end)):
        if slots[i] == 0:
            continue
        u, v, a, b, c = splats[i, 0], splats[i, 1], splats[i, 2], splats[i, 3], splats[i, 4]
        determinant = splats[i, 9]  # the covariance's: 1 / D below
        x0, y0, x1, y1 = boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3]
        level = 2 * (splats[i, 5] - FAINTEST)
        # The ellipse's upper and lower edge over dx are (-B dx +- sqrt(C level - D dx^2)) / C, D = A C - B^2. Their
        # extreme points are at dx = summit and -summit, or, where the strip does not have them, at its nearer side.
        level_d, inverse = level * determinant, 1 / c
        wide = math.sqrt(level_d * c)
        summit = -b * math.sqrt(level_d / a)
        tall, slope, bend = level * inverse, -b * inverse, inverse * inverse / determinant
        slot = np.uint64(first_slots[i])
        for strip_y in range(y0 // TALL, (y1 - 1) // TALL + 1):
            top = strip_y * TALL
            first_row, last_row = float(max(top, y0)), float(min(top + TALL, y1) - 1)
            for strip_x in range(x0, x1):
                near, far = max(strip_x * WIDE - u, -wide), min(strip_x * WIDE + (WIDE - 1) - u, wide)
                slot_strips[slot], slot_rows[slot] = -1, 0
                if near <= far:
                    at = min(max(-summit, near), far)
                    row = math.ceil(max(first_row, v + slope * at - math.sqrt(max(tall - bend * at * at, 0.0))))
                    at = min(max(summit, near), far)
                    end_row = math.floor(min(last_row, v + slope * at + math.sqrt(max(tall - bend * at * at, 0.0)))) + 1
                    if row < end_row:
                        slot_strips[slot] = strip_y * across + strip_x
                        slot_rows[slot] = np.int32(row - top) | np.int32(end_row - top) << 8
                slot += np.uint64(1)


@compiled(parallel=True)
def find_rows(splats, boxes, slots, first_slots, across, slot_strips, slot_rows):
    """Fill the slots, one for each strip in each Gaussian's box: the strip, or -1, and its rows."""
    count = len(slots)
    for block in prange((count + BLOCK - 1) // BLOCK):
        first = block * BLOCK
        _find_rows_block(
            first, min(first + BLOCK, count), splats, boxes, slots, first_slots, across, slot_strips, slot_rows
        )


@compiled()
def sort_slots(order, slots, first_slots, slot_strips, slot_rows, ranges, places, owners, rows):
    """Give each slot that reaches its strip a place among the entries: by strip, and in a strip by depth.

    Fills where each strip's entries begin, each slot's place, and each entry's Gaussian and rows.
    """
    for strip in slot_strips:
        if strip >= 0:
            ranges[strip + 1] += 1
    for strip in range(1, len(ranges)):
        ranges[strip] += ranges[strip - 1]
    cursors = ranges.copy()
    for turn in range(len(order)):
        prefetch(slot_strips, first_slots[order[min(turn + AHEAD, len(order) - 1)]])
        owner = order[turn]
        i = np.uint64(owner)
        for slot in range(np.uint64(first_slots[i]), np.uint64(first_slots[i] + slots[i])):
            strip = slot_strips[slot]
            if strip >= 0:
                at = np.uint64(strip)
                place = np.uint64(cursors[at])
                cursors[at] += 1
                places[slot], owners[place], rows[place] = place, owner, slot_rows[slot]


@compiled()
def _expand(begin, end, strip_x, strip_y, splats, owners, rows, entries):
    """Write the polynomials of a strip's entries."""
    for k in range(np.uint64(begin), np.uint64(end)):
        prefetch(splats, owners[min(np.int64(k) + AHEAD, len(owners) - 1)])
        i = np.uint64(owners[k])
        a, b, c = splats[i, 2], splats[i, 3], splats[i, 4]
        x, y = origin(strip_x, strip_y, rows[k])
        x -= splats[i, 0]
        y -= splats[i, 1]
        entries[k, 0] = _LOG2E * (splats[i, 5] - 0.5 * (a * x * x + c * y * y) - b * x * y)
        entries[k, 1], entries[k, 2] = -_LOG2E * (a * x + b * y), -_LOG2E * (b * x + c * y)
        entries[k, 3], entries[k, 4], entries[k, 5] = -0.5 * _LOG2E * a, -_LOG2E * b, -0.5 * _LOG2E * c
        entries[k, 6], entries[k, 7], entries[k, 8] = splats[i, 6], splats[i, 7], splats[i, 8]


# Blending


@compiled()
def place(state, across, down):
    """Pixel coordinates, full transmittance; pixels outside the image count as finished."""
    for x in range(WIDE):
        state[X + x] = x - (WIDE - 1) / 2
    for pixel in range(PIXELS):
        state[T + pixel] = _ONE if pixel % WIDE < across and pixel // WIDE < down else -_ONE


@njit(inline="always")
def _write(pixels, at, wide, values, state):
    """Set a strip's row in an image, by way of WORK where the strip is cut off by the image's edge."""
    if wide == WIDE:
        store(pixels, at, values)
    else:
        store(state, WORK, values)
        for x in range(wide):
            pixels[at + x] = state[WORK + x]


@njit(inline="always")
def _read(pixels, at, wide, state):
    """Return a strip's row in an image; what is beyond the image's edge is 0."""
    if wide < WIDE:
        store(state, WORK, splat(_ZERO))
        for x in range(wide):
            state[WORK + x] = pixels[at + x]
        row = load(state, WORK)
    else:
        row = load(pixels, at)
    return row


@compiled()
def _unfinished(state):
    """Whether a pixel of the strip still takes colour: as a rule, already the first one does."""
    for pixel in range(PIXELS):  # noqa: SIM110 (numba compiles no any() of a generator)
        if state[T + pixel] > _ZERO:
            return True
    return False


@njit(inline="always")
def reach(rows, k):
    """An entry's first row, the one past its last, and the first row's y, counted from the middle of them."""
    first, last = np.uint32(rows[k]) & 63, np.uint32(rows[k] >> 8) & 63
    return first, last, splat((np.float32(first) - np.float32(last) + _ONE) * _HALF)


@njit(inline="always")
def respond(state, first, last, ys, entries, k):
    """Leave an entry's alpha, not yet held at its most, in WORK; `ys`: the first row's."""
    xs = load(state, X)
    at_middle = multiply_add(multiply_add(splat(entries[k, 3]), xs, splat(entries[k, 1])), xs, splat(entries[k, 0]))
    slope, bend = multiply_add(splat(entries[k, 4]), xs, splat(entries[k, 2])), splat(entries[k, 5])
    for i in range(first * WIDE, last * WIDE, WIDE):
        store(state, WORK + i, exp2(multiply_add(multiply_add(bend, ys, slope), ys, at_middle)))
        ys = ys + splat(_ONE)


@njit(inline="always")
def cover(alpha, before):
    """What a row's alpha takes from its transmittance `before`: the weight of the colour, and T after."""
    none, weight = splat(_ZERO), alpha * before
    after = before - weight
    drawn = at_least(after, splat(_LAST))  # false for a finished pixel too, whose transmittance is negative
    return where(drawn, weight, none), where(drawn, after, none - absolute(before))


@njit(inline="always")
def _cover(state, i):
    """Take a row's alpha in WORK from its transmittance: the weight of the colour, alpha as it counts, and T before."""
    alpha, before = minimum(load(state, WORK + i), splat(_MAX)), load(state, T + i)
    alpha = where(at_least(alpha, splat(_MIN)), alpha, splat(_ZERO))
    weight, after = cover(alpha, before)
    store(state, T + i, after)
    return weight, alpha, before


@compiled()
def _blend(state, begin, end, rows, entries):
    """Blend entries of a strip, in their order."""
    for k in range(begin, end):
        first, last, top = reach(rows, k)
        red, green, blue = splat(entries[k, 6]), splat(entries[k, 7]), splat(entries[k, 8])
        respond(state, first, last, top, entries, k)
        for i in range(first * WIDE, last * WIDE, WIDE):
            weight, _, _ = _cover(state, i)
            store(state, RED + i, multiply_add(weight, red, load(state, RED + i)))
            store(state, GREEN + i, multiply_add(weight, green, load(state, GREEN + i)))
            store(state, BLUE + i, multiply_add(weight, blue, load(state, BLUE + i)))


@compiled()
def _render_worker(
    worker, workers, strip_order, ranges, splats, owners, rows, entries, ends, background, across, image
):
    state = np.empty(STATE, np.float32)
    height, width, pixels = image.shape[1], image.shape[2], image.reshape(-1)
    for turn in range(worker, len(strip_order), workers):
        strip = strip_order[turn]
        left, top = strip % across * WIDE, strip // across * TALL
        wide, tall = min(WIDE, width - left), min(TALL, height - top)
        place(state, wide, tall)
        state[RED : RED + 3 * PIXELS] = 0
        end = ranges[strip]
        while end < ranges[strip + 1] and _unfinished(state):
            begin, end = end, min(end + CHECK, ranges[strip + 1])
            _expand(begin, end, strip % across, strip // across, splats, owners, rows, entries)
            _blend(state, begin, end, rows, entries)
        ends[strip] = end
        for y in range(tall):
            left_over = absolute(load(state, T + y * WIDE))
            for channel in range(3):
                colour = load(state, RED + channel * PIXELS + y * WIDE)
                colour = multiply_add(left_over, splat(background[channel]), colour)
                _write(pixels, (channel * height + top + y) * width + left, wide, colour, state)


@compiled(parallel=True)
def render(workers, strip_order, ranges, splats, owners, rows, entries, ends, background, across, image):
    """Fill the image, and for each strip its entries, up to the end of those that mattered."""
    for worker in prange(workers):
        _render_worker(
            np.int64(worker),
            workers,
            strip_order,
            ranges,
            splats,
            owners,
            rows,
            entries,
            ends,
            background,
            across,
            image,
        )


@compiled()
def _blend_backward(state, begin, end, rows, entries, absolutely, gradients):
    """As `_blend`, front to back, filling the entries' gradients: moments of h = dL/dpower, and the colour's.

    dL/dalpha = T (g . colour) - rest / (1 - alpha), where rest = g . (all the colour behind this splat): what is left
    of g . (the pixel's colour) after what came before. Nothing is carried from back to front.
    """
    xs, none, one = load(state, X), splat(_ZERO), splat(_ONE)
    scale = np.float32(1 / _LOG2E)
    for k in range(begin, end):
        first, last, top = reach(rows, k)
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
        m = my = myy = none
        ys = top
        for i in range(first * WIDE, last * WIDE, WIDE):
            h = load(state, WORK + i)
            hy = h * ys
            m, my, myy = m + h, my + hy, multiply_add(hy, ys, myy)
            ys = ys + one
        mx = m * xs
        sums = totals(m, mx, my, mx * xs, my * xs, myy, r, g)
        for moment in range(8):
            gradients[k, moment] = lane(sums, moment)
        gradients[k, 8], gradients[k, 9], gradients[k, 10] = total(b), _ZERO, _ZERO
        if absolutely:
            two, mixed = splat(np.float32(2)), splat(entries[k, 4])
            u = multiply_add(two * splat(entries[k, 3]), xs, splat(entries[k, 1]))
            v, bend = multiply_add(mixed, xs, splat(entries[k, 2])), two * splat(entries[k, 5])
            along_u = along_v = none
            ys = top
            for i in range(first * WIDE, last * WIDE, WIDE):
                h = load(state, WORK + i)
                along_u = along_u + absolute(h * multiply_add(mixed, ys, u))
                along_v = along_v + absolute(h * multiply_add(bend, ys, v))
                ys = ys + one
            gradients[k, 9], gradients[k, 10] = total(along_u) * scale, total(along_v) * scale


@compiled()
def _render_backward_worker(
    worker, workers, strip_order, ranges, rows, entries, ends, across, image, g_image, absolute, gradients
):
    state = np.empty(STATE, np.float32)
    height, width, pixels, g_pixels = image.shape[1], image.shape[2], image.reshape(-1), g_image.reshape(-1)
    for turn in range(worker, len(strip_order), workers):
        strip = strip_order[turn]
        left, top = strip % across * WIDE, strip // across * TALL
        wide, tall = min(WIDE, width - left), min(TALL, height - top)
        place(state, wide, tall)
        state[RED:X] = 0
        for y in range(tall):
            rest = splat(_ZERO)
            for channel in range(3):
                at = (channel * height + top + y) * width + left
                gradient = _read(g_pixels, at, wide, state)
                store(state, RED + channel * PIXELS + y * WIDE, gradient)
                rest = multiply_add(gradient, _read(pixels, at, wide, state), rest)
            store(state, REST + y * WIDE, rest)
        _blend_backward(state, ranges[strip], ends[strip], rows, entries, absolute, gradients)
        gradients[ends[strip] : ranges[strip + 1]] = 0


@compiled(parallel=True)
def render_backward(workers, strip_order, ranges, rows, entries, ends, across, image, g_image, absolute, gradients):
    """Fill the gradient of every entry; the absolute sums, if asked for."""
    for worker in prange(workers):
        _render_backward_worker(
            np.int64(worker),
            workers,
            strip_order,
            ranges,
            rows,
            entries,
            ends,
            across,
            image,
            g_image,
            absolute,
            gradients,
        )
