"""The compiled rasterizer's work for each strip of the image: which splats reach it, and blending them, both ways.

A strip is 8 pixels wide and 32 tall: a row of it fills one register, and the rows that a splat reaches are one
contiguous loop, which the compiler turns into eight pixels at a time. (3DGS's own tiles of 16x16 matter to the result
only where they cut off a splat; projection.py sees to that.) All of a strip's state is one array, a plane of 256
numbers each: with separate arrays the compiler cannot prove that they do not overlap, and the loops stay scalar.

Within a strip a splat is the polynomial

    log2(alpha) = e + gx x + gy y + a x^2 + b x y + c y^2        x, y in pixels from `origin`

whose coefficients are computed in float64: as precise for a needle a thousand pixels long as for a dot.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import prange, types
from numba.extending import intrinsic

from legs_loss.reference.compiling import FAST, compiled
from legs_loss.reference.conventions import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from legs_loss.reference.projection import BLOCK, MARGIN, TALL, WIDE, origin

PIXELS = WIDE * TALL
CHECK = 16  # splats between two looks at whether a strip is finished
FIELDS = 9  # of an entry: e, gx, gy, a, b, c, red, green, blue
MOMENTS = 11  # of a slot's gradient: h, hx, hy, hxx, hxy, hyy, red, green, blue, |u|, |v|

# Planes of a strip's state. T: transmittance, its sign turned once the pixel is finished (or is outside the image).
X, Y, T = 0, PIXELS, 2 * PIXELS
RED, GREEN, BLUE = 3 * PIXELS, 4 * PIXELS, 5 * PIXELS  # forward: the colour so far; backward: the gradient to it
REST = 6 * PIXELS  # backward: the gradient's product with the colour that is still to come
PLANES = 7

_MAX, _MIN, _LAST = np.float32(MAX_ALPHA), np.float32(MIN_ALPHA), np.float32(MIN_TRANSMITTANCE)
_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
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
_UNDERFLOW = np.float32(-100)
_BIAS, _MANTISSA = np.int32(127), np.int32(23)


@intrinsic
def _as_float(context: Any, bits: Any) -> Any:
    """The float32 with the bits of an int32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


@compiled(fastmath={"contract", "nnan", "ninf", "nsz"})
def exp2(x):
    """2^x for x <= 0, to 2e-7 relative; written out because a call to the library's would not vectorise."""
    x = max(x, _UNDERFLOW)
    whole = np.int32(x - _HALF)
    f = x - np.float32(whole)
    fraction = _P0 + f * (_P1 + f * (_P2 + f * (_P3 + f * (_P4 + f * _P5))))
    return fraction * _as_float((whole + _BIAS) << _MANTISSA)


# Which splats reach which strip


@compiled()
def order_by_depth(depths, slots, first_slots):
    """Indices of the Gaussians that are drawn, front to back; equal depths keep their order. A radix sort.

    Gives each its first slot too, in the same order.
    """
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
    slot = 0
    for i in order:
        first_slots[i] = slot
        slot += slots[i]
    return order


@compiled()
def _rows(left, top, u, v, a, b, c, determinant, level, y0, y1):
    """Rows [first, end) of the strip at (left, top) where A dx^2 + 2 B dx dy + C dy^2 <= level; end 0: none.

    The ellipse's upper and lower edge over dx are (-B dx +- sqrt(C level - D dx^2)) / C, D = A C - B^2; their
    extreme points are at dx = -+ B sqrt(level / (A D)), or, where the strip does not have them, at its nearer side.
    """
    wide = math.sqrt(level * c / determinant)
    near, far = max(left - u, -wide), min(left + (WIDE - 1) - u, wide)
    if near > far:
        return 0, 0
    summit = -b * math.sqrt(level / (a * determinant))
    at = min(max(summit, near), far)
    highest = v + (-b * at + math.sqrt(max(c * level - determinant * at * at, 0.0))) / c
    at = min(max(-summit, near), far)
    lowest = v + (-b * at - math.sqrt(max(c * level - determinant * at * at, 0.0))) / c
    first = np.int64(math.ceil(max(lowest, max(top, y0)))) - top
    end = np.int64(math.floor(min(highest, min(top + TALL, y1) - 1))) + 1 - top
    if end <= first:
        return 0, 0
    return first, end


@compiled()
def _find_spans_block(first_rank, end_rank, order, splats, boxes, first_slots, across, spans, slot_strips, slot_entries):
    for rank in range(first_rank, end_rank):
        i = order[rank]
        u, v, a, b, c, opacity = splats[i, 0], splats[i, 1], splats[i, 2], splats[i, 3], splats[i, 4], splats[i, 5]
        red, green, blue, determinant = splats[i, 6], splats[i, 7], splats[i, 8], 1 / splats[i, 9]
        x0, y0, x1, y1 = boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3]
        summit = math.log(opacity)
        level = 2 * (summit - math.log(MIN_ALPHA)) + 2 * MARGIN
        slot = first_slots[i]
        for strip_y in range(y0 // TALL, (y1 - 1) // TALL + 1):
            for strip_x in range(x0, x1):
                first, end = _rows(strip_x * WIDE, strip_y * TALL, u, v, a, b, c, determinant, level, y0, y1)
                span = first | end << 8
                spans[slot] = span
                slot_strips[slot] = strip_y * across + strip_x if span != 0 else -1
                x, y = origin(strip_x, strip_y, span)
                x -= u
                y -= v
                entry = slot_entries[slot]
                entry[0] = _LOG2E * (summit - 0.5 * (a * x * x + c * y * y) - b * x * y)
                entry[1] = -_LOG2E * (a * x + b * y)
                entry[2] = -_LOG2E * (b * x + c * y)
                entry[3], entry[4], entry[5] = -0.5 * _LOG2E * a, -_LOG2E * b, -0.5 * _LOG2E * c
                entry[6], entry[7], entry[8] = red, green, blue
                slot += 1


@compiled(parallel=True)
def find_spans(order, splats, boxes, first_slots, across, spans, slot_strips, slot_entries):
    """Fill, for each strip in each Gaussian's box: the rows that it reaches (0: none), the strip, the polynomial."""
    count = len(order)
    for block in prange((count + BLOCK - 1) // BLOCK):
        first = block * BLOCK
        _find_spans_block(
            first, min(first + BLOCK, count), order, splats, boxes, first_slots, across, spans, slot_strips, slot_entries
        )


@compiled()
def fill_entries(spans, slot_strips, slot_entries, ranges):
    """Sort the slots, which are in depth order, by strip. Fills where each strip begins; returns the sorted entries."""
    for strip in slot_strips:
        if strip >= 0:
            ranges[strip + 1] += 1
    for strip in range(1, len(ranges)):
        ranges[strip] += ranges[strip - 1]
    cursors, count = ranges.copy(), ranges[-1]
    entries, entry_slots = np.empty((count, FIELDS), np.float32), np.empty(count, np.int64)
    for slot in range(len(spans)):
        strip = slot_strips[slot]
        if strip >= 0:
            k = cursors[strip]
            cursors[strip] += 1
            entry_slots[k] = slot
            for field in range(FIELDS):
                entries[k, field] = slot_entries[slot, field]
    return entries, entry_slots


# Blending


@compiled()
def _place(state, across, down):
    """Pixel coordinates, full transmittance; pixels outside the image count as finished."""
    for pixel in range(PIXELS):
        x, y = pixel % WIDE, pixel // WIDE
        state[X + pixel], state[Y + pixel] = x - (WIDE - 1) / 2, y
        state[T + pixel] = _ONE if x < across and y < down else -_ONE


@compiled(fastmath=FAST | {"reassoc"})
def _unfinished(state):
    """Whether a pixel of the strip still takes colour."""
    largest = -_ONE
    for pixel in range(PIXELS):
        largest = max(largest, state[T + pixel])
    return largest > _ZERO


@compiled()
def _render_strip(state, begin, end, entries, entry_slots, spans):
    """Blend a strip's entries; returns the one after the last that mattered."""
    for k in range(begin, end):
        if (k - begin) % CHECK == 0 and not _unfinished(state):
            return k
        e, gx, gy, a, b, c = entries[k, 0], entries[k, 1], entries[k, 2], entries[k, 3], entries[k, 4], entries[k, 5]
        red, green, blue = entries[k, 6], entries[k, 7], entries[k, 8]
        span = spans[entry_slots[k]]
        first, last = span & 255, span >> 8 & 255
        middle = np.float32(first + last - 1) * _HALF
        for i in range(first * WIDE, last * WIDE):
            x, y, before = state[X + i], state[Y + i] - middle, state[T + i]
            alpha = min(exp2((a * x + (b * y + gx)) * x + ((c * y + gy) * y + e)), _MAX)
            alpha = alpha if alpha >= _MIN else _ZERO
            after = before - alpha * before
            drawn = after >= _LAST  # false for a finished pixel too, whose transmittance is negative
            weight = alpha * before if drawn else _ZERO
            state[T + i] = after if drawn else -abs(before)
            state[RED + i] += weight * red
            state[GREEN + i] += weight * green
            state[BLUE + i] += weight * blue
    return end


@compiled()
def _render_worker(worker, workers, strip_order, ranges, ends, entries, entry_slots, spans, background, across, image):
    state = np.empty(PLANES * PIXELS, np.float32)
    height, width = image.shape[1], image.shape[2]
    for turn in range(worker, len(strip_order), workers):
        strip = strip_order[turn]
        left, top = strip % across * WIDE, strip // across * TALL
        wide, tall = min(WIDE, width - left), min(TALL, height - top)
        _place(state, wide, tall)
        state[RED : RED + 3 * PIXELS] = 0
        ends[strip] = _render_strip(state, ranges[strip], ranges[strip + 1], entries, entry_slots, spans)
        for y in range(tall):
            for x in range(wide):
                pixel = y * WIDE + x
                left_over = abs(state[T + pixel])
                image[0, top + y, left + x] = state[RED + pixel] + left_over * background[0]
                image[1, top + y, left + x] = state[GREEN + pixel] + left_over * background[1]
                image[2, top + y, left + x] = state[BLUE + pixel] + left_over * background[2]


@compiled(parallel=True)
def render(workers, strip_order, ranges, ends, entries, entry_slots, spans, background, across, image):
    """Fill the image, and for each strip the end of the entries that mattered."""
    for worker in prange(workers):
        _render_worker(
            worker, workers, strip_order, ranges, ends, entries, entry_slots, spans, background, across, image
        )


@compiled(fastmath=FAST | {"reassoc"})
def _render_backward_strip(state, begin, end, entries, entry_slots, spans, slot_gradients):
    """As `_render_strip`, front to back, filling the slots' gradients: moments of h = dL/dpower, and the colour's.

    dL/dalpha = T (g . colour) - rest / (1 - alpha), where rest = g . (all the colour behind this splat): what is left
    of g . (the pixel's colour) after what came before. Nothing is carried from back to front.
    """
    scale = np.float32(1 / _LOG2E)
    for k in range(begin, end):
        e, gx, gy, a, b, c = entries[k, 0], entries[k, 1], entries[k, 2], entries[k, 3], entries[k, 4], entries[k, 5]
        red, green, blue = entries[k, 6], entries[k, 7], entries[k, 8]
        slot = entry_slots[k]
        span = spans[slot]
        first, last = span & 255, span >> 8 & 255
        middle = np.float32(first + last - 1) * _HALF
        a2, c2 = a + a, c + c
        m = mx = my = mxx = mxy = myy = r = g = bl = au = av = _ZERO
        for i in range(first * WIDE, last * WIDE):
            x, y, before = state[X + i], state[Y + i] - middle, state[T + i]
            response = exp2((a * x + (b * y + gx)) * x + ((c * y + gy) * y + e))
            alpha = min(response, _MAX)
            alpha = alpha if alpha >= _MIN else _ZERO
            after = before - alpha * before
            drawn = after >= _LAST
            weight = alpha * before if drawn else _ZERO
            state[T + i] = after if drawn else -abs(before)
            g_red, g_green, g_blue = state[RED + i], state[GREEN + i], state[BLUE + i]
            own = g_red * red + g_green * green + g_blue * blue
            rest = state[REST + i] - weight * own
            state[REST + i] = rest
            h = response * (before * own - rest / (_ONE - alpha))
            h = h if weight > _ZERO else _ZERO
            hx, hy = h * x, h * y
            m += h
            mx += hx
            my += hy
            mxx += hx * x
            mxy += hx * y
            myy += hy * y
            r += weight * g_red
            g += weight * g_green
            bl += weight * g_blue
            au += abs(h * (a2 * x + (b * y + gx)))
            av += abs(h * (c2 * y + (b * x + gy)))
        out = slot_gradients[slot]
        out[0], out[1], out[2], out[3], out[4], out[5] = m, mx, my, mxx, mxy, myy
        out[6], out[7], out[8], out[9], out[10] = r, g, bl, au * scale, av * scale


@compiled()
def _render_backward_worker(
    worker, workers, strip_order, ranges, ends, entries, entry_slots, spans, across, image, g_image, slot_gradients
):
    state = np.empty(PLANES * PIXELS, np.float32)
    height, width = image.shape[1], image.shape[2]
    for turn in range(worker, len(strip_order), workers):
        strip = strip_order[turn]
        left, top = strip % across * WIDE, strip // across * TALL
        wide, tall = min(WIDE, width - left), min(TALL, height - top)
        _place(state, wide, tall)
        state[RED:] = 0
        for y in range(tall):
            for x in range(wide):
                pixel = y * WIDE + x
                rest = _ZERO
                for channel in range(3):
                    gradient = g_image[channel, top + y, left + x]
                    state[RED + channel * PIXELS + pixel] = gradient
                    rest += gradient * image[channel, top + y, left + x]
                state[REST + pixel] = rest
        _render_backward_strip(state, ranges[strip], ends[strip], entries, entry_slots, spans, slot_gradients)
        for k in range(ends[strip], ranges[strip + 1]):
            slot_gradients[entry_slots[k]] = 0


@compiled(parallel=True)
def render_backward(
    workers, strip_order, ranges, ends, entries, entry_slots, spans, across, image, g_image, slot_gradients
):
    """Fill the gradient of every slot that has an entry."""
    for worker in prange(workers):
        _render_backward_worker(
            worker, workers, strip_order, ranges, ends, entries, entry_slots, spans, across, image, g_image,
            slot_gradients,
        )  # fmt: skip
