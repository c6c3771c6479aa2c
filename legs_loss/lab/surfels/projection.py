"""Project each disc: from three dimensions to what a strip draws."""

# mypy: ignore-errors
# (numba infers the types, by its own rules: arrays of float32, or of float64 for geometry, and of integers)

from __future__ import annotations

import math

import numpy as np

from legs_loss.kernels.compiling import claimed, compiled, inlined, part
from legs_loss.lab.conventions import FARTHEST, MIN_ALPHA, NEAR, TILE
from legs_loss.lab.rasterizer.harmonics import shade
from legs_loss.lab.rasterizer.projection import BLOCK, FAINTEST, WIDE, ceil, floor, tile_range
from legs_loss.lab.rasterizer.sorting import FIRST_SLOT, ROWS, STRIP, band_at, bands_across, packed
from legs_loss.lab.surfels.geometry import CAREFUL, ellipse, point, ray_map, shape, signed, through
from legs_loss.lab.surfels.model import CUTOFF, FILTER_RADIUS, MIN_EXTENT

TALL = 16  # pixels: of a strip of the image, WIDE across; its rows are one contiguous loop
SLACK = 1e-6  # pixels^2: what an ellipse is widened by, against rounding

# A splat, float64: p about the centre (constant, with i, with j; each three numbers), centre in pixels, the binary
# logarithm of the opacity, colour, normal.
P, CENTRE, OPACITY, COLOUR, NORMAL, SPLAT = 0, 9, 11, 12, 15, 18
# How far a disc reaches, float64: the ellipse's centre, and a, b, c of its matrix [[a, b], [b, c]] (a < 0: everywhere);
# the circle's centre, its radius.
ELLIPSE, CIRCLE, REACH, EXTENT = 0, 5, 7, 8


@inlined
def _project_block(eight, begin, end, discs, camera, found):
    means, scales, quaternions, homographies, opacities, sh, colours = discs
    degree, pose, pixels, position, width, height = camera
    splats, extents, depths, radii, clamped, boxes, slots = found
    drawn, count = np.empty(BLOCK, np.int64), 0
    for i in range(np.uint64(begin), np.uint64(end)):
        radii[i] = slots[i] = 0
        depth = through(point(means, i), pose, 2) + pose[3, 2]
        if not depth > NEAR:
            continue
        x, y, w, normal, turn = shape(means, scales, quaternions, homographies, i, pose, pixels)
        if turn == 0 or signed(w, w, CUTOFF) == 0:
            continue
        u, v, a, _, c, _ = ellipse(x, y, w, CUTOFF)
        radius = math.sqrt(max(a, c, MIN_EXTENT, (CUTOFF * FILTER_RADIUS) ** 2))
        radius = min(math.ceil(radius), float(FARTHEST))
        left, right = tile_range(u, radius, -(-width // TILE))
        top, bottom = tile_range(v, radius, -(-height // TILE))
        if right <= left or bottom <= top:
            continue
        radii[i] = np.int32(radius)

        opacity = np.float64(opacities[i, 0])
        constant, along, down, scale, _, _ = ray_map(x, y, w, u, v)
        if opacity < MIN_ALPHA or not abs(scale) < 1e30 or not abs(scale) > 0:
            continue
        x0, y0, x1, y1 = TILE * left, TILE * top, min(TILE * right, width), min(TILE * bottom, height)

        # Within the square's tiles, what the falloff may reach, on the disc or on the screen.
        level = 2 * (math.log(opacity) - FAINTEST)
        reach = math.sqrt(level / 2)
        centre_x, centre_y, a, b, c, sign = ellipse(x, y, w, math.sqrt(level))
        a, c = max(a, 0.0) + SLACK, max(c, 0.0) + SLACK
        if sign < -1e-9 * w[2] * w[2]:
            wide, tall = math.sqrt(a), math.sqrt(c)
            x0 = max(x0, ceil(min(centre_x - wide, u - reach)))
            y0 = max(y0, ceil(min(centre_y - tall, v - reach)))
            x1 = min(x1, floor(max(centre_x + wide, u + reach)) + 1)
            y1 = min(y1, floor(max(centre_y + tall, v + reach)) + 1)
            if x1 <= x0 or y1 <= y0:
                continue
        else:
            a = -1.0
        extents[i, ELLIPSE], extents[i, ELLIPSE + 1] = centre_x, centre_y
        extents[i, ELLIPSE + 2], extents[i, ELLIPSE + 3], extents[i, ELLIPSE + 4] = a, b, c
        extents[i, CIRCLE], extents[i, CIRCLE + 1], extents[i, REACH] = u, v, reach
        x0, x1 = x0 // WIDE, (x1 - 1) // WIDE + 1
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = x0, y0, x1, y1
        slots[i] = (x1 - x0) * ((y1 - 1) // TALL + 1 - y0 // TALL)

        if len(colours) > 0:
            for channel in range(3):
                splats[i, COLOUR + channel] = colours[i, channel]
        drawn[count] = i
        count += 1
        for k in range(3):
            splats[i, P + k] = constant[k] * scale
            splats[i, P + 3 + k] = along[k] * scale
            splats[i, P + 6 + k] = down[k] * scale
            splats[i, NORMAL + k] = turn * normal[k]
        splats[i, CENTRE], splats[i, CENTRE + 1], splats[i, OPACITY] = u, v, math.log2(opacity)
        depths[i] = np.float32(depth)
    if len(colours) == 0:
        shade(eight, drawn, count, means, position, degree, sh, clamped, splats, COLOUR)


@compiled(fastmath=CAREFUL, _nrt=True)
def project(eight, counter, blocks, discs, camera, found):
    """Fill the `ProjectedDiscs` that `Discs` become to a `DiscCamera` (groups.py): `in_threads`."""
    count, block = len(discs.means), claimed(counter)
    while block < blocks:
        begin = block * BLOCK
        _project_block(eight, begin, min(begin + BLOCK, count), discs, camera, found)
        block = claimed(counter)


@part()
def _rows(extents, i, left, right):
    """Return the first and last row (any numbers) that a disc reaches in the columns from `left` to `right`."""
    first, last = 1e9, -1e9
    a, b, c = extents[i, ELLIPSE + 2], extents[i, ELLIPSE + 3], extents[i, ELLIPSE + 4]
    if a < 0:
        return last, first
    wide = math.sqrt(a)
    near, far = max(left - extents[i, ELLIPSE], -wide), min(right - extents[i, ELLIPSE], wide)
    if near <= far:
        # The edges over dx are b/a dx +- sqrt((c - b b / a) (1 - dx dx / a)), their extremes at dx = +- b / sqrt(c).
        slope, summit, inverse = b / a, b / math.sqrt(c), 1 / a
        thick = max(c - b * slope, 0.0)
        at = min(max(-summit, near), far)
        first = extents[i, ELLIPSE + 1] + slope * at - math.sqrt(thick * max(1 - at * at * inverse, 0.0))
        at = min(max(summit, near), far)
        last = extents[i, ELLIPSE + 1] + slope * at + math.sqrt(thick * max(1 - at * at * inverse, 0.0))
    away = max(left - extents[i, CIRCLE], extents[i, CIRCLE] - right, 0.0)
    reach = extents[i, REACH]
    if away <= reach:
        half = math.sqrt(reach * reach - away * away)
        first, last = min(first, extents[i, CIRCLE + 1] - half), max(last, extents[i, CIRCLE + 1] + half)
    return first, last


@compiled()
def find_rows(extents, boxes, slots, firsts, across, reached):
    """Fill the slots, one for each strip in each disc's box: the strip, or -1, and its rows [first, end)."""
    for i in range(len(slots)):
        if slots[i] == 0:
            continue
        slot = np.uint64(firsts[i, FIRST_SLOT])
        band, bands = -band_at(boxes[i, 0]), bands_across(boxes[i, 0], boxes[i, 2])
        for strip_y in range(boxes[i, 1] // TALL, (boxes[i, 3] - 1) // TALL + 1):
            top = strip_y * TALL
            highest, lowest = float(max(top, boxes[i, 1])), float(min(top + TALL, boxes[i, 3]) - 1)
            for strip_x in range(boxes[i, 0], boxes[i, 2]):
                first, last = _rows(extents, i, strip_x * WIDE, strip_x * WIDE + (WIDE - 1))
                row, end = math.ceil(max(first, highest)), math.floor(min(last, lowest)) + 1
                reached[slot, STRIP] = -1
                if row < end:
                    reached[slot, STRIP] = strip_y * across + strip_x
                    reached[slot, ROWS] = packed(row - top, end - top, band + band_at(strip_x))
                slot += np.uint64(1)
            band += bands
