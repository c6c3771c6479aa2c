"""The compiled rasterizer's work for each tile: which splats reach it, and blending them, forward and backward.

A tile is two strips of 8x16 pixels, one above the other in memory, so that a row of a strip fills one register and the
rows that a splat reaches are one contiguous loop. All of a tile's state is one array, a plane of 256 numbers each:
with separate arrays the compiler cannot prove that they do not overlap, and does not vectorise.

Within a tile a splat is the polynomial

    log2(alpha) = e + gx x + gy y + a x^2 + b x y + c y^2        x, y in pixels from the tile's centre

whose coefficients are computed in float64: as precise for a needle a thousand pixels away as for a dot in the tile.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import prange, types
from numba.extending import intrinsic

from legs_loss.reference.compiling import FAST, compiled
from legs_loss.reference.conventions import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, TILE
from legs_loss.reference.projection import BLOCK, MARGIN

STRIP = 8  # pixels across
PIXELS = TILE * TILE
HALF_PIXELS = PIXELS // 2  # in a strip
CENTRE = (TILE - 1) / 2
CHECK = 16  # splats between two looks at whether a strip is finished
FIELDS = 9  # of an entry: e, gx, gy, a, b, c, red, green, blue
MOMENTS = 11  # of a slot's gradient: h, hx, hy, hxx, hxy, hyy, red, green, blue, |u|, |v|

# Planes of a tile's state. T is the transmittance; its sign is turned once the pixel is finished (or outside the image).
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


# Which splats reach which tile


@compiled()
def _strip_rows(left, top, u, v, a, b, c, determinant, level):
    """Rows [first, end) of the strip at (left, top) within which A dx^2 + 2 B dx dy + C dy^2 <= level; end 0: none.

    The ellipse's upper and lower edge over dx are (-B dx +- sqrt(C level - D dx^2)) / C, D = A C - B^2; their
    extreme points are at dx = -+ B sqrt(level / (A D)), or, where the strip does not have them, at its nearer side.
    """
    wide = math.sqrt(level * c / determinant)
    near, far = max(left - u, -wide), min(left + (STRIP - 1) - u, wide)
    if near > far:
        return 0, 0
    summit = -b * math.sqrt(level / (a * determinant))
    at = min(max(summit, near), far)
    highest = (-b * at + math.sqrt(max(c * level - determinant * at * at, 0.0))) / c
    at = min(max(-summit, near), far)
    lowest = (-b * at - math.sqrt(max(c * level - determinant * at * at, 0.0))) / c
    first = max(math.ceil(max(v + lowest - top, 0.0)), 0)
    end = math.floor(min(v + highest - top, TILE - 1.0)) + 1
    if end <= first:
        return 0, 0
    return first, end


@compiled()
def _find_spans_block(first, end, splats, boxes, slots, first_slots, spans):
    for i in range(first, end):
        if slots[i] == 0:
            continue
        u, v, a, b, c, opacity = splats[i, 0], splats[i, 1], splats[i, 2], splats[i, 3], splats[i, 4], splats[i, 5]
        level, determinant = 2 * math.log(opacity / MIN_ALPHA) + 2 * MARGIN, 1 / splats[i, 9]
        slot = first_slots[i]
        for tile_y in range(boxes[i, 1], boxes[i, 3]):
            for tile_x in range(boxes[i, 0], boxes[i, 2]):
                left, top = float(tile_x * TILE), float(tile_y * TILE)
                first0, end0 = _strip_rows(left, top, u, v, a, b, c, determinant, level)
                first1, end1 = _strip_rows(left + STRIP, top, u, v, a, b, c, determinant, level)
                spans[slot] = first0 | end0 << 5 | first1 << 10 | end1 << 15
                slot += 1


@compiled(parallel=True)
def find_spans(splats, boxes, slots, first_slots, spans):
    """Fill, for each tile in each Gaussian's box, the rows of its two strips that the Gaussian reaches; 0: none."""
    count = len(slots)
    for block in prange((count + BLOCK - 1) // BLOCK):
        first = block * BLOCK
        _find_spans_block(first, min(first + BLOCK, count), splats, boxes, slots, first_slots, spans)


@compiled()
def order_by_depth(depths, slots):
    """Indices of the Gaussians with a slot, front to back; equal depths keep their order. A radix sort."""
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


@compiled(parallel=True)
def count_entries(order, boxes, first_slots, spans, tiles, counts, workers):
    """Fill the number of splats that reach each tile. Each worker has rows of tiles of its own."""
    for worker in prange(workers):
        for i in order:
            across = boxes[i, 2] - boxes[i, 0]
            for tile_y in range(boxes[i, 1], boxes[i, 3]):
                if tile_y % workers == worker:
                    slot = first_slots[i] + (tile_y - boxes[i, 1]) * across
                    for tile_x in range(boxes[i, 0], boxes[i, 2]):
                        if spans[slot] != 0:
                            counts[tile_y * tiles[0] + tile_x] += 1
                        slot += 1


@compiled(parallel=True)
def fill_entries(order, splats, boxes, first_slots, spans, tiles, cursors, entries, entry_slots, workers):
    """Write each tile's splats, front to back, where `cursors` says that the tile begins (and which it moves)."""
    for worker in prange(workers):
        for i in order:
            u, v, a, b, c = splats[i, 0], splats[i, 1], splats[i, 2], splats[i, 3], splats[i, 4]
            summit = math.log(splats[i, 5])
            across = boxes[i, 2] - boxes[i, 0]
            for tile_y in range(boxes[i, 1], boxes[i, 3]):
                if tile_y % workers == worker:
                    slot = first_slots[i] + (tile_y - boxes[i, 1]) * across
                    for tile_x in range(boxes[i, 0], boxes[i, 2]):
                        if spans[slot] != 0:
                            tile = tile_y * tiles[0] + tile_x
                            dx, dy = tile_x * TILE + CENTRE - u, tile_y * TILE + CENTRE - v
                            k = cursors[tile]
                            cursors[tile] += 1
                            entry_slots[k] = slot
                            entry = entries[k]
                            entry[0] = _LOG2E * (summit - 0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
                            entry[1] = -_LOG2E * (a * dx + b * dy)
                            entry[2] = -_LOG2E * (b * dx + c * dy)
                            entry[3] = -0.5 * _LOG2E * a
                            entry[4] = -_LOG2E * b
                            entry[5] = -0.5 * _LOG2E * c
                            entry[6], entry[7], entry[8] = splats[i, 6], splats[i, 7], splats[i, 8]
                        slot += 1


# Blending


@compiled()
def _place(state, across, down):
    """Pixel coordinates about the tile's centre, full transmittance; pixels outside the image count as finished."""
    for pixel in range(PIXELS):
        x, y = pixel // HALF_PIXELS * STRIP + pixel % STRIP, pixel % HALF_PIXELS // STRIP
        state[X + pixel], state[Y + pixel] = x - CENTRE, y - CENTRE
        state[T + pixel] = _ONE if x < across and y < down else -_ONE


@compiled(fastmath=FAST | {"reassoc"})
def _unfinished(state, strip):
    """Whether a pixel of the strip still takes colour."""
    largest = -_ONE
    for pixel in range(HALF_PIXELS):
        largest = max(largest, state[T + strip * HALF_PIXELS + pixel])
    return largest > _ZERO


@compiled()
def _blend(state, first, end, entry):
    e, gx, gy, a, b, c = entry[0], entry[1], entry[2], entry[3], entry[4], entry[5]
    red, green, blue = entry[6], entry[7], entry[8]
    for i in range(first, end):
        x, y, before = state[X + i], state[Y + i], state[T + i]
        alpha = min(exp2((a * x + (b * y + gx)) * x + ((c * y + gy) * y + e)), _MAX)
        alpha = alpha if alpha >= _MIN else _ZERO
        after = before - alpha * before
        drawn = after >= _LAST  # false for a finished pixel too, whose transmittance is negative
        weight = alpha * before if drawn else _ZERO
        state[T + i] = after if drawn else -abs(before)
        state[RED + i] += weight * red
        state[GREEN + i] += weight * green
        state[BLUE + i] += weight * blue


@compiled()
def _render_tile(state, begin, end, entries, entry_slots, spans):
    """Blend a tile's entries; returns the one after the last that mattered."""
    open0 = open1 = True
    for k in range(begin, end):
        if (k - begin) % CHECK == 0:
            open0, open1 = open0 and _unfinished(state, 0), open1 and _unfinished(state, 1)
            if not (open0 or open1):
                return k
        span = spans[entry_slots[k]]
        if open0:
            _blend(state, (span & 31) * STRIP, (span >> 5 & 31) * STRIP, entries[k])
        if open1:
            _blend(state, HALF_PIXELS + (span >> 10 & 31) * STRIP, HALF_PIXELS + (span >> 15 & 31) * STRIP, entries[k])
    return end


@compiled()
def _render_worker(worker, workers, tile_order, ranges, ends, entries, entry_slots, spans, background, tiles, image):
    state = np.empty(PLANES * PIXELS, np.float32)
    height, width = image.shape[1], image.shape[2]
    for t in range(worker, len(tile_order), workers):
        tile = tile_order[t]
        left, top = tile % tiles[0] * TILE, tile // tiles[0] * TILE
        across, down = min(TILE, width - left), min(TILE, height - top)
        _place(state, across, down)
        state[RED : RED + 3 * PIXELS] = 0
        ends[tile] = _render_tile(state, ranges[tile], ranges[tile + 1], entries, entry_slots, spans)
        for y in range(down):
            for x in range(across):
                pixel = x // STRIP * HALF_PIXELS + y * STRIP + x % STRIP
                left_over = abs(state[T + pixel])
                image[0, top + y, left + x] = state[RED + pixel] + left_over * background[0]
                image[1, top + y, left + x] = state[GREEN + pixel] + left_over * background[1]
                image[2, top + y, left + x] = state[BLUE + pixel] + left_over * background[2]


@compiled(parallel=True)
def render(workers, tile_order, ranges, ends, entries, entry_slots, spans, background, tiles, image):
    """Fill the image, and for each tile the end of the entries that mattered."""
    for worker in prange(workers):
        _render_worker(worker, workers, tile_order, ranges, ends, entries, entry_slots, spans, background, tiles, image)


@compiled(fastmath=FAST | {"reassoc"})
def _blend_backward(state, first, end, entry, out):
    """As `_blend`, front to back, adding the moments of h = dL/dpower and the colour's gradient to `out`.

    dL/dalpha = T (g . colour) - rest / (1 - alpha), where rest = g . (all the colour behind this splat): what is left
    of g . (the pixel's colour) after what came before. Nothing is carried from back to front.
    """
    e, gx, gy, a, b, c = entry[0], entry[1], entry[2], entry[3], entry[4], entry[5]
    red, green, blue = entry[6], entry[7], entry[8]
    a2, c2 = a + a, c + c
    m = mx = my = mxx = mxy = myy = r = g = bl = au = av = _ZERO
    for i in range(first, end):
        x, y, before = state[X + i], state[Y + i], state[T + i]
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
    out[0] += m
    out[1] += mx
    out[2] += my
    out[3] += mxx
    out[4] += mxy
    out[5] += myy
    out[6] += r
    out[7] += g
    out[8] += bl
    out[9] += au
    out[10] += av


@compiled()
def _render_backward_tile(state, begin, end, entries, entry_slots, spans, slot_gradients):
    open0 = open1 = True
    scale = np.float32(1 / _LOG2E)
    for k in range(begin, end):
        if (k - begin) % CHECK == 0:
            open0, open1 = open0 and _unfinished(state, 0), open1 and _unfinished(state, 1)
        span = spans[entry_slots[k]]
        out = slot_gradients[entry_slots[k]]
        out[:] = 0
        if open0 and span & 1023:
            _blend_backward(state, (span & 31) * STRIP, (span >> 5 & 31) * STRIP, entries[k], out)
        if open1 and span >> 10:
            first, last = HALF_PIXELS + (span >> 10 & 31) * STRIP, HALF_PIXELS + (span >> 15 & 31) * STRIP
            _blend_backward(state, first, last, entries[k], out)
        out[9] *= scale
        out[10] *= scale


@compiled()
def _render_backward_worker(
    worker, workers, tile_order, ranges, ends, entries, entry_slots, spans, tiles, image, g_image, slot_gradients
):
    state = np.empty(PLANES * PIXELS, np.float32)
    height, width = image.shape[1], image.shape[2]
    for t in range(worker, len(tile_order), workers):
        tile = tile_order[t]
        left, top = tile % tiles[0] * TILE, tile // tiles[0] * TILE
        across, down = min(TILE, width - left), min(TILE, height - top)
        _place(state, across, down)
        state[RED:] = 0
        for y in range(down):
            for x in range(across):
                pixel = x // STRIP * HALF_PIXELS + y * STRIP + x % STRIP
                rest = _ZERO
                for channel in range(3):
                    gradient = g_image[channel, top + y, left + x]
                    state[RED + channel * PIXELS + pixel] = gradient
                    rest += gradient * image[channel, top + y, left + x]
                state[REST + pixel] = rest
        _render_backward_tile(state, ranges[tile], ends[tile], entries, entry_slots, spans, slot_gradients)
        for k in range(ends[tile], ranges[tile + 1]):
            slot_gradients[entry_slots[k]] = 0


@compiled(parallel=True)
def render_backward(
    workers, tile_order, ranges, ends, entries, entry_slots, spans, tiles, image, g_image, slot_gradients
):
    """Fill the gradient of every slot that has an entry."""
    for worker in prange(workers):
        _render_backward_worker(
            worker, workers, tile_order, ranges, ends, entries, entry_slots, spans, tiles, image, g_image,
            slot_gradients,
        )  # fmt: skip
