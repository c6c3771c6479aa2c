"""The fast rasterizer of surfels: blending in compiled strips of the image, both ways, as one function of torch.

With the rows of a homography T = (x, y, w), the ray of the pixel (i, j) meets the disc at

    p = (i w - x) x (j w - y) = x x y + i (y x w) + j (w x x),      (u, v) = p_xy / p_z,      depth = det T / p_z

so p is linear in the pixel. It is worked out about the disc's centre in float64 and scaled so that p_z is 1 there;
a strip's loop then has three linear functions, one division and an exponential for each pixel.
"""

# mypy: ignore-errors
# (numba infers the types, by its own rules: arrays of float32, or of float64 for geometry, and of integers)

from __future__ import annotations

import math
from typing import Any, Optional, Tuple

import numba
import numpy as np
import torch
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from legs_adapters.cpu.surfels_oracle import CHANNELS, CUTOFF, FAR, FILTER_RADIUS, MIN_EXTENT
from legs_loss.kernels.compiling import compiled
from legs_loss.reference.conventions import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR, TILE
from legs_loss.reference.rasterizer.strips import exp2

# No promise that numbers are finite: a ray in the disc's plane meets it at infinity, and is masked after that.
CAREFUL = {"nsz", "contract"}
SUMMING = {"nsz", "contract", "reassoc"}

WIDE, TALL = 8, 16  # pixels: a strip of the image; its rows are one contiguous loop
PIXELS = WIDE * TALL
CHECK = 16  # discs between two looks at whether a strip is finished
FAINTEST = math.log(MIN_ALPHA) - 1e-3  # what is left out is fainter than MIN_ALPHA by more than rounding

# A splat, float64: p about the centre (constant, with i, with j; each three numbers), depth and centre, as used below.
P, DEPTH, CENTRE, SPLAT = 0, 9, 10, 12
# An entry, float32: p about the strip's origin, depth, centre, opacity, colour, normal, rows [first, end).
OPACITY, COLOUR, NORMAL, ROWS, FIELDS = 12, 13, 16, 19, 21
# An entry's gradient: of p's nine numbers, of the depth by division, of the centre, of w's three by the screen-space
# Gaussian's depth, of the logarithm of the opacity, of colour and normal.
G_DEPTH, G_CENTRE, G_DIRECT, G_OPACITY, G_COLOUR, G_NORMAL, GRADIENTS = 9, 10, 12, 15, 16, 19, 22

# Planes of a strip's state, PIXELS numbers each. T: transmittance, its sign turned once the pixel is finished.
X, Y, T = 0, PIXELS, 2 * PIXELS
# Forward: sums so far. M is minus NEAR FAR / ((FAR - NEAR) depth): the distortion's depth but for a constant, which
# falls out of its differences and would only cost digits.
RED, NX, D, M1, M2, SPREAD, MEDIAN, WHICH = (k * PIXELS for k in (3, 6, 9, 10, 11, 12, 13, 14))
ALPHA, Z = 15 * PIXELS, 16 * PIXELS  # what one loop leaves for the next
PLANES = 17
# Backward: the gradient of the pixel; E0 + m (E1 + m E2) is that of a weight by opacity, background and distortion;
# REST: the gradient's product with all that is still to come.
G_RED, G_NX, G_D, G_MEDIAN, E0, E1, E2, REST, MEDIAN_AT = (k * PIXELS for k in (3, 6, 9, 10, 11, 12, 13, 14, 15))
H, GZ, INV, U, V, R, ZB = (k * PIXELS for k in (16, 17, 18, 19, 20, 21, 22))
BACKWARD_PLANES = 23

_MAX, _MIN, _LAST, _NEAR = (np.float32(c) for c in (MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR))
_ZERO, _HALF, _ONE, _TWO = (np.float32(c) for c in (0, 0.5, 1, 2))
_LOG2 = np.float32(-0.5 / math.log(2))
_SCALE = np.float32(FAR * NEAR / (FAR - NEAR))
_AWAY = np.float32(-1e-30)


@compiled()
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled()
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled()
def _row(homographies, i, k):
    return homographies[i, k, 0], homographies[i, k, 1], homographies[i, k, 2]


@compiled()
def _less(a, b, factor):
    return a[0] - factor * b[0], a[1] - factor * b[1], a[2] - factor * b[2]


@compiled()
def _signed(a, b, cutoff):
    """The product of two rows under the signature (c^2, c^2, -1), whose null set is the circle of radius c."""
    return cutoff * cutoff * (a[0] * b[0] + a[1] * b[1]) - a[2] * b[2]


@compiled()
def _box(x, y, w, cutoff):
    """Centre and half extents of the ellipse's box; and the denominator, negative where the camera sees all of it."""
    determinant = _signed(w, w, cutoff)
    inverse = 1 / determinant
    u, v = _signed(x, w, cutoff) * inverse, _signed(y, w, cutoff) * inverse
    wide = math.sqrt(max(MIN_EXTENT, u * u - _signed(x, x, cutoff) * inverse))
    tall = math.sqrt(max(MIN_EXTENT, v * v - _signed(y, y, cutoff) * inverse))
    return u, v, wide, tall, determinant


@compiled()
def _floor(value):
    return np.int64(math.floor(max(min(value, 1e8), -1e8)))


@compiled()
def _tiles(centre, radius, count):
    first, end = _floor((centre - radius) / TILE), _floor((centre + radius + (TILE - 1)) / TILE)
    return min(max(first, 0), count), min(max(end, 0), count)


@compiled(fastmath=CAREFUL)
def prepare(homographies, normals, depths, opacities, width, height, splats, radii, boxes, slots):
    """Fill, for each disc: splat, radius, box (first strip across, row, end strip, end row), and how many strips."""
    for i in range(len(depths)):
        radii[i] = slots[i] = 0
        if not depths[i] > NEAR or (normals[i, 0] == 0 and normals[i, 1] == 0 and normals[i, 2] == 0):
            continue
        x, y, w = _row(homographies, i, 0), _row(homographies, i, 1), _row(homographies, i, 2)
        if _signed(w, w, CUTOFF) == 0:
            continue
        u, v, wide, tall, _ = _box(x, y, w, CUTOFF)
        radius = min(math.ceil(max(wide, tall, CUTOFF * FILTER_RADIUS)), float(1 << 20))
        left, right = _tiles(u, radius, -(-width // TILE))
        top, bottom = _tiles(v, radius, -(-height // TILE))
        if right <= left or bottom <= top:
            continue
        radii[i] = np.int32(radius)

        opacity = np.float64(opacities[i, 0])
        centred_x, centred_y = _less(x, w, u), _less(y, w, v)
        constant, along, down = _cross(centred_x, centred_y), _cross(centred_y, w), _cross(w, centred_x)
        determinant = _dot(w, constant)
        scale = w[2] / determinant
        if opacity < MIN_ALPHA or not abs(scale) < 1e30 or not abs(scale) > 0:
            continue
        x0, y0, x1, y1 = TILE * left, TILE * top, min(TILE * right, width), min(TILE * bottom, height)

        # Within the square's tiles, what the falloff may reach, on the disc or on the screen.
        level = 2 * (math.log(opacity) - FAINTEST)
        reach = math.sqrt(level / 2)
        centre_x, centre_y, wide, tall, sign = _box(x, y, w, math.sqrt(level))
        if sign < -1e-9 * w[2] * w[2]:
            x0 = max(x0, _floor(min(centre_x - wide, u - reach)))
            y0 = max(y0, _floor(min(centre_y - tall, v - reach)))
            x1 = min(x1, _floor(max(centre_x + wide, u + reach)) + 2)
            y1 = min(y1, _floor(max(centre_y + tall, v + reach)) + 2)
            if x1 <= x0 or y1 <= y0:
                continue
        for k in range(3):
            splats[i, P + k] = constant[k] * scale
            splats[i, P + 3 + k] = along[k] * scale
            splats[i, P + 6 + k] = down[k] * scale
        splats[i, DEPTH], splats[i, CENTRE], splats[i, CENTRE + 1] = w[2], u, v
        x0, x1 = x0 // WIDE, (x1 - 1) // WIDE + 1
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = x0, y0, x1, y1
        slots[i] = (x1 - x0) * ((y1 - 1) // TALL + 1 - y0 // TALL)


@compiled()
def count_entries(order, boxes, slots, across, ranges):
    """Fill where each strip's entries begin."""
    for i in order:
        if slots[i] == 0:
            continue
        for strip_y in range(boxes[i, 1] // TALL, (boxes[i, 3] - 1) // TALL + 1):
            for strip_x in range(boxes[i, 0], boxes[i, 2]):
                ranges[strip_y * across + strip_x + 1] += 1
    for strip in range(1, len(ranges)):
        ranges[strip] += ranges[strip - 1]


@compiled()
def _origin(strip_x, strip_y, first, end):
    """The pixel about which an entry is written: amid the rows that it reaches, rows counted from the strip's top."""
    return strip_x * WIDE + 0.5 * (WIDE - 1), strip_y * TALL + 0.5 * (first + end - 1)


@compiled()
def write_entries(order, splats, boxes, slots, first_slots, across, opacities, rgb, normals, ranges, entries, places):
    """Write the entries, by strip and in a strip by depth; `places`: the entry of each slot of each disc."""
    cursors = ranges.copy()
    for i in order:
        if slots[i] == 0:
            continue
        slot = first_slots[i]
        for strip_y in range(boxes[i, 1] // TALL, (boxes[i, 3] - 1) // TALL + 1):
            first, end = max(boxes[i, 1] - strip_y * TALL, 0), min(boxes[i, 3] - strip_y * TALL, TALL)
            for strip_x in range(boxes[i, 0], boxes[i, 2]):
                strip = strip_y * across + strip_x
                e = cursors[strip]
                cursors[strip] += 1
                places[slot] = e
                slot += 1
                x, y = _origin(strip_x, strip_y, first, end)
                x -= splats[i, CENTRE]
                y -= splats[i, CENTRE + 1]
                for k in range(3):
                    entries[e, k] = splats[i, k] + x * splats[i, 3 + k] + y * splats[i, 6 + k]
                    entries[e, 3 + k], entries[e, 6 + k] = splats[i, 3 + k], splats[i, 6 + k]
                    entries[e, COLOUR + k], entries[e, NORMAL + k] = rgb[i, k], normals[i, k]
                entries[e, DEPTH], entries[e, CENTRE], entries[e, CENTRE + 1] = splats[i, DEPTH], -x, -y
                entries[e, OPACITY], entries[e, ROWS], entries[e, ROWS + 1] = opacities[i, 0], first, end


@compiled()
def _place(state, across, down):
    """Pixel coordinates, full transmittance; pixels outside the image count as finished."""
    for pixel in range(PIXELS):
        x, y = pixel % WIDE, pixel // WIDE
        state[X + pixel], state[Y + pixel] = x - (WIDE - 1) / 2, y
        state[T + pixel] = _ONE if x < across and y < down else -_ONE


@compiled(fastmath=SUMMING)
def _unfinished(state):
    largest = -_ONE
    for pixel in range(PIXELS):
        largest = max(largest, state[T + pixel])
    return largest > _ZERO


@compiled(fastmath=CAREFUL)
def _blend(state, begin, end, entries):
    """Blend a strip's entries; returns the one after the last that mattered."""
    for k in range(begin, end):
        if (k - begin) % CHECK == 0 and not _unfinished(state):
            return k
        a0, a1, a2 = entries[k, 0], entries[k, 1], entries[k, 2]
        b0, b1, b2 = entries[k, 3], entries[k, 4], entries[k, 5]
        c0, c1, c2 = entries[k, 6], entries[k, 7], entries[k, 8]
        depth, u, v, opacity = entries[k, DEPTH], entries[k, CENTRE], entries[k, CENTRE + 1], entries[k, OPACITY]
        red, green, blue = entries[k, COLOUR], entries[k, COLOUR + 1], entries[k, COLOUR + 2]
        nx, ny, nz = entries[k, NORMAL], entries[k, NORMAL + 1], entries[k, NORMAL + 2]
        first, last = np.uint32(entries[k, ROWS]) & 31, np.uint32(entries[k, ROWS + 1]) & 31
        middle = (entries[k, ROWS] + entries[k, ROWS + 1] - _ONE) * _HALF
        which = np.float32(k - begin)
        for i in range(first * WIDE, last * WIDE):
            x, y = state[X + i], state[Y + i] - middle
            p = a2 + b2 * x + c2 * y
            p = p if p != _ZERO else _AWAY
            inverse = _ONE / p
            su, sv = (a0 + b0 * x + c0 * y) * inverse, (a1 + b1 * x + c1 * y) * inverse
            on_disc = su * su + sv * sv
            dx, dy = u - x, v - y
            on_screen = _TWO * (dx * dx + dy * dy)
            falloff = on_disc if on_disc <= on_screen else on_screen
            z = depth * inverse
            alpha = opacity * exp2(_LOG2 * falloff)
            alpha = alpha if alpha <= _MAX else _MAX
            alpha = alpha if alpha >= _MIN else _ZERO
            state[ALPHA + i] = alpha if z >= _NEAR else _ZERO
            state[Z + i] = z if z >= _NEAR else _ONE
        for i in range(first * WIDE, last * WIDE):
            alpha, before, z = state[ALPHA + i], state[T + i], state[Z + i]
            after = before - alpha * before
            drawn = after >= _LAST  # false for a finished pixel too, whose transmittance is negative
            weight = alpha * before if drawn else _ZERO
            state[T + i] = after if drawn else -abs(before)
            m = -_SCALE / z
            wm = weight * m
            first_sum, second_sum = state[M1 + i], state[M2 + i]
            state[SPREAD + i] += weight * second_sum + wm * (m * (_ONE - before) - _TWO * first_sum)
            state[M1 + i] = first_sum + wm
            state[M2 + i] = second_sum + wm * m
            state[D + i] += weight * z
            state[RED + i] += weight * red
            state[RED + PIXELS + i] += weight * green
            state[RED + 2 * PIXELS + i] += weight * blue
            state[NX + i] += weight * nx
            state[NX + PIXELS + i] += weight * ny
            state[NX + 2 * PIXELS + i] += weight * nz
            half = weight > _ZERO and before > _HALF
            state[MEDIAN + i] = z if half else state[MEDIAN + i]
            state[WHICH + i] = which if half else state[WHICH + i]
    return end


@compiled(fastmath=CAREFUL)
def _render_worker(worker, workers, strip_order, ranges, ends, entries, background, across, image, others, kept):
    state = np.empty(PLANES * PIXELS, np.float32)
    height, width = image.shape[1], image.shape[2]
    for turn in range(worker, len(strip_order), workers):
        strip = strip_order[turn]
        left, top = strip % across * WIDE, strip // across * TALL
        wide, tall = min(WIDE, width - left), min(TALL, height - top)
        _place(state, wide, tall)
        state[RED:] = 0
        state[WHICH : WHICH + PIXELS] = -1
        ends[strip] = _blend(state, ranges[strip], ranges[strip + 1], entries)
        for y in range(tall):
            for x in range(wide):
                i, v, u = y * WIDE + x, top + y, left + x
                left_over = abs(state[T + i])
                for channel in range(3):
                    image[channel, v, u] = state[RED + channel * PIXELS + i] + left_over * background[channel]
                    others[2 + channel, v, u] = state[NX + channel * PIXELS + i]
                others[0, v, u], others[1, v, u] = state[D + i], _ONE - left_over
                others[5, v, u], others[6, v, u] = state[MEDIAN + i], state[SPREAD + i]
                kept[0, v, u], kept[1, v, u], kept[2, v, u] = state[M1 + i], state[M2 + i], state[WHICH + i]


@compiled(parallel=True, fastmath=CAREFUL)
def render_strips(workers, strip_order, ranges, ends, entries, background, across, image, others, kept):
    """Fill the images; what the gradient needs of them; and for each strip the end of the entries that mattered."""
    for worker in prange(workers):
        _render_worker(worker, workers, strip_order, ranges, ends, entries, background, across, image, others, kept)


@compiled(fastmath=SUMMING)
def _blend_backward(state, begin, end, entries, gradients):
    """As `_blend`, front to back again, filling each entry's gradient.

    dL/dalpha = T own - rest / (1 - alpha): `own` is the gradient of this disc's weight, `rest` the sum of weight times
    own over those behind it: what is left of the whole pixel's sum after those before.
    """
    for k in range(begin, end):
        a0, a1, a2 = entries[k, 0], entries[k, 1], entries[k, 2]
        b0, b1, b2 = entries[k, 3], entries[k, 4], entries[k, 5]
        c0, c1, c2 = entries[k, 6], entries[k, 7], entries[k, 8]
        depth, u, v, opacity = entries[k, DEPTH], entries[k, CENTRE], entries[k, CENTRE + 1], entries[k, OPACITY]
        red, green, blue = entries[k, COLOUR], entries[k, COLOUR + 1], entries[k, COLOUR + 2]
        nx, ny, nz = entries[k, NORMAL], entries[k, NORMAL + 1], entries[k, NORMAL + 2]
        first, last = np.uint32(entries[k, ROWS]) & 31, np.uint32(entries[k, ROWS + 1]) & 31
        middle = (entries[k, ROWS] + entries[k, ROWS + 1] - _ONE) * _HALF
        which = np.float32(k - begin)
        for i in range(first * WIDE, last * WIDE):
            x, y = state[X + i], state[Y + i] - middle
            p = a2 + b2 * x + c2 * y
            p = p if p != _ZERO else _AWAY
            inverse = _ONE / p
            su, sv = (a0 + b0 * x + c0 * y) * inverse, (a1 + b1 * x + c1 * y) * inverse
            on_disc = su * su + sv * sv
            dx, dy = u - x, v - y
            on_screen = _TWO * (dx * dx + dy * dy)
            falloff = on_disc if on_disc <= on_screen else on_screen
            z = depth * inverse
            before_camera = z >= _NEAR
            state[H + i] = opacity * exp2(_LOG2 * falloff) if before_camera else _ZERO
            state[ZB + i] = z if before_camera else _ONE
            state[INV + i], state[U + i], state[V + i] = inverse, su, sv
            state[R + i] = on_disc - on_screen
        r = g = b = gnx = gny = gnz = go = _ZERO
        for i in range(first * WIDE, last * WIDE):
            response, before, z = state[H + i], state[T + i], state[ZB + i]
            alpha = response if response <= _MAX else _MAX
            alpha = alpha if alpha >= _MIN else _ZERO
            after = before - alpha * before
            drawn = after >= _LAST
            weight = alpha * before if drawn else _ZERO
            state[T + i] = after if drawn else -abs(before)
            m = -_SCALE / z
            g_red, g_green, g_blue = state[G_RED + i], state[G_RED + PIXELS + i], state[G_RED + 2 * PIXELS + i]
            g_nx, g_ny, g_nz = state[G_NX + i], state[G_NX + PIXELS + i], state[G_NX + 2 * PIXELS + i]
            e1, e2, g_depth = state[E1 + i], state[E2 + i], state[G_D + i]
            own = (g_red * red + g_green * green + g_blue * blue) + (g_nx * nx + g_ny * ny + g_nz * nz)
            own += g_depth * z + state[E0 + i] + m * (e1 + m * e2)
            rest = state[REST + i] - weight * own
            state[REST + i] = rest
            h = response * (before * own - rest / (_ONE - alpha))
            h = h if weight > _ZERO else _ZERO
            state[H + i] = h
            # dm/dz = -m/z
            gz = weight * (g_depth - (e1 + _TWO * m * e2) * m / z)
            state[GZ + i] = gz + (state[G_MEDIAN + i] if state[MEDIAN_AT + i] == which else _ZERO)
            state[INV + i] = state[INV + i] if weight > _ZERO else _ZERO
            state[U + i] = state[U + i] if weight > _ZERO else _ZERO
            state[V + i] = state[V + i] if weight > _ZERO else _ZERO
            go += h
            r += weight * g_red
            g += weight * g_green
            b += weight * g_blue
            gnx += weight * g_nx
            gny += weight * g_ny
            gnz += weight * g_nz
        gradients[k, G_OPACITY] = go
        gradients[k, G_COLOUR], gradients[k, G_COLOUR + 1], gradients[k, G_COLOUR + 2] = r, g, b
        gradients[k, G_NORMAL], gradients[k, G_NORMAL + 1], gradients[k, G_NORMAL + 2] = gnx, gny, gnz

        q0 = q1 = q2 = x0 = x1 = x2 = y0 = y1 = y2 = gd = _ZERO
        for i in range(first * WIDE, last * WIDE):
            x, y = state[X + i], state[Y + i] - middle
            disc = state[R + i] <= _ZERO
            inverse, su, sv = state[INV + i], state[U + i], state[V + i]
            h = state[H + i] if disc else _ZERO
            gz = state[GZ + i] if disc else _ZERO
            h, gz = h * inverse, gz * inverse
            p0, p1 = -h * su, -h * sv
            p2 = h * (su * su + sv * sv) - gz * state[ZB + i]
            q0 += p0
            q1 += p1
            q2 += p2
            x0 += p0 * x
            x1 += p1 * x
            x2 += p2 * x
            y0 += p0 * y
            y1 += p1 * y
            y2 += p2 * y
            gd += gz
        gradients[k, 0], gradients[k, 1], gradients[k, 2] = q0, q1, q2
        gradients[k, 3], gradients[k, 4], gradients[k, 5] = x0, x1, x2
        gradients[k, 6], gradients[k, 7], gradients[k, 8] = y0, y1, y2
        gradients[k, G_DEPTH] = gd

        gu = gv = w0 = w1 = w2 = _ZERO
        for i in range(first * WIDE, last * WIDE):
            x, y = state[X + i], state[Y + i] - middle
            screen = state[R + i] > _ZERO
            h = state[H + i] if screen else _ZERO
            gz = state[GZ + i] if screen else _ZERO
            gu += h * (x - u)
            gv += h * (y - v)
            w0 += gz * state[U + i]
            w1 += gz * state[V + i]
            w2 += gz
        gradients[k, G_CENTRE], gradients[k, G_CENTRE + 1] = _TWO * gu, _TWO * gv
        gradients[k, G_DIRECT], gradients[k, G_DIRECT + 1], gradients[k, G_DIRECT + 2] = w0, w1, w2


@compiled(fastmath=CAREFUL)
def _render_backward_worker(
    worker, workers, strip_order, ranges, ends, entries, background, across, image, others, kept, g_image, g_others,
    gradients,
):  # fmt: skip
    state = np.empty(BACKWARD_PLANES * PIXELS, np.float32)
    height, width = image.shape[1], image.shape[2]
    for turn in range(worker, len(strip_order), workers):
        strip = strip_order[turn]
        left, top = strip % across * WIDE, strip // across * TALL
        wide, tall = min(WIDE, width - left), min(TALL, height - top)
        _place(state, wide, tall)
        state[G_RED:] = 0
        state[MEDIAN_AT : MEDIAN_AT + PIXELS] = -1
        for y in range(tall):
            for x in range(wide):
                i, v, u = y * WIDE + x, top + y, left + x
                if others[1, v, u] == _ZERO:
                    continue  # no disc to tell; 2DGS divides by this alpha, so that the gradient may be NaN here
                constant, rest = g_others[1, v, u], _ZERO
                for channel in range(3):
                    gradient = g_image[channel, v, u]
                    state[G_RED + channel * PIXELS + i] = gradient
                    state[G_NX + channel * PIXELS + i] = g_others[2 + channel, v, u]
                    constant -= gradient * background[channel]
                    rest += gradient * (image[channel, v, u] - background[channel])
                    rest += g_others[2 + channel, v, u] * others[2 + channel, v, u]
                spread, alpha = g_others[6, v, u], others[1, v, u]
                state[G_D + i], state[G_MEDIAN + i] = g_others[0, v, u], g_others[5, v, u]
                state[E0 + i] = constant + spread * kept[1, v, u]
                state[E1 + i], state[E2 + i] = -_TWO * spread * kept[0, v, u], spread * alpha
                state[MEDIAN_AT + i] = kept[2, v, u]
                rest += g_others[0, v, u] * others[0, v, u] + g_others[1, v, u] * alpha
                state[REST + i] = rest + _TWO * spread * others[6, v, u]
        _blend_backward(state, ranges[strip], ends[strip], entries, gradients)
        gradients[ends[strip] : ranges[strip + 1]] = 0


@compiled(parallel=True, fastmath=CAREFUL)
def render_strips_backward(
    workers, strip_order, ranges, ends, entries, background, across, image, others, kept, g_image, g_others, gradients
):
    """Fill the gradient of every entry."""
    for worker in prange(workers):
        _render_backward_worker(
            worker, workers, strip_order, ranges, ends, entries, background, across, image, others, kept, g_image,
            g_others, gradients,
        )  # fmt: skip


@compiled()
def _collect(i, splats, boxes, places, slot, gradients, sums):
    """Sum a disc's gradients over its entries, in a fixed order, with p's about its centre."""
    sums[:] = 0
    for strip_y in range(boxes[i, 1] // TALL, (boxes[i, 3] - 1) // TALL + 1):
        first, end = max(boxes[i, 1] - strip_y * TALL, 0), min(boxes[i, 3] - strip_y * TALL, TALL)
        for strip_x in range(boxes[i, 0], boxes[i, 2]):
            e = places[slot]
            slot += 1
            x, y = _origin(strip_x, strip_y, first, end)
            x -= splats[i, CENTRE]
            y -= splats[i, CENTRE + 1]
            for k in range(GRADIENTS):
                sums[k] += gradients[e, k]
            for k in range(3):
                sums[3 + k] += x * gradients[e, k]
                sums[6 + k] += y * gradients[e, k]


@compiled()
def _add(gradient, i, k, vector):
    for j in range(3):
        gradient[i, k, j] += vector[j]


@compiled()
def _box_gradient(x, y, w, gu, gv):
    """Gradients of the rows, from those of the box's centre at CUTOFF."""
    inverse = 1 / _signed(w, w, CUTOFF)
    u, v = _signed(x, w, CUTOFF) * inverse, _signed(y, w, CUTOFF) * inverse
    sx, sy, sz = CUTOFF * CUTOFF * inverse, CUTOFF * CUTOFF * inverse, -inverse
    back = 2 * (gu * u + gv * v)
    return (
        (gu * sx * w[0], gu * sy * w[1], gu * sz * w[2]),
        (gv * sx * w[0], gv * sy * w[1], gv * sz * w[2]),
        (
            sx * (gu * x[0] + gv * y[0] - back * w[0]),
            sy * (gu * x[1] + gv * y[1] - back * w[1]),
            sz * (gu * x[2] + gv * y[2] - back * w[2]),
        ),
    )


@compiled()
def spread_gradients(
    homographies, opacities, splats, boxes, slots, first_slots, places, gradients, half, whole_tap,
    g_homographies, g_normals, g_opacities, g_rgb, g_viewspace,
):  # fmt: skip
    """From the entries' gradients to each disc's."""
    sums = np.empty(GRADIENTS, np.float64)
    for i in range(len(slots)):
        g_homographies[i] = 0
        g_normals[i] = 0
        g_opacities[i] = 0
        g_rgb[i] = 0
        g_viewspace[i] = 0
        if slots[i] == 0:
            continue
        _collect(i, splats, boxes, places, first_slots[i], gradients, sums)
        x, y, w = _row(homographies, i, 0), _row(homographies, i, 1), _row(homographies, i, 2)
        u, v = splats[i, CENTRE], splats[i, CENTRE + 1]
        centred_x, centred_y = _less(x, w, u), _less(y, w, v)
        constant, along, down = _cross(centred_x, centred_y), _cross(centred_y, w), _cross(w, centred_x)
        scale = w[2] / _dot(w, constant)
        ga = sums[0] * scale, sums[1] * scale, sums[2] * scale
        gb = sums[3] * scale, sums[4] * scale, sums[5] * scale
        gc = sums[6] * scale, sums[7] * scale, sums[8] * scale
        gd = sums[G_DEPTH] * scale  # to det T
        one, two = _cross(centred_y, ga), _cross(gc, w)
        three, four = _cross(ga, centred_x), _cross(w, gb)
        five, six = _cross(gb, centred_y), _cross(centred_x, gc)
        for k in range(3):
            gx = one[k] + two[k] + gd * along[k]
            gy = three[k] + four[k] + gd * down[k]
            gw = five[k] + six[k] + gd * constant[k] + sums[G_DIRECT + k] - u * gx - v * gy
            g_homographies[i, 0, k], g_homographies[i, 1, k], g_homographies[i, 2, k] = gx, gy, gw
            g_normals[i, k], g_rgb[i, k] = sums[G_NORMAL + k], sums[G_COLOUR + k]
        g_opacities[i, 0] = sums[G_OPACITY] / opacities[i, 0]
        from_x, from_y, from_w = _box_gradient(x, y, w, sums[G_CENTRE], sums[G_CENTRE + 1])
        if not whole_tap:
            g_viewspace[i, 0] = g_homographies[i, 0, 2] * w[2] * half[0]
            g_viewspace[i, 1] = g_homographies[i, 1, 2] * w[2] * half[1]
        _add(g_homographies, i, 0, from_x)
        _add(g_homographies, i, 1, from_y)
        _add(g_homographies, i, 2, from_w)
        if whole_tap:
            g_viewspace[i, 0] = g_homographies[i, 0, 2] * w[2] * half[0]
            g_viewspace[i, 1] = g_homographies[i, 1, 2] * w[2] * half[1]


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        homographies: Tensor,
        normals: Tensor,
        opacities: Tensor,
        rgb: Tensor,
        viewspace: Optional[Tensor],
        depths: Tensor,
        background: Tensor,
        size: Tuple[int, int],
        whole_tap: bool,
    ) -> Tuple[Tensor, Tensor, Tensor]:
        (width, height), count, workers = size, len(depths), numba.get_num_threads()
        inputs = _array(homographies), _array(normals), _array(opacities), _array(rgb)
        splats, boxes = np.empty((count, SPLAT)), np.empty((count, 4), np.int64)
        radii, slots = np.empty(count, np.int32), np.empty(count, np.int64)
        prepare(inputs[0], inputs[1], _array(depths), inputs[2], width, height, splats, radii, boxes, slots)

        # A slot is a strip in a disc's box of strips; an entry is the same, sorted by strip and depth.
        order = np.argsort(_array(depths).astype(np.float32), kind="stable")
        first_slots, total = np.cumsum(slots) - slots, int(slots.sum())
        across, down = -(-width // WIDE), -(-height // TALL)
        ranges = np.zeros(across * down + 1, np.int64)
        count_entries(order, boxes, slots, across, ranges)
        entries, places = np.empty((total, FIELDS), np.float32), np.empty(total, np.int64)
        write_entries(
            order, splats, boxes, slots, first_slots, across, inputs[2], inputs[3], inputs[1], ranges, entries, places
        )

        image, others = torch.empty(3, height, width), torch.empty(CHANNELS, height, width)
        kept, ends = np.empty((3, height, width), np.float32), np.empty(across * down, np.int64)
        strip_order = np.argsort(-np.diff(ranges), kind="stable")  # the fullest first, dealt out to the workers in turn
        work = (strip_order, ranges, ends, entries, _array(background), across)
        render_strips(workers, *work, image.numpy(), others.numpy(), kept)

        radii_tensor = torch.from_numpy(radii)
        ctx.mark_non_differentiable(radii_tensor)
        ctx.save_for_backward(homographies, normals, opacities, rgb, image, others)
        ctx.state = (splats, boxes, slots, first_slots, places), work, kept, whole_tap
        return image, others, radii_tensor

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_image: Tensor, g_others: Tensor, _: Any) -> Tuple[Optional[Tensor], ...]:
        homographies, normals, opacities, rgb, image, others = ctx.saved_tensors
        discs, work, kept, whole_tap = ctx.state
        entries = work[3]
        gradients = np.empty((len(entries), GRADIENTS), np.float32)
        images = (_array(image), _array(others), kept, _array(g_image), _array(g_others))
        render_strips_backward(numba.get_num_threads(), *work, *images, gradients)
        results = [torch.empty_like(tensor) for tensor in (homographies, normals, opacities, rgb)]
        results.append(torch.empty(len(normals), 3))
        height, width = image.shape[1:]
        half = np.array([width / 2, height / 2])
        spread_gradients(
            _array(homographies), _array(opacities), *discs, gradients, half, whole_tap, *[r.numpy() for r in results]
        )
        viewspace = results.pop() if ctx.needs_input_grad[4] else None
        return (*results[:4], viewspace, None, None, None, None)


def render(
    homography: Tensor,
    normals: Tensor,
    depths: Tensor,
    opacities: Tensor,
    rgb: Tensor,
    viewspace: Optional[Tensor],
    background: Tensor,
    width: int,
    height: int,
    whole_tap: bool,
) -> Tuple[Tensor, Tensor, Tensor]:
    """Image [3, H, W], the other channels [7, H, W] and radii [N]; arguments as `surfels.rasterize` makes them."""
    return _Render.apply(homography, normals, opacities, rgb, viewspace, depths, background, (width, height), whole_tap)
