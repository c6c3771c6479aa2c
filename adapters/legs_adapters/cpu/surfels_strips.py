"""The surfel rasterizer's work for each strip of the image: blending the discs that reach it, both ways.

A strip's loop has three linear functions of the pixel, one division and an exponential (see surfels_projection.py).
As in the reference's strips.py, the rows that a disc reaches are one contiguous loop, and all of a strip's state is one
array, so that the compiler takes eight pixels at a time.
"""

# mypy: ignore-errors
# (numba infers the types, by its own rules: arrays of float32, or of float64 for geometry, and of integers)

from __future__ import annotations

import math

import numpy as np
from numba import prange

from legs_adapters.cpu.surfels_oracle import FAR
from legs_adapters.cpu.surfels_projection import (
    CAREFUL,
    CENTRE,
    COLOUR,
    DEPTH,
    G_CENTRE,
    G_COLOUR,
    G_DEPTH,
    G_DIRECT,
    G_NORMAL,
    G_OPACITY,
    NORMAL,
    OPACITY,
    TALL,
    WIDE,
    origin,
)
from legs_loss.kernels.compiling import compiled
from legs_loss.reference.conventions import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR
from legs_loss.reference.rasterizer.intrinsics import prefetch
from legs_loss.reference.rasterizer.strips import exp2

SUMMING = CAREFUL | {"reassoc"}

PIXELS = WIDE * TALL
AHEAD = 16  # entries whose memory is asked for while another is worked on
CHECK = 16  # discs between two looks at whether a strip is finished
FIELDS = 19  # of an entry, float32: as of a splat, with p about the strip's origin, and its centre from there

# Planes of a strip's state, PIXELS numbers each. T: transmittance, its sign turned once the pixel is finished.
X, Y, T = 0, PIXELS, 2 * PIXELS
# Forward: sums so far. M is minus NEAR FAR / ((FAR - NEAR) depth): the distortion's depth but for a constant, which
# falls out of its differences and would only cost digits. It is linear in the pixel, as 1 / depth is.
RED, NX, D, M1, M2, SPREAD, MEDIAN, WHICH = (k * PIXELS for k in (3, 6, 9, 10, 11, 12, 13, 14))
ALPHA, Z, M = (k * PIXELS for k in (15, 16, 17))  # what one loop leaves for the next
PLANES = 18
# Backward: the gradient of the pixel; E0 + m (E1 + m E2) is that of a weight by opacity, background and distortion;
# REST: the gradient's product with all that is still to come. Without gradients to the other channels, only the first
# and the last two lines.
G_RED, E0, REST = (k * PIXELS for k in (3, 6, 7))
G_NX, G_D, G_MEDIAN, E1, E2, MEDIAN_AT = (k * PIXELS for k in (8, 11, 12, 13, 14, 15))
GZ, ZB, MB = (k * PIXELS for k in (16, 17, 18))
H, INV, U, V, R = (k * PIXELS for k in (19, 20, 21, 22, 23))
BACKWARD_PLANES = 24

_MAX, _MIN, _LAST, _NEAR = (np.float32(c) for c in (MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR))
_ZERO, _HALF, _ONE, _TWO = (np.float32(c) for c in (0, 0.5, 1, 2))
_LOG2 = np.float32(-0.5 / math.log(2))
_SCALE = np.float32(FAR * NEAR / (FAR - NEAR))
_BACK = np.float32(1 / _SCALE)
_AWAY = np.float32(-1e-30)


@compiled()
def _expand(begin, end, strip_x, strip_y, splats, owners, rows, entries):
    """Write a strip's entries."""
    for e in range(np.uint64(begin), np.uint64(end)):
        prefetch(splats, owners[min(np.int64(e) + AHEAD, len(owners) - 1)])
        i = np.uint64(owners[e])
        x, y = origin(strip_x, strip_y, rows[e])
        x -= splats[i, CENTRE]
        y -= splats[i, CENTRE + 1]
        for k in range(3):
            entries[e, k] = splats[i, k] + x * splats[i, 3 + k] + y * splats[i, 6 + k]
        for k in range(3, FIELDS):
            entries[e, k] = splats[i, k]
        entries[e, CENTRE], entries[e, CENTRE + 1] = -x, -y


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
def _blend(state, start, begin, end, rows, entries):
    """Blend entries of a strip, whose first is `start`, in their order."""
    for k in range(begin, end):
        a0, a1, a2 = entries[k, 0], entries[k, 1], entries[k, 2]
        b0, b1, b2 = entries[k, 3], entries[k, 4], entries[k, 5]
        c0, c1, c2 = entries[k, 6], entries[k, 7], entries[k, 8]
        depth, u, v, opacity = entries[k, DEPTH], entries[k, CENTRE], entries[k, CENTRE + 1], entries[k, OPACITY]
        red, green, blue = entries[k, COLOUR], entries[k, COLOUR + 1], entries[k, COLOUR + 2]
        nx, ny, nz = entries[k, NORMAL], entries[k, NORMAL + 1], entries[k, NORMAL + 2]
        first, last = np.uint32(rows[k]) & 63, np.uint32(rows[k] >> 8) & 63
        middle = (np.float32(first) + np.float32(last) - _ONE) * _HALF
        which, flat = np.float32(k - start), -_SCALE / depth
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
            met = z >= _NEAR
            state[ALPHA + i] = alpha if met else _ZERO
            state[Z + i], state[M + i] = z if met else _ZERO, flat * p if met else _ZERO
        for i in range(first * WIDE, last * WIDE):
            alpha, before, z, m = state[ALPHA + i], state[T + i], state[Z + i], state[M + i]
            after = before - alpha * before
            drawn = after >= _LAST  # false for a finished pixel too, whose transmittance is negative
            weight = alpha * before if drawn else _ZERO
            state[T + i] = after if drawn else -abs(before)
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
            half = (weight > _ZERO) & (before > _HALF)
            state[MEDIAN + i] = z if half else state[MEDIAN + i]
            state[WHICH + i] = which if half else state[WHICH + i]


@compiled(fastmath=CAREFUL)
def _render_worker(
    worker, workers, strip_order, ranges, splats, owners, rows, entries, ends, background, across, image, others, kept
):
    state = np.empty(PLANES * PIXELS, np.float32)
    height, width = image.shape[1], image.shape[2]
    for turn in range(worker, len(strip_order), workers):
        strip = strip_order[turn]
        left, top = strip % across * WIDE, strip // across * TALL
        wide, tall = min(WIDE, width - left), min(TALL, height - top)
        _place(state, wide, tall)
        state[RED:] = 0
        state[WHICH : WHICH + PIXELS] = -1
        end = ranges[strip]
        while end < ranges[strip + 1] and _unfinished(state):
            begin, end = end, min(end + CHECK, ranges[strip + 1])
            _expand(begin, end, strip % across, strip // across, splats, owners, rows, entries)
            _blend(state, ranges[strip], begin, end, rows, entries)
        ends[strip] = end
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
def render(
    workers, strip_order, ranges, splats, owners, rows, entries, ends, background, across, image, others, kept
):  # fmt: skip
    """Fill the images; what the gradient needs of them; the entries, and in each strip the end of those that matter."""
    for worker in prange(workers):
        _render_worker(
            worker, workers, strip_order, ranges, splats, owners, rows, entries, ends, background, across, image,
            others, kept,
        )  # fmt: skip


@compiled(fastmath=SUMMING)
def _blend_backward(state, begin, end, rows, entries, g_others, gradients):
    """As `_blend`, front to back again, filling each entry's gradient; `g_others` is None where there is none.

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
        first, last = np.uint32(rows[k]) & 63, np.uint32(rows[k] >> 8) & 63
        middle = (np.float32(first) + np.float32(last) - _ONE) * _HALF
        which, flat = np.float32(k - begin), -_SCALE / depth
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
            response = opacity * exp2(_LOG2 * falloff)
            met = (z >= _NEAR) & (response >= _MIN)
            state[H + i] = response if met else _ZERO
            state[INV + i] = inverse if met else _ZERO
            state[U + i], state[V + i] = su if met else _ZERO, sv if met else _ZERO
            state[R + i] = on_disc - on_screen
            if g_others is not None:
                state[ZB + i], state[MB + i] = z if met else _ZERO, flat * p if met else _ZERO
        r = g = b = gnx = gny = gnz = go = _ZERO
        for i in range(first * WIDE, last * WIDE):
            response, before = state[H + i], state[T + i]
            alpha = response if response <= _MAX else _MAX
            after = before - alpha * before
            drawn = after >= _LAST
            weight = alpha * before if drawn else _ZERO
            state[T + i] = after if drawn else -abs(before)
            g_red, g_green, g_blue = state[G_RED + i], state[G_RED + PIXELS + i], state[G_RED + 2 * PIXELS + i]
            own = g_red * red + g_green * green + g_blue * blue + state[E0 + i]
            if g_others is not None:
                z, m = state[ZB + i], state[MB + i]
                g_nx, g_ny, g_nz = state[G_NX + i], state[G_NX + PIXELS + i], state[G_NX + 2 * PIXELS + i]
                e1, e2, g_depth = state[E1 + i], state[E2 + i], state[G_D + i]
                own += (g_nx * nx + g_ny * ny + g_nz * nz) + g_depth * z + m * (e1 + m * e2)
                # dm/dz = -m/z = m^2 / _SCALE
                gz = weight * (g_depth + (e1 + _TWO * m * e2) * m * m * _BACK)
                state[GZ + i] = gz + (state[G_MEDIAN + i] if state[MEDIAN_AT + i] == which else _ZERO)
                gnx += weight * g_nx
                gny += weight * g_ny
                gnz += weight * g_nz
            rest = state[REST + i] - weight * own
            state[REST + i] = rest
            h = response * (before * own - rest / (_ONE - alpha))
            h = h if weight > _ZERO else _ZERO
            state[H + i] = h
            go += h
            r += weight * g_red
            g += weight * g_green
            b += weight * g_blue
        gradients[k, G_OPACITY] = go
        gradients[k, G_COLOUR], gradients[k, G_COLOUR + 1], gradients[k, G_COLOUR + 2] = r, g, b
        gradients[k, G_NORMAL], gradients[k, G_NORMAL + 1], gradients[k, G_NORMAL + 2] = gnx, gny, gnz

        q0 = q1 = q2 = x0 = x1 = x2 = y0 = y1 = y2 = gd = gu = gv = w0 = w1 = w2 = _ZERO
        for i in range(first * WIDE, last * WIDE):
            x, y = state[X + i], state[Y + i] - middle
            disc = state[R + i] <= _ZERO
            inverse, su, sv = state[INV + i], state[U + i], state[V + i]
            h = state[H + i] * inverse if disc else _ZERO
            p0, p1 = -h * su, -h * sv
            p2 = h * (su * su + sv * sv)
            if g_others is not None:
                gz = state[GZ + i] * inverse if disc else _ZERO
                p2 -= gz * state[ZB + i]
                gd += gz
            q0 += p0
            q1 += p1
            q2 += p2
            x0 += p0 * x
            x1 += p1 * x
            x2 += p2 * x
            y0 += p0 * y
            y1 += p1 * y
            y2 += p2 * y
        gradients[k, 0], gradients[k, 1], gradients[k, 2] = q0, q1, q2
        gradients[k, 3], gradients[k, 4], gradients[k, 5] = x0, x1, x2
        gradients[k, 6], gradients[k, 7], gradients[k, 8] = y0, y1, y2
        gradients[k, G_DEPTH] = gd
        for i in range(first * WIDE, last * WIDE):
            x, y = state[X + i], state[Y + i] - middle
            screen = state[R + i] > _ZERO
            h = state[H + i] if screen else _ZERO
            gu += h * (x - u)
            gv += h * (y - v)
            if g_others is not None:
                gz = state[GZ + i] if screen else _ZERO
                w0 += gz * state[U + i]
                w1 += gz * state[V + i]
                w2 += gz
        gradients[k, G_CENTRE], gradients[k, G_CENTRE + 1] = _TWO * gu, _TWO * gv
        gradients[k, G_DIRECT], gradients[k, G_DIRECT + 1], gradients[k, G_DIRECT + 2] = w0, w1, w2


@compiled(fastmath=CAREFUL)
def _render_backward_worker(
    worker, workers, strip_order, ranges, rows, entries, ends, background, across, image, others, kept, g_image,
    g_others, gradients,
):  # fmt: skip
    state = np.empty(BACKWARD_PLANES * PIXELS, np.float32)
    height, width = image.shape[1], image.shape[2]
    for turn in range(worker, len(strip_order), workers):
        strip = strip_order[turn]
        left, top = strip % across * WIDE, strip // across * TALL
        wide, tall = min(WIDE, width - left), min(TALL, height - top)
        _place(state, wide, tall)
        state[G_RED:GZ] = 0
        state[MEDIAN_AT : MEDIAN_AT + PIXELS] = -1
        for y in range(tall):
            for x in range(wide):
                i, v, u = y * WIDE + x, top + y, left + x
                if others[1, v, u] == _ZERO:
                    continue  # no disc to tell; 2DGS divides by this alpha, so that the gradient may be NaN here
                constant = rest = _ZERO
                for channel in range(3):
                    gradient = g_image[channel, v, u]
                    state[G_RED + channel * PIXELS + i] = gradient
                    constant -= gradient * background[channel]
                    rest += gradient * (image[channel, v, u] - background[channel])
                if g_others is not None:
                    spread, alpha = g_others[6, v, u], others[1, v, u]
                    for channel in range(3):
                        state[G_NX + channel * PIXELS + i] = g_others[2 + channel, v, u]
                        rest += g_others[2 + channel, v, u] * others[2 + channel, v, u]
                    state[G_D + i], state[G_MEDIAN + i] = g_others[0, v, u], g_others[5, v, u]
                    state[E1 + i], state[E2 + i] = -_TWO * spread * kept[0, v, u], spread * alpha
                    state[MEDIAN_AT + i] = kept[2, v, u]
                    constant += g_others[1, v, u] + spread * kept[1, v, u]
                    rest += g_others[0, v, u] * others[0, v, u] + g_others[1, v, u] * alpha
                    rest += _TWO * spread * others[6, v, u]
                state[E0 + i], state[REST + i] = constant, rest
        _blend_backward(state, ranges[strip], ends[strip], rows, entries, g_others, gradients)
        gradients[ends[strip] : ranges[strip + 1]] = 0


@compiled(parallel=True, fastmath=CAREFUL)
def render_backward(
    workers, strip_order, ranges, rows, entries, ends, background, across, image, others, kept, g_image, g_others,
    gradients,
):  # fmt: skip
    """Fill the gradient of every entry; `g_others` may be None."""
    for worker in prange(workers):
        _render_backward_worker(
            worker, workers, strip_order, ranges, rows, entries, ends, background, across, image, others, kept, g_image,
            g_others, gradients,
        )  # fmt: skip


@compiled(fastmath=CAREFUL)
def matters(g_others, others):
    """Whether a gradient to the other channels says anything where a disc is drawn."""
    for v in range(g_others.shape[1]):
        for u in range(g_others.shape[2]):
            if others[1, v, u] != _ZERO:
                for channel in range(len(g_others)):
                    if g_others[channel, v, u] != _ZERO:
                        return True
    return False
