"""Evaluate the colour of Gaussians by spherical harmonics of the viewing direction, and its gradient, compiled.

Eight Gaussians are taken at a time: a row has one number of each, and is one vector. The harmonics are polynomials of
the direction, kept as tables of their terms: written out, they would take a third of all that a training compiles.
"""

# mypy: ignore-errors
# (numba infers the types)

from __future__ import annotations

import math
import re
from itertools import combinations_with_replacement
from typing import Tuple

import numpy as np

from legs_loss.kernels.compiling import aligned, inlined, part
from legs_loss.lab.conventions import SH_C0, SH_C1, SH_C2, SH_C3
from legs_loss.lab.simd.arithmetic import multiply_add, splat
from legs_loss.lab.simd.lanes import transposed
from legs_loss.lab.simd.memory import load, prefetch, store
from legs_loss.lab.simd.vectors import LANES

_POLYNOMIALS = (
    "1 -y z -x xy yz 2zz-xx-yy xz xx-yy 3xxy-yyy xyz 4yzz-xxy-yyy 2zzz-3xxz-3yyz 4xzz-xxx-xyy xxz-yyz xxx-3xyy"
)
_SCALES = SH_C0, SH_C1, SH_C1, SH_C1, *SH_C2, *SH_C3
_MONOMIALS = ["".join(axes) for degree in range(4) for axes in combinations_with_replacement("xyz", degree)]
_TERMS = [
    (k, _MONOMIALS.index(axes), scale * float(factor + "1" if factor in ("", "+", "-") else factor))
    for k, (scale, polynomial) in enumerate(zip(_SCALES, _POLYNOMIALS.split()))
    for factor, axes in re.findall(r"([+-]?\d*)([xyz]*)", polynomial)
    if factor or axes
]
# Of each monomial, which one times which axis it is; of each term its harmonic and monomial; of each term's derivative
# its axis, harmonic and monomial.
_FACTORS = np.array([(_MONOMIALS.index(axes[:-1]), _MONOMIALS.index(axes[-1:])) for axes in _MONOMIALS])
_PLACES, _OF_TERM = np.array([term[:2] for term in _TERMS]), np.array([term[2] for term in _TERMS], np.float32)
_SLOPES = [
    ("xyz".index(axis), k, _MONOMIALS.index(_MONOMIALS[m].replace(axis, "", 1)), _MONOMIALS[m].count(axis) * factor)
    for k, m, factor in _TERMS
    for axis in sorted(set(_MONOMIALS[m]))
]
_SLOPE_PLACES = np.array([slope[:3] for slope in _SLOPES])
_OF_SLOPE = np.array([slope[3] for slope in _SLOPES], np.float32)

# Rows: coefficients as `sh` has them, or the gradients to them; harmonics, and the gradients to them; the monomials of
# the direction from the camera; the gradient to it; the colour, or the gradient to it.
BASIS, G, MONOMIAL, TO, COLOUR, ROWS = 48, 64, 80, 100, 103, 106


@part()
def _ask(drawn, begin, count, width, numbers):
    """Ask for the numbers of the eight Gaussians after the next eight, 64 bytes at a time."""
    for k in range(begin + 2 * LANES, min(begin + 3 * LANES, count)):
        for line in range(0, width, 16):
            prefetch(numbers, np.uint64(drawn[k]) * np.uint64(width) + np.uint64(line))


@part()
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


@part()
def _begin(drawn, begin, count, means, position, coefficients, numbers, width, rows, distances, starts):
    """Fill the rows of the Gaussians from `begin` on: coefficients, harmonics, monomials of directions of length 1.

    Also the lengths that they had, and where eight Gaussians' coefficients start, in `sh` and in the rows. Past the
    last Gaussian all are the last one's.
    """
    _ask(drawn, begin, count, width, numbers)
    for j in range(LANES):
        i = np.uint64(drawn[min(begin + j, count - 1)])
        x, y, z = means[i, 0] - position[0], means[i, 1] - position[1], means[i, 2] - position[2]
        starts[0, j], starts[1, j] = i * np.uint64(width), j * LANES
        distances[j] = max(math.sqrt(x * x + y * y + z * z), 1e-12)
        nearness, at = 1 / distances[j], MONOMIAL * LANES + j
        rows[at], rows[at + LANES] = 1, x * nearness
        rows[at + 2 * LANES], rows[at + 3 * LANES] = y * nearness, z * nearness
    used = 3 * coefficients
    for k in range(0, used - used % LANES, LANES):
        _turn(numbers, starts[0], k, rows, starts[1], k * LANES)
    for k in range(used - used % LANES, used):
        for j in range(LANES):
            rows[k * LANES + j] = numbers[starts[0, j] + k]
    for k in range(4, len(_FACTORS)):
        first, axis = _row(rows, MONOMIAL + _FACTORS[k, 0]), _row(rows, MONOMIAL + _FACTORS[k, 1])
        store(rows, (MONOMIAL + k) * LANES, first * axis)
    rows[BASIS * LANES : G * LANES] = 0
    for k in range(len(_PLACES)):
        if _PLACES[k, 0] >= coefficients:
            break
        at, monomial = (BASIS + _PLACES[k, 0]) * LANES, _row(rows, MONOMIAL + _PLACES[k, 1])
        store(rows, at, multiply_add(splat(_OF_TERM[k]), monomial, load(rows, at)))


@inlined
def _direction_gradient(coefficients, rows):
    """Fill the gradients to the directions, but for the nearness, from those to their harmonics."""
    rows[TO * LANES : COLOUR * LANES] = 0
    for k in range(len(_SLOPE_PLACES)):
        if _SLOPE_PLACES[k, 1] >= coefficients:
            break
        at, monomial = (TO + _SLOPE_PLACES[k, 0]) * LANES, _row(rows, MONOMIAL + _SLOPE_PLACES[k, 2])
        slope = splat(_OF_SLOPE[k]) * _row(rows, G + _SLOPE_PLACES[k, 1])
        store(rows, at, multiply_add(slope, monomial, load(rows, at)))
    along = splat(np.float32(0))
    for k in range(3):
        along = multiply_add(_row(rows, TO + k), _row(rows, MONOMIAL + 1 + k), along)
    for k in range(3):
        store(rows, (TO + k) * LANES, _row(rows, TO + k) - along * _row(rows, MONOMIAL + 1 + k))


def memory() -> Tuple[Tuple[np.ndarray, ...]]:
    """Return what a thread needs for eight Gaussians: the rows, distances, and where their coefficients begin."""
    return ((aligned(ROWS * LANES), np.empty(LANES), np.empty((2, LANES), np.int64)),)


@part()
def shade(own, drawn, count, means, position, degree, sh, clamped, splats, column):
    """Fill Gaussians' colours as seen from `position`, and which of their channels are clamped at 0.

    Args:
        own: a thread's memory, of `memory`.
        drawn: which Gaussians, its first `count` numbers.
        means, sh, clamped, splats: of all; [N, 3], [N, K, 3], [N, 3], [N, columns].
        column: of the splats, the first of the colour's three.
    """
    (rows, distances, starts), coefficients = own, (degree + 1) * (degree + 1)
    numbers, width = sh.reshape(-1), 3 * sh.shape[1]
    for begin in range(0, count, LANES):
        _begin(drawn, begin, count, means, position, coefficients, numbers, width, rows, distances, starts)
        for channel in range(3):
            value = splat(np.float32(0.5))
            for k in range(coefficients):
                value = value + _row(rows, BASIS + k) * _row(rows, 3 * k + channel)
            store(rows, (COLOUR + channel) * LANES, value)
        for j in range(min(LANES, count - begin)):
            i = np.uint64(drawn[begin + j])
            for channel in range(3):
                value = rows[(COLOUR + channel) * LANES + j]
                clamped[i, channel] = value < np.float32(0)
                splats[i, column + channel] = max(value, np.float32(0))


@part()
def shade_gradient(own, drawn, count, means, position, degree, sh, clamped, colours, g_means, g_sh):
    """Fill the gradients to Gaussians' coefficients from those to their colours, and add to those of their means.

    Args:
        own, drawn, count, means, position, degree, sh, clamped: as for `shade`.
        colours, g_means: [3, count], a column for each of those drawn.
        g_sh: as sh.
    """
    (rows, distances, starts), coefficients = own, (degree + 1) * (degree + 1)
    numbers, gradients, width, used = sh.reshape(-1), g_sh.reshape(-1), 3 * sh.shape[1], 3 * coefficients
    for begin in range(0, count, LANES):
        _ask(drawn, begin, count, width, gradients)
        _begin(drawn, begin, count, means, position, coefficients, numbers, width, rows, distances, starts)
        for j in range(LANES):
            at = min(begin + j, count - 1)
            for channel in range(3):
                held = clamped[np.uint64(drawn[at]), channel]
                rows[(COLOUR + channel) * LANES + j] = np.float32(0) if held else np.float32(colours[channel, at])
        for k in range(coefficients):
            basis, gradient = _row(rows, BASIS + k), splat(np.float32(0))
            for channel in range(3):
                colour, at = _row(rows, COLOUR + channel), 3 * k + channel
                gradient = multiply_add(colour, _row(rows, at), gradient)
                store(rows, at * LANES, basis * colour)
            store(rows, (G + k) * LANES, gradient)
        for k in range(0, used - used % LANES, LANES):
            _turn(rows, starts[1], k * LANES, gradients, starts[0], k)
        for j in range(LANES):
            for k in range(used - used % LANES, width):
                gradients[starts[0, j] + k] = rows[k * LANES + j] if k < used else np.float32(0)
        _direction_gradient(coefficients, rows)
        for j in range(min(LANES, count - begin)):
            nearness = 1 / distances[j]
            for k in range(3):
                g_means[k, begin + j] += rows[(TO + k) * LANES + j] * nearness
