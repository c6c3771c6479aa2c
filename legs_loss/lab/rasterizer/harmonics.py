"""Evaluate the colour of Gaussians by spherical harmonics of the viewing direction, and its gradient, compiled.

Eight Gaussians are taken at a time: a row of `work` has one number of each, and the loops over a row become vectors.
"""

# mypy: ignore-errors
# (numba infers the types, by its own rules)

from __future__ import annotations

import math

import numpy as np

from legs_loss.kernels.compiling import inlined, part
from legs_loss.lab.conventions import SH_C0, SH_C1, SH_C2, SH_C3
from legs_loss.lab.simd.arithmetic import splat
from legs_loss.lab.simd.lanes import transposed
from legs_loss.lab.simd.memory import load, prefetch, store
from legs_loss.lab.simd.vectors import LANES

_C0, _C1 = np.float32(SH_C0), np.float32(SH_C1)
_D0, _D1, _D2, _D3, _D4 = (np.float32(c) for c in SH_C2)
_E0, _E1, _E2, _E3, _E4, _E5, _E6 = (np.float32(c) for c in SH_C3)

# Rows of the work: coefficients as `sh` has them, or the gradients to them; harmonics, and the gradients to them; the
# direction from the camera, or the gradient to it; the colour, or the gradient to it.
BASIS, G, X, Y, Z, COLOUR, ROWS = 48, 64, 80, 81, 82, 83, 86
_STARTS = tuple(range(0, LANES * LANES, LANES))  # of eight of them, in memory


@inlined
def _directions(drawn, begin, count, means, position, width, work, distances, starts):
    """Fill directions, of length 1, the length that they had, and where in `sh` eight Gaussians' numbers start.

    Past the last Gaussian they are the last one's.
    """
    for j in range(LANES):
        i = np.uint64(drawn[min(begin + j, count - 1)])
        x, y, z = means[i, 0] - position[0], means[i, 1] - position[1], means[i, 2] - position[2]
        starts[j], distances[j] = i * np.uint64(width), max(math.sqrt(x * x + y * y + z * z), 1e-12)
        nearness = 1 / distances[j]
        work[X, j], work[Y, j], work[Z, j] = x * nearness, y * nearness, z * nearness


@inlined
def _ask(drawn, begin, count, width, sh):
    """Ask for the numbers of the eight Gaussians after the next eight, 64 bytes at a time."""
    for k in range(begin + 2 * LANES, min(begin + 3 * LANES, count)):
        for line in range(0, width, 16):
            prefetch(sh, np.uint64(drawn[k]) * np.uint64(width) + np.uint64(line))


@inlined
def _turn(given, froms, at, target, tos, to):
    """Copy eight numbers at each of eight places to: the first ones, the second ones, ... at eight places."""
    columns = transposed(
        load(given, froms[0] + at), load(given, froms[1] + at), load(given, froms[2] + at), load(given, froms[3] + at),
        load(given, froms[4] + at), load(given, froms[5] + at), load(given, froms[6] + at), load(given, froms[7] + at),
    )  # fmt: skip
    for k in range(LANES):
        store(target, tos[k] + to, columns[k])


@inlined
def _row(rows, k):
    return load(rows, k * LANES)


@inlined
def _set_rows(rows, k, values):
    for value in values:
        store(rows, k * LANES, value)
        k += 1


@inlined
def _harmonics(degree, rows):
    """Fill the harmonics of the directions."""
    two, three, four = np.float32(2), np.float32(3), np.float32(4)
    x, y, z = _row(rows, X), _row(rows, Y), _row(rows, Z)
    _set_rows(rows, BASIS, (splat(_C0),))
    if degree > 0:
        _set_rows(rows, BASIS + 1, (-_C1 * y, _C1 * z, -_C1 * x))
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        squares = _D2 * (two * zz - xx - yy), _D3 * x * z, _D4 * (xx - yy)
        _set_rows(rows, BASIS + 4, (_D0 * x * y, _D1 * y * z, *squares))
        if degree > 2:
            sides = _E1 * x * y * z, _E2 * y * (four * zz - xx - yy), _E3 * z * (two * zz - three * (xx + yy))
            ends = _E4 * x * (four * zz - xx - yy), _E5 * z * (xx - yy), _E6 * x * (xx - three * yy)
            _set_rows(rows, BASIS + 9, (_E0 * y * (three * xx - yy), *sides, *ends))


@inlined
def _direction_gradient(degree, rows):
    """Turn the directions into the gradients to them, but for the nearness, from the gradients to their harmonics."""
    two, three, four, six, eight = np.float32(2), np.float32(3), np.float32(4), np.float32(6), np.float32(8)
    x, y, z = _row(rows, X), _row(rows, Y), _row(rows, Z)
    gx = gy = gz = splat(np.float32(0))
    if degree > 0:
        gx, gy, gz = -_C1 * _row(rows, G + 3), -_C1 * _row(rows, G + 1), _C1 * _row(rows, G + 2)
    if degree > 1:
        g4, g5, g6 = _row(rows, G + 4), _row(rows, G + 5), _row(rows, G + 6)
        g7, g8 = _row(rows, G + 7), _row(rows, G + 8)
        gx = gx + (_D0 * y * g4 - two * _D2 * x * g6 + _D3 * z * g7 + two * _D4 * x * g8)
        gy = gy + (_D0 * x * g4 + _D1 * z * g5 - two * _D2 * y * g6 - two * _D4 * y * g8)
        gz = gz + (_D1 * y * g5 + four * _D2 * z * g6 + _D3 * x * g7)
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        g9, g10, g11, g12 = _row(rows, G + 9), _row(rows, G + 10), _row(rows, G + 11), _row(rows, G + 12)
        g13, g14, g15 = _row(rows, G + 13), _row(rows, G + 14), _row(rows, G + 15)
        x3 = six * _E0 * x * y * g9 + _E1 * y * z * g10 - two * _E2 * x * y * g11 - six * _E3 * x * z * g12
        x3 = x3 + _E4 * (four * zz - three * xx - yy) * g13 + two * _E5 * x * z * g14 + three * _E6 * (xx - yy) * g15
        y3 = three * _E0 * (xx - yy) * g9 + _E1 * x * z * g10 + _E2 * (four * zz - xx - three * yy) * g11
        y3 = y3 - six * _E3 * y * z * g12 - two * _E4 * x * y * g13 - two * _E5 * y * z * g14 - six * _E6 * x * y * g15
        z3 = _E1 * x * y * g10 + eight * _E2 * y * z * g11 + three * _E3 * (two * zz - xx - yy) * g12
        z3 = z3 + eight * _E4 * x * z * g13 + _E5 * (xx - yy) * g14
        gx, gy, gz = gx + x3, gy + y3, gz + z3
    along = gx * x + gy * y + gz * z
    _set_rows(rows, X, (gx - along * x, gy - along * y, gz - along * z))


@inlined
def _begin(drawn, begin, count, means, position, degree, sh, work, distances, starts):
    """Fill the work of the Gaussians from `begin` on: directions, coefficients, harmonics; and distances and starts."""
    used, width, numbers, rows = 3 * (degree + 1) * (degree + 1), 3 * sh.shape[1], sh.reshape(-1), work.reshape(-1)
    _ask(drawn, begin, count, width, numbers)
    _directions(drawn, begin, count, means, position, width, work, distances, starts)
    for k in range(0, used - used % LANES, LANES):
        _turn(numbers, starts, k, rows, _STARTS, k * LANES)
    for k in range(used - used % LANES, used):
        for j in range(LANES):
            work[k, j] = numbers[starts[j] + k]
    _harmonics(degree, rows)


@part()
def shade(drawn, count, means, position, degree, sh, clamped, splats, column):
    """Fill Gaussians' colours as seen from `position`, and which of their channels are clamped at 0.

    Args:
        drawn: which Gaussians, its first `count` numbers.
        means, sh, clamped, splats: of all; [N, 3], [N, K, 3], [N, 3], [N, columns].
        column: of the splats, the first of the colour's three.
    """
    work, distances, starts = np.empty((ROWS, LANES), np.float32), np.empty(LANES), np.empty(LANES, np.int64)
    rows, coefficients = work.reshape(-1), (degree + 1) * (degree + 1)
    for begin in range(0, count, LANES):
        _begin(drawn, begin, count, means, position, degree, sh, work, distances, starts)
        for channel in range(3):
            value = splat(np.float32(0.5))
            for k in range(coefficients):
                value = value + _row(rows, BASIS + k) * _row(rows, 3 * k + channel)
            _set_rows(rows, COLOUR + channel, (value,))
        for j in range(min(LANES, count - begin)):
            i = np.uint64(drawn[begin + j])
            for channel in range(3):
                clamped[i, channel] = work[COLOUR + channel, j] < np.float32(0)
                splats[i, column + channel] = max(work[COLOUR + channel, j], np.float32(0))


@part()
def shade_gradient(drawn, count, means, position, degree, sh, clamped, colours, g_means, g_sh):
    """Fill the gradients to Gaussians' coefficients from those to their colours, and add to those of their means.

    Args:
        drawn, count, means, position, degree, sh, clamped: as for `shade`.
        colours, g_means: [3, count], a column for each of those drawn.
        g_sh: as sh.
    """
    work, distances, starts = np.empty((ROWS, LANES), np.float32), np.empty(LANES), np.empty(LANES, np.int64)
    rows, numbers, width = work.reshape(-1), g_sh.reshape(-1), 3 * sh.shape[1]
    coefficients = (degree + 1) * (degree + 1)
    used = 3 * coefficients
    for begin in range(0, count, LANES):
        _ask(drawn, begin, count, width, numbers)
        _begin(drawn, begin, count, means, position, degree, sh, work, distances, starts)
        for j in range(LANES):
            at = min(begin + j, count - 1)
            for channel in range(3):
                held = clamped[np.uint64(drawn[at]), channel]
                work[COLOUR + channel, j] = np.float32(0) if held else np.float32(colours[channel, at])
        red, green, blue = _row(rows, COLOUR), _row(rows, COLOUR + 1), _row(rows, COLOUR + 2)
        for k in range(coefficients):
            basis, at = _row(rows, BASIS + k), 3 * k
            gradient = red * _row(rows, at) + green * _row(rows, at + 1) + blue * _row(rows, at + 2)
            _set_rows(rows, G + k, (gradient,))
            _set_rows(rows, at, (basis * red, basis * green, basis * blue))
        for k in range(0, used - used % LANES, LANES):
            _turn(rows, _STARTS, k * LANES, numbers, starts, k)
        for j in range(LANES):
            for k in range(used - used % LANES, width):
                numbers[starts[j] + k] = work[k, j] if k < used else np.float32(0)
        _direction_gradient(degree, rows)
        for j in range(min(LANES, count - begin)):
            nearness = 1 / distances[j]
            for k in range(3):
                g_means[k, begin + j] += work[X + k, j] * nearness
