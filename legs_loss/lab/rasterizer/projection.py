"""The compiled rasterizer's work for each Gaussian: from three dimensions to a splat.

A splat is a row of nine float64 numbers: centre (u, v) in pixels, its own coordinates (p, q, r; see `own_axes`),
logarithm of the opacity, colour (r, g, b). The determinant of its covariance is a sum of squares (Cauchy-Binet), since
a needle's a c - b b cancels to nothing.

The geometry of a block of Gaussians is computed four at a time: their numbers lie side by side, a row of `state` each.
"""

# mypy: ignore-errors
# (numba infers the types, by its own rules: arrays of float32, or of float64 for geometry, and of integers)

from __future__ import annotations

import math
from typing import Tuple

import numpy as np

from legs_loss.kernels.compiling import aligned, claimed, compiled, inlined, part
from legs_loss.lab.conventions import FARTHEST, MIN_ALPHA, NEAR, SQUARE, TILE
from legs_loss.lab.rasterizer import harmonics
from legs_loss.lab.rasterizer.geometry import (
    conic,
    linearised,
    numbers,
    own_axes,
    rotation,
    times_covariance,
    times_rotation,
    to_camera,
)
from legs_loss.lab.rasterizer.harmonics import shade
from legs_loss.lab.rasterizer.sorting import FIRST_SLOT, ROWS, STRIP, band_at, bands_across, packed, unpacked

BLOCK = 512  # Gaussians that one thread takes at a time
WIDE, TALL = 8, 32  # pixels: a strip of the image, see strips.py
FAINTEST = math.log(MIN_ALPHA) - 1e-3  # what is left out is fainter than MIN_ALPHA by more than rounding

# Rows of a block's state: the mean and the shape (scales and quaternion, or covariance), then what is drawn of them.
MEAN, SHAPE = 0, 3
CENTRE, COVARIANCE, DETERMINANT, LARGEST = 0, 2, 5, 6
# Behind these come the rows of the backward pass. A row ends 64 bytes past a power of two, or all would fall into one
# set of the cache.
STATE = 24, BLOCK + 8


@part()
def floor(value):
    """Return the greatest integer below, within 1e8 of 0."""
    return np.int64(math.floor(max(min(value, 1e8), -1e8)))


@part()
def ceil(value):
    """Return the greatest integer below, within 1e8 of 0."""
    return -floor(-value)


@part()
def tile_range(centre, radius, tiles):
    """Return first tile of the square around a splat, and the one past the last, by 3DGS's rounding."""
    first, end = floor((centre - radius) / TILE), floor((centre + radius + (TILE - 1)) / TILE)
    return min(max(first, 0), tiles), min(max(end, 0), tiles)


@part()
def origin(left, top, rows):
    """Return the pixel coordinates about which an entry is written: amid the rows of the strip that it reaches."""
    first, end, _ = unpacked(rows)
    return left + 0.5 * (WIDE - 1), top + 0.5 * (first + end - 1)


@part()
def lay_out(means, scales, quaternions, covariances, i, state, j):
    """Write a Gaussian's mean and shape to column `j` of a block's state."""
    for k in range(3):
        state[MEAN + k, j] = means[i, k]
    if scales is not None:
        for k in range(3):
            state[SHAPE + k, j] = scales[i, k]
        for k in range(4):
            state[SHAPE + 3 + k, j] = quaternions[i, k]
    if covariances is not None:
        for k in range(6):
            state[SHAPE + k, j] = covariances[i, k]


@inlined
def _drawn(x, y, z, a, b, c, determinant, intrinsics, dilation):
    """Return a splat's rows CENTRE to LARGEST of the state."""
    fx, fy, cx, cy, _, _ = intrinsics
    nearness = 1 / z
    middle = 0.5 * (a + c) + dilation
    largest = middle + math.sqrt(max(0.1, middle * middle - determinant))
    u, v = fx * x * nearness + cx - 0.5, fy * y * nearness + cy - 0.5
    return u, v, a + dilation, b, c + dilation, determinant, largest


@part()
def _shapes(count, intrinsics, pose, dilation, state):
    """Project means, scales and quaternions to centres and covariances in the image."""
    intrinsics, pose = numbers(intrinsics, pose)
    for j in range(np.uint64(count)):
        x, y, z = to_camera(state[MEAN, j], state[MEAN + 1, j], state[MEAN + 2, j], pose)
        t = linearised(x, y, z, intrinsics, pose)
        s0, s1, s2 = state[SHAPE, j] ** 2, state[SHAPE + 1, j] ** 2, state[SHAPE + 2, j] ** 2
        r, _, _ = rotation(state[SHAPE + 3, j], state[SHAPE + 4, j], state[SHAPE + 5, j], state[SHAPE + 6, j])
        u = times_rotation(t, r)
        a = u[0] * u[0] * s0 + u[1] * u[1] * s1 + u[2] * u[2] * s2
        b = u[0] * u[3] * s0 + u[1] * u[4] * s1 + u[2] * u[5] * s2
        c = u[3] * u[3] * s0 + u[4] * u[4] * s1 + u[5] * u[5] * s2
        determinant = dilation * (a + c + dilation)
        determinant += (u[0] * u[4] - u[1] * u[3]) ** 2 * s0 * s1
        determinant += (u[0] * u[5] - u[2] * u[3]) ** 2 * s0 * s2
        determinant += (u[1] * u[5] - u[2] * u[4]) ** 2 * s1 * s2
        drawn = _drawn(x, y, z, a, b, c, determinant, intrinsics, dilation)
        state[0, j], state[1, j], state[2, j], state[3, j], state[4, j], state[5, j], state[6, j] = drawn


@part()
def _covariances(count, intrinsics, pose, dilation, state):
    """Project means and covariances to those in the image. The input may be any matrix."""
    intrinsics, pose = numbers(intrinsics, pose)
    for j in range(np.uint64(count)):
        x, y, z = to_camera(state[MEAN, j], state[MEAN + 1, j], state[MEAN + 2, j], pose)
        t = linearised(x, y, z, intrinsics, pose)
        xx, xy, xz = state[SHAPE, j], state[SHAPE + 1, j], state[SHAPE + 2, j]
        yy, yz, zz = state[SHAPE + 3, j], state[SHAPE + 4, j], state[SHAPE + 5, j]
        u = times_covariance(t, (xx, xy, xz, yy, yz, zz))
        a = u[0] * t[0] + u[1] * t[1] + u[2] * t[2]
        b = u[0] * t[3] + u[1] * t[4] + u[2] * t[5]
        c = u[3] * t[3] + u[4] * t[4] + u[5] * t[5]
        determinant = dilation * (a + c + dilation) + a * c - b * b
        drawn = _drawn(x, y, z, a, b, c, determinant, intrinsics, dilation)
        state[0, j], state[1, j], state[2, j], state[3, j], state[4, j], state[5, j], state[6, j] = drawn


@part()
def _in_the_image(scales, covariances, count, intrinsics, pose, dilation, state):
    """Project what is there: of arguments numba sees that they are None, and compiles the other only."""
    if scales is not None:
        _shapes(count, intrinsics, pose, dilation, state)
    if covariances is not None:
        _covariances(count, intrinsics, pose, dilation, state)


@inlined
def _project_block(own, first, end, parameters, camera, footprint, found):
    means, scales, quaternions, opacities, sh, covariances = parameters
    degree, intrinsics, pose, position, size = camera
    dilation, square = footprint
    splats, depths, radii, clamped, boxes, slots = found
    (state, before_camera, eight), count = own, np.int64(0)
    for i in range(np.uint64(first), np.uint64(end)):
        radii[i] = 0
        slots[i] = 0
        x, y, z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if not depth > NEAR:
            continue
        depths[i] = np.float32(depth)
        lay_out(means, scales, quaternions, covariances, i, state, count)
        before_camera[count] = i
        count += 1
    _in_the_image(scales, covariances, count, intrinsics, pose, dilation, state)
    drawn, seen = before_camera, np.int64(0)
    for j in range(np.uint64(count)):
        i = np.uint64(before_camera[j])
        centre_x, centre_y = state[CENTRE, j], state[CENTRE + 1, j]
        a, b, c = state[COVARIANCE, j], state[COVARIANCE + 1, j], state[COVARIANCE + 2, j]
        determinant = state[DETERMINANT, j]
        if not (determinant > 0 and a > 0):
            continue
        deviation = math.sqrt(state[LARGEST, j])
        radius = min(math.ceil(SQUARE * deviation), float(FARTHEST))
        reach = radius if square == SQUARE else min(math.ceil(square * deviation), float(FARTHEST))
        left, right = tile_range(centre_x, reach, -(-size[0] // TILE))
        top, bottom = tile_range(centre_y, reach, -(-size[1] // TILE))
        if right <= left or bottom <= top:
            continue
        radii[i] = np.int32(radius)
        splats[i, 0], splats[i, 1] = centre_x, centre_y
        splats[i, 2], splats[i, 3], splats[i, 4] = own_axes(a, b, determinant)

        # Within the square's tiles, what the ellipse where alpha falls to MIN_ALPHA may reach.
        opacity = np.float64(opacities[i, 0])
        if opacity < MIN_ALPHA:
            continue
        summit = math.log(opacity)
        level = 2 * (summit - FAINTEST)
        reach_x, reach_y = math.sqrt(level * a), math.sqrt(level * c)
        x0, x1 = max(TILE * left, ceil(centre_x - reach_x)), min(TILE * right, size[0], floor(centre_x + reach_x) + 1)
        y0, y1 = max(TILE * top, ceil(centre_y - reach_y)), min(TILE * bottom, size[1], floor(centre_y + reach_y) + 1)
        if x1 <= x0 or y1 <= y0:
            continue
        x0, x1 = x0 // WIDE, (x1 - 1) // WIDE + 1
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = x0, y0, x1, y1
        slots[i] = (x1 - x0) * ((y1 - 1) // TALL + 1 - y0 // TALL)
        splats[i, 5] = summit
        drawn[seen] = i  # where what was read stood, or before
        seen += 1
    shade(eight, drawn, seen, means, position, degree, sh, clamped, splats, np.int64(6))


def memory() -> Tuple[Tuple[np.ndarray, ...]]:
    """Return what a thread needs for a block of Gaussians: its state, numbers of some, and what `shade` does."""
    return ((aligned(STATE[0] * STATE[1], np.float64).reshape(STATE), np.empty(BLOCK, np.int64), *harmonics.memory()),)


@compiled()
def project(own, counter, blocks, parameters, camera, footprint, found):
    """Fill the `ProjectedGaussians` of `Parameters`, a `GaussianCamera` and a `Footprint` (groups.py): `in_threads`."""
    count, block = len(parameters.means), claimed(counter)
    while block < blocks:
        first = block * BLOCK
        _project_block(own, first, min(first + BLOCK, count), parameters, camera, footprint, found)
        block = claimed(counter)


@compiled()
def find_rows(counter, blocks, splats, boxes, slots, firsts, across, reached):
    """Fill the slots, one for each strip in each Gaussian's box: the strip, or -1, and its rows: `in_threads`."""
    count, block = len(slots), claimed(counter)
    while block < blocks:
        for i in range(np.uint64(block * BLOCK), np.uint64(min((block + 1) * BLOCK, count))):
            if slots[i] == 0:
                continue
            u, v, p, q, r = splats[i, 0], splats[i, 1], splats[i, 2], splats[i, 3], splats[i, 4]
            a, b, c = conic(p, q, r)
            determinant = 1 / (q * r) ** 2  # the covariance's: 1 / D below
            x0, y0, x1, y1 = boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3]
            level = 2 * (splats[i, 5] - FAINTEST)
            # The ellipse's upper and lower edge over dx are (-B dx +- sqrt(C level - D dx^2)) / C, D = A C - B^2. Their
            # extreme points are at dx = summit and -summit, or, where the strip does not have them, at its nearer side.
            level_d, inverse = level * determinant, 1 / c
            wide = math.sqrt(level_d * c)
            summit = -b * math.sqrt(level_d / a)
            tall, slope, bend = level * inverse, -b * inverse, inverse * inverse / determinant
            slot = np.uint64(firsts[i, FIRST_SLOT])
            band, bands = -band_at(x0), bands_across(x0, x1)
            for strip_y in range(y0 // TALL, (y1 - 1) // TALL + 1):
                top = strip_y * TALL
                first_row, last_row = float(max(top, y0)), float(min(top + TALL, y1) - 1)
                for strip_x in range(x0, x1):
                    near, far = max(strip_x * WIDE - u, -wide), min(strip_x * WIDE + (WIDE - 1) - u, wide)
                    reached[slot, STRIP] = -1
                    if near <= far:
                        at = min(max(-summit, near), far)
                        row = math.ceil(max(first_row, v + slope * at - math.sqrt(max(tall - bend * at * at, 0.0))))
                        at = min(max(summit, near), far)
                        lowest = v + slope * at + math.sqrt(max(tall - bend * at * at, 0.0))
                        end_row = math.floor(min(last_row, lowest)) + 1
                        if row < end_row:
                            reached[slot, STRIP] = strip_y * across + strip_x
                            reached[slot, ROWS] = packed(row - top, end_row - top, band + band_at(strip_x))
                    slot += np.uint64(1)
                band += bands
        block = claimed(counter)
