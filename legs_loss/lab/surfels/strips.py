"""Blend the discs that reach each strip of the image, forward and backward.

A pixel takes three linear functions of its place, a division and an exponential (see projection.py). As in the
rasterizer's strips.py, a row of a strip fills one register, and all of a strip's state is one array.
"""

# mypy: ignore-errors
# (numba infers the types, by its own rules: arrays of float32, or of float64 for geometry, and of integers)

from __future__ import annotations

import math

import numpy as np

from legs_loss.kernels.compiling import claimed, compiled, inlined, part
from legs_loss.lab.conventions import MAX_ALPHA, MIN_ALPHA, NEAR
from legs_loss.lab.rasterizer.projection import WIDE, origin
from legs_loss.lab.rasterizer.sorting import OWNER, ROWS, SUM
from legs_loss.lab.rasterizer.strips import AHEAD, CHECK, cover, exp2, place, reach, unfinished
from legs_loss.lab.simd.arithmetic import above, at_least, equal, maximum, minimum, multiply_add, splat, where
from legs_loss.lab.simd.lanes import totals
from legs_loss.lab.simd.memory import load, prefetch, store
from legs_loss.lab.surfels.model import FAR
from legs_loss.lab.surfels.projection import CAREFUL, CENTRE, COLOUR, NORMAL, OPACITY, SPLAT, TALL
from legs_loss.lab.surfels.projection_backward import GRADIENTS

PIXELS = WIDE * TALL
FIELDS = SPLAT  # of an entry, float32: as of a splat, with p about the strip's origin, and its centre from there

# A strip's state, but for X in planes of PIXELS numbers. T: transmittance, its sign turned once the pixel is finished.
X, T = 0, WIDE  # X: one row, its pixels' x
# What one loop leaves for the next: a disc's response, depth and m = 1 / depth. Backward also where on the disc it is
# met, by how much that falloff exceeds the screen's, and in the place of m the gradient to the depth.
RESPONSE, Z, M, U, V, EXCESS = (WIDE + k * PIXELS for k in (1, 2, 3, 4, 5, 6))
G_Z = M
# Forward: sums so far. The distortion's depth is -_SCALE m but for a constant, which falls out of its differences and
# would only cost digits. WHICH: the entry that the median depth is of, counted from 1.
RED, NX, D, M1, M2, SPREAD, MEDIAN, WHICH = (WIDE + k * PIXELS for k in (4, 7, 10, 11, 12, 13, 14, 15))
STATE = WIDE + 16 * PIXELS
# Backward: the gradient of the pixel; E0 + m (E1 + m E2) is that of a weight by opacity, background and distortion;
# REST: the gradient's product with all that is still to come. Without gradients to the other channels, only these.
G_RED, E0, REST = (WIDE + k * PIXELS for k in (7, 10, 11))
G_NX, G_D, G_MEDIAN, E1, E2, MEDIAN_AT = (WIDE + k * PIXELS for k in (12, 15, 16, 17, 18, 19))
BACKWARD_STATE = WIDE + 20 * PIXELS

_MAX, _MIN, _NEAR = (np.float32(c) for c in (MAX_ALPHA, MIN_ALPHA, NEAR))
_FARTHEST = np.float32(1e18)  # further away, a ray is parallel to the disc; of a number like this, the square is finite
_ZERO, _HALF, _ONE, _TWO = (np.float32(c) for c in (0, 0.5, 1, 2))
_LOG2 = np.float32(-0.5 / math.log(2))
_SCALE = np.float32(FAR * NEAR / (FAR - NEAR))


@part()
def _expand(begin, end, strip_x, strip_y, splats, draws, entries):
    """Write a strip's entries."""
    for e in range(np.uint64(begin), np.uint64(end)):
        prefetch(splats, draws[min(np.int64(e) + AHEAD, len(draws) - 1), OWNER])
        i = np.uint64(draws[e, OWNER])
        x, y = origin(strip_x * WIDE, strip_y * TALL, draws[e, ROWS])
        x -= splats[i, CENTRE]
        y -= splats[i, CENTRE + 1]
        for k in range(3):
            entries[e, k] = splats[i, k] + x * splats[i, 3 + k] + y * splats[i, 6 + k]
        for k in range(3, FIELDS):
            entries[e, k] = splats[i, k]
        entries[e, CENTRE], entries[e, CENTRE + 1] = -x, -y


@inlined
def _linear(entries, k, number, xs):
    """Return one of p's three numbers: at the pixels of the middle row, and what it gains with each row."""
    across, down = splat(entries[k, 3 + number]), splat(entries[k, 6 + number])
    return multiply_add(across, xs, splat(entries[k, number])), down


@inlined
def _meet(state, first, last, ys, entries, k, others, backward):
    """Leave an entry's response, not yet held at its most, and where it is met; nothing where it is not."""
    xs, none = load(state, X), splat(_ZERO)
    pu, pu_down = _linear(entries, k, 0, xs)
    pv, pv_down = _linear(entries, k, 1, xs)
    pz, pz_down = _linear(entries, k, 2, xs)
    dx, v, opacity = xs - splat(entries[k, CENTRE]), splat(entries[k, CENTRE + 1]), splat(entries[k, OPACITY])
    across = (dx + dx) * dx
    for i in range(first * WIDE, last * WIDE, WIDE):
        m = multiply_add(pz_down, ys, pz)
        z = splat(_ONE) / m
        su, sv, dy = multiply_add(pu_down, ys, pu) * z, multiply_add(pv_down, ys, pv) * z, ys - v
        on_disc, on_screen = multiply_add(su, su, sv * sv), multiply_add(dy + dy, dy, across)
        response = exp2(multiply_add(splat(_LOG2), minimum(on_disc, on_screen), opacity))  # the screen's, if one is NaN
        met = at_least(z, splat(_NEAR)) & at_least(splat(_FARTHEST), z) & at_least(response, splat(_MIN))
        store(state, RESPONSE + i, where(met, response, none))
        store(state, Z + i, where(met, z, none))
        if others:
            store(state, M + i, where(met, m, none))
        if backward:
            store(state, U + i, where(met, su, none))
            store(state, V + i, where(met, sv, none))
            store(state, EXCESS + i, on_disc - on_screen)
        ys = ys + splat(_ONE)


@inlined
def _add(state, i, weight, value):
    """Add to a row of a sum."""
    store(state, i, multiply_add(weight, value, load(state, i)))


@inlined
def _add_sums(sums, at, values):
    """Add to eight sums side by side."""
    store(sums, at, load(sums, at) + values)


@part(fastmath=CAREFUL)
def _blend(state, start, begin, end, draws, entries):
    """Blend entries of a strip, whose first is `start`, in their order."""
    none, one = splat(_ZERO), splat(_ONE)
    for k in range(begin, end):
        first, last, top = reach(draws, k)
        red, green, blue = splat(entries[k, COLOUR]), splat(entries[k, COLOUR + 1]), splat(entries[k, COLOUR + 2])
        nx, ny, nz = splat(entries[k, NORMAL]), splat(entries[k, NORMAL + 1]), splat(entries[k, NORMAL + 2])
        which = splat(np.float32(k - start + 1))
        _meet(state, first, last, top, entries, k, True, False)
        for i in range(first * WIDE, last * WIDE, WIDE):
            before, z, m = load(state, T + i), load(state, Z + i), load(state, M + i)
            weight, after = cover(minimum(load(state, RESPONSE + i), splat(_MAX)), before)
            store(state, T + i, after)
            wm, first_sum, second_sum = weight * m, load(state, M1 + i), load(state, M2 + i)
            _add(state, SPREAD + i, weight, second_sum)
            _add(state, SPREAD + i, wm, m * (one - before) - (first_sum + first_sum))
            store(state, M1 + i, first_sum + wm)
            store(state, M2 + i, multiply_add(wm, m, second_sum))
            _add(state, D + i, weight, z)
            _add(state, RED + i, weight, red)
            _add(state, RED + PIXELS + i, weight, green)
            _add(state, RED + 2 * PIXELS + i, weight, blue)
            _add(state, NX + i, weight, nx)
            _add(state, NX + PIXELS + i, weight, ny)
            _add(state, NX + 2 * PIXELS + i, weight, nz)
            half = above(weight, none) & above(before, splat(_HALF))
            # Neither is negative: without `maximum`, LLVM would make masked stores of these, slow on AMD's processors.
            store(state, MEDIAN + i, where(half, z, maximum(none, load(state, MEDIAN + i))))
            store(state, WHICH + i, where(half, which, maximum(none, load(state, WHICH + i))))


@inlined
def _render_strip(strip, state, work, splats, background, pictures):
    _, across, ranges, draws, entries, ends = work
    image, others, kept = pictures
    left, top, wide, tall = place(strip, across, image, state[X:], state[T : T + PIXELS])
    state[RED:] = 0
    end = ranges[strip]
    while end < ranges[strip + 1] and unfinished(state[T : T + PIXELS]):
        begin, end = end, min(end + CHECK, ranges[strip + 1])
        _expand(begin, end, strip % across, strip // across, splats, draws, entries)
        _blend(state, ranges[strip], begin, end, draws, entries)
    ends[strip] = end
    for y in range(tall):
        for x in range(wide):
            i, v, u = y * WIDE + x, top + y, left + x
            left_over = abs(state[T + i])
            for channel in range(3):
                image[channel, v, u] = state[RED + channel * PIXELS + i] + left_over * background[channel]
                others[2 + channel, v, u] = state[NX + channel * PIXELS + i]
            others[0, v, u], others[1, v, u] = state[D + i], _ONE - left_over
            others[5, v, u], others[6, v, u] = state[MEDIAN + i], _SCALE * _SCALE * state[SPREAD + i]
            kept[0, v, u], kept[1, v, u], kept[2, v, u] = state[M1 + i], state[M2 + i], state[WHICH + i]


@compiled(fastmath=CAREFUL, _nrt=True)
def render(counter, bands, work, splats, background, pictures):
    """Fill the `Pictures` of splats [N, SPLAT], and of the `Work` the entries and the ends: `in_threads`."""
    state, band = np.empty(STATE, np.float32), claimed(counter)
    while band < bands:
        for strip in range(work.bands[band, 0], work.bands[band, 1]):
            _render_strip(strip, state, work, splats, background, pictures)
        band = claimed(counter)


@part(fastmath=CAREFUL)
def _blend_backward(state, begin, end, draws, entries, g_others, sums):
    """Go front to back as `_blend`, adding to the discs' sums; `g_others` is None where there is none.

    dL/dalpha = T own - rest / (1 - alpha): `own` is the gradient of this disc's weight, `rest` the sum of weight times
    own over those behind it: what is left of the whole pixel's sum after those before.
    """
    xs, none, one = load(state, X), splat(_ZERO), splat(_ONE)
    for k in range(begin, end):
        first, last, top = reach(draws, k)
        red, green, blue = splat(entries[k, COLOUR]), splat(entries[k, COLOUR + 1]), splat(entries[k, COLOUR + 2])
        nx, ny, nz = splat(entries[k, NORMAL]), splat(entries[k, NORMAL + 1]), splat(entries[k, NORMAL + 2])
        which = splat(np.float32(k - begin + 1))
        _meet(state, first, last, top, entries, k, g_others is not None, True)
        r = g = b = gnx = gny = gnz = go = none
        for i in range(first * WIDE, last * WIDE, WIDE):
            response, before = load(state, RESPONSE + i), load(state, T + i)
            alpha = minimum(response, splat(_MAX))
            weight, after = cover(alpha, before)
            store(state, T + i, after)
            g_red, g_green = load(state, G_RED + i), load(state, G_RED + PIXELS + i)
            g_blue = load(state, G_RED + 2 * PIXELS + i)
            own = multiply_add(g_red, red, multiply_add(g_green, green, g_blue * blue)) + load(state, E0 + i)
            if g_others is not None:
                z, m, g_depth = load(state, Z + i), load(state, M + i), load(state, G_D + i)
                g_nx, g_ny = load(state, G_NX + i), load(state, G_NX + PIXELS + i)
                g_nz = load(state, G_NX + 2 * PIXELS + i)
                e2 = m * load(state, E2 + i)
                e = load(state, E1 + i) + e2
                own = own + multiply_add(g_nx, nx, multiply_add(g_ny, ny, g_nz * nz))
                own = own + multiply_add(g_depth, z, m * e)
                g_z = weight * (g_depth - m * m * (e + e2))  # dm/dz = -m^2
                median = where(equal(load(state, MEDIAN_AT + i), which), load(state, G_MEDIAN + i), none)
                store(state, G_Z + i, g_z + median)
                gnx, gny = multiply_add(weight, g_nx, gnx), multiply_add(weight, g_ny, gny)
                gnz = multiply_add(weight, g_nz, gnz)
            rest = load(state, REST + i) - weight * own
            store(state, REST + i, rest)
            h = response * (before * own - rest / (one - alpha))
            h = where(above(weight, none), h, none)
            store(state, RESPONSE + i, h)
            go = go + h
            r, g, b = multiply_add(weight, g_red, r), multiply_add(weight, g_green, g), multiply_add(weight, g_blue, b)

        # Sums are added eight at a time by the fields' numbers; where two such meet, one of them adds nothing.
        at = np.uint64(draws[k, SUM]) * np.uint64(GRADIENTS)
        _add_sums(sums, at + np.uint64(GRADIENTS - 8), totals(none, go, r, g, b, gnx, gny, gnz))

        # To p's numbers about the disc's centre.
        u, v = splat(entries[k, CENTRE]), splat(entries[k, CENTRE + 1])
        dx, top = xs - u, top - v
        p0 = p1 = p2 = p0y = p1y = p2y = det = none
        ys = top
        for i in range(first * WIDE, last * WIDE, WIDE):
            disc = at_least(none, load(state, EXCESS + i))
            z, su, sv = load(state, Z + i), load(state, U + i), load(state, V + i)
            hz = where(disc, load(state, RESPONSE + i), none) * z
            to_u, to_v, to_z = hz * su, hz * sv, hz * multiply_add(su, su, sv * sv)
            if g_others is not None:
                gz = where(disc, load(state, G_Z + i), none) * z
                to_z, det = to_z - gz * z, det + gz
            p0, p1, p2 = p0 - to_u, p1 - to_v, p2 + to_z
            p0y, p1y, p2y = p0y - to_u * ys, p1y - to_v * ys, multiply_add(to_z, ys, p2y)
            ys = ys + one
        _add_sums(sums, at, totals(p0, p1, p2, p0 * dx, p1 * dx, p2 * dx, p0y, p1y))

        gu = gv = w0 = w1 = w2 = none
        ys = top
        for i in range(first * WIDE, last * WIDE, WIDE):
            screen = above(load(state, EXCESS + i), none)
            h = where(screen, load(state, RESPONSE + i), none)
            gu, gv = gu + h, multiply_add(h, ys, gv)
            if g_others is not None:
                g_z = where(screen, load(state, G_Z + i), none)
                w0, w1 = multiply_add(g_z, load(state, U + i), w0), multiply_add(g_z, load(state, V + i), w1)
                w2 = w2 + g_z
            ys = ys + one
        gu, gv = dx * (gu + gu), gv + gv
        _add_sums(sums, at + np.uint64(8), totals(p2y, det, gu, gv, w0, w1, w2, none))


@inlined
def _render_backward_strip(strip, state, work, background, pictures, g_image, g_others, sums):
    _, across, ranges, draws, entries, ends = work
    image, others, kept = pictures
    left, top, wide, tall = place(strip, across, image, state[X:], state[T : T + PIXELS])
    state[G_RED:] = 0
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
                spread, alpha = _SCALE * _SCALE * g_others[6, v, u], others[1, v, u]
                for channel in range(3):
                    state[G_NX + channel * PIXELS + i] = g_others[2 + channel, v, u]
                    rest += g_others[2 + channel, v, u] * others[2 + channel, v, u]
                state[G_D + i], state[G_MEDIAN + i] = g_others[0, v, u], g_others[5, v, u]
                state[E1 + i], state[E2 + i] = -_TWO * spread * kept[0, v, u], spread * alpha
                state[MEDIAN_AT + i] = kept[2, v, u]
                constant += g_others[1, v, u] + spread * kept[1, v, u]
                rest += g_others[0, v, u] * others[0, v, u] + g_others[1, v, u] * alpha
                rest += _TWO * g_others[6, v, u] * others[6, v, u]
            state[E0 + i], state[REST + i] = constant, rest
    _blend_backward(state, ranges[strip], ends[strip], draws, entries, g_others, sums)


@compiled(fastmath=CAREFUL, _nrt=True)
def render_backward(counter, bands, work, background, pictures, g_image, g_others, sums):
    """Add the gradient of every entry to its disc's sums, one array; `g_others` may be None."""
    state, band = np.empty(BACKWARD_STATE, np.float32), claimed(counter)
    while band < bands:
        for strip in range(work.bands[band, 0], work.bands[band, 1]):
            _render_backward_strip(strip, state, work, background, pictures, g_image, g_others, sums)
        band = claimed(counter)


@compiled(fastmath=CAREFUL)
def matters(g_others, others):
    """Return whether the other channels have a nonzero gradient where a disc is drawn."""
    for v in range(g_others.shape[1]):
        for u in range(g_others.shape[2]):
            if others[1, v, u] != _ZERO:
                for channel in range(len(g_others)):
                    if g_others[channel, v, u] != _ZERO:
                        return True
    return False
