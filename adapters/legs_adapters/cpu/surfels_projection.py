"""The surfel rasterizer's work for each disc: from three dimensions to what a strip draws, and the gradient's way back.

With the rows of a homography T = (x, y, w), the ray of the pixel (i, j) meets the disc at

    p = (i w - x) x (j w - y) = x x y + i (y x w) + j (w x x),      (u, v) = p_xy / p_z,      depth = det T / p_z

so p is linear in the pixel. It is worked out about the disc's centre and divided by det T, so that depth = 1 / p_z. All
of it in float64: the homography of a thin disc cancels badly in float32. The steps are those of surfels_oracle.py.
"""

# mypy: ignore-errors
# (numba infers the types, by its own rules: arrays of float32, or of float64 for geometry, and of integers)

from __future__ import annotations

import math

import numpy as np
from numba import prange

from legs_adapters.cpu.surfels_oracle import CUTOFF, FILTER_RADIUS, MIN_EXTENT
from legs_loss.kernels.compiling import compiled
from legs_loss.reference.conventions import FARTHEST, MIN_ALPHA, NEAR, TILE
from legs_loss.reference.rasterizer.geometry import quaternion_partials, rotation
from legs_loss.reference.rasterizer.harmonics import direction, harmonics, harmonics_gradient
from legs_loss.reference.rasterizer.projection import BLOCK, FAINTEST, ceil, floor, tile_range
from legs_loss.reference.rasterizer.sorting import (
    FIRST_SLOT,
    FIRST_SUM,
    ROWS,
    STRIP,
    band_at,
    bands_across,
    packed,
    unpacked,
)

# No promise that numbers are finite: a disc that is seen from its edge has a homography without inverse.
CAREFUL = {"nsz"}

WIDE, TALL = 8, 16  # pixels: a strip of the image; its rows are one contiguous loop
SLACK = 1e-6  # pixels^2: what an ellipse is widened by, against rounding

# A splat, float64: p about the centre (constant, with i, with j; each three numbers), centre in pixels, the binary
# logarithm of the opacity, colour, normal.
P, CENTRE, OPACITY, COLOUR, NORMAL, SPLAT = 0, 9, 11, 12, 15, 18
# How far a disc reaches, float64: the ellipse's centre, and a, b, c of its matrix [[a, b], [b, c]] (a < 0: everywhere);
# the circle's centre, its radius.
ELLIPSE, CIRCLE, REACH, EXTENT = 0, 5, 7, 8
# An entry's gradient, float32: of p's nine numbers, of det T as a factor of the depth, of the centre, of w's three by
# the screen-space Gaussian's depth, of the natural logarithm of the opacity, of colour and normal.
G_DEPTH, G_CENTRE, G_DIRECT, G_OPACITY, G_COLOUR, G_NORMAL, GRADIENTS = 9, 10, 12, 15, 16, 19, 22


@compiled()
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled()
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled()
def _less(a, b, factor):
    return a[0] - factor * b[0], a[1] - factor * b[1], a[2] - factor * b[2]


@compiled()
def _signed(a, b, cutoff):
    """The product of two rows under the signature (c^2, c^2, -1), whose null set is the circle of radius c."""
    return cutoff * cutoff * (a[0] * b[0] + a[1] * b[1]) - a[2] * b[2]


@compiled(fastmath=CAREFUL)
def _ellipse(x, y, w, cutoff):
    """Where a disc's circle of `cutoff` ends in the image: centre, matrix a, b, c; a denominator, below 0 if it ends.

    A vector d from the centre is inside where d^T [[a, b], [b, c]]^-1 d < 1.
    """
    determinant = _signed(w, w, cutoff)
    inverse = 1 / determinant
    u, v = _signed(x, w, cutoff) * inverse, _signed(y, w, cutoff) * inverse
    x, y = _less(x, w, u), _less(y, w, v)
    a, b, c = _signed(x, x, cutoff), _signed(x, y, cutoff), _signed(y, y, cutoff)
    return u, v, -a * inverse, -b * inverse, -c * inverse, determinant


@compiled()
def _point(means, i):
    return np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])


@compiled()
def _through(vector, matrix, k):
    """Column `k` of a vector times a matrix's first three rows."""
    return vector[0] * matrix[0, k] + vector[1] * matrix[1, k] + vector[2] * matrix[2, k]


@compiled()
def _row(axes, long, short, mean, pixels, k):
    """Row `k` of T: the disc's two axes, and its centre."""
    return (
        long * (axes[0] * pixels[0, k] + axes[3] * pixels[1, k] + axes[6] * pixels[2, k]),
        short * (axes[1] * pixels[0, k] + axes[4] * pixels[1, k] + axes[7] * pixels[2, k]),
        _through(mean, pixels, k) + pixels[3, k],
    )


@compiled()
def _rotation(quaternions, i):
    w, x = np.float64(quaternions[i, 0]), np.float64(quaternions[i, 1])
    y, z = np.float64(quaternions[i, 2]), np.float64(quaternions[i, 3])
    return rotation(w, x, y, z)


@compiled()
def _handed(homographies, i, k):
    k *= 3
    return np.float64(homographies[i, k]), np.float64(homographies[i, k + 1]), np.float64(homographies[i, k + 2])


@compiled()
def _shape(means, scales, quaternions, homographies, i, modifier, pose, pixels):
    """Rows x, y, w of T, the normal in the camera's axes, and what turns it towards the camera (0: seen edge on)."""
    mean = _point(means, i)
    if len(homographies) > 0:
        x, y, w = _handed(homographies, i, 0), _handed(homographies, i, 1), _handed(homographies, i, 2)
        normal = 0.0, 0.0, 1.0
        return x, y, w, normal, -1.0
    axes, _, _ = _rotation(quaternions, i)
    long, short = modifier * np.float64(scales[i, 0]), modifier * np.float64(scales[i, 1])
    x = _row(axes, long, short, mean, pixels, 0)
    y = _row(axes, long, short, mean, pixels, 1)
    w = _row(axes, long, short, mean, pixels, 2)
    normal = axes[2], axes[5], axes[8]
    nx, ny, nz = _through(normal, pose, 0), _through(normal, pose, 1), _through(normal, pose, 2)
    px, py, pz = _through(mean, pose, 0), _through(mean, pose, 1), _through(mean, pose, 2)
    away = nx * (px + pose[3, 0]) + ny * (py + pose[3, 1]) + nz * (pz + pose[3, 2])
    turn = (1.0 if away < 0 else 0.0) - (1.0 if away > 0 else 0.0)
    return x, y, w, (nx, ny, nz), turn


@compiled()
def _bent(x, y, w, u, v):
    """p about the centre, but for its scale: constant, along, down; the scale; and the centred rows."""
    centred_x, centred_y = _less(x, w, u), _less(y, w, v)
    constant, along, down = _cross(centred_x, centred_y), _cross(centred_y, w), _cross(w, centred_x)
    return constant, along, down, 1 / _dot(w, constant), centred_x, centred_y


@compiled(fastmath=CAREFUL)
def _project_block(
    begin, end, means, scales, quaternions, homographies, opacities, sh, colours, degree, modifier, pose, pixels,
    position, width, height, splats, extents, depths, radii, clamped, boxes, slots,
):  # fmt: skip
    basis = np.empty(16, np.float32)
    for i in range(np.uint64(begin), np.uint64(end)):
        radii[i] = slots[i] = 0
        depth = _through(_point(means, i), pose, 2) + pose[3, 2]
        if not depth > NEAR:
            continue
        x, y, w, normal, turn = _shape(means, scales, quaternions, homographies, i, modifier, pose, pixels)
        if turn == 0 or _signed(w, w, CUTOFF) == 0:
            continue
        u, v, a, _, c, _ = _ellipse(x, y, w, CUTOFF)
        radius = math.sqrt(max(a, c, MIN_EXTENT, (CUTOFF * FILTER_RADIUS) ** 2))
        radius = min(math.ceil(radius), float(FARTHEST))
        left, right = tile_range(u, radius, -(-width // TILE))
        top, bottom = tile_range(v, radius, -(-height // TILE))
        if right <= left or bottom <= top:
            continue
        radii[i] = np.int32(radius)

        opacity = np.float64(opacities[i, 0])
        constant, along, down, scale, _, _ = _bent(x, y, w, u, v)
        if opacity < MIN_ALPHA or not abs(scale) < 1e30 or not abs(scale) > 0:
            continue
        x0, y0, x1, y1 = TILE * left, TILE * top, min(TILE * right, width), min(TILE * bottom, height)

        # Within the square's tiles, what the falloff may reach, on the disc or on the screen.
        level = 2 * (math.log(opacity) - FAINTEST)
        reach = math.sqrt(level / 2)
        centre_x, centre_y, a, b, c, sign = _ellipse(x, y, w, math.sqrt(level))
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
        else:
            dx, dy, dz, _ = direction(means, i, position)
            harmonics(degree, dx, dy, dz, basis)
            for channel in range(3):
                colour = np.float32(0.5)
                for k in range((degree + 1) * (degree + 1)):
                    colour += basis[k] * sh[i, k, channel]
                clamped[i, channel] = colour < np.float32(0)
                splats[i, COLOUR + channel] = max(colour, np.float32(0))
        for k in range(3):
            splats[i, P + k] = constant[k] * scale
            splats[i, P + 3 + k] = along[k] * scale
            splats[i, P + 6 + k] = down[k] * scale
            splats[i, NORMAL + k] = turn * normal[k]
        splats[i, CENTRE], splats[i, CENTRE + 1], splats[i, OPACITY] = u, v, math.log2(opacity)
        depths[i] = np.float32(depth)


@compiled(parallel=True)
def project(
    means, scales, quaternions, homographies, opacities, sh, colours, degree, modifier, pose, pixels, position,
    width, height, splats, extents, depths, radii, clamped, boxes, slots,
):  # fmt: skip
    """Fill, for each disc: splat, extent, depth, radius, which channels are clamped, box of strips, how many they are.

    Args:
        means, scales, quaternions, opacities: [N, ...].
        homographies: [N, 9], in place of scales and quaternions, or [0, 9].
        sh, degree: [N, K, 3], harmonics.
        colours: [N, 3] in their place, or [0, 3].
        modifier: of the scales.
        pose: [4, 4], world to camera, for points that are rows.
        pixels: [4, 3], world to homogeneous pixels, likewise.
        position: [3], of the camera.
        width, height: of the image.
        splats, extents, depths, radii, clamped, boxes, slots: what is filled.
    """
    count = len(means)
    for block in prange((count + BLOCK - 1) // BLOCK):
        begin = block * BLOCK
        _project_block(
            begin, min(begin + BLOCK, count), means, scales, quaternions, homographies, opacities, sh, colours, degree,
            modifier, pose, pixels, position, width, height, splats, extents, depths, radii, clamped, boxes, slots,
        )  # fmt: skip


@compiled()
def _rows(extents, i, left, right):
    """The first and last row, any numbers, that a disc reaches in the columns from `left` to `right`."""
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


@compiled()
def origin(strip_x, strip_y, rows):
    """The pixel about which an entry is written: amid the rows that it reaches."""
    first, end, _ = unpacked(rows)
    return strip_x * WIDE + 0.5 * (WIDE - 1), strip_y * TALL + 0.5 * (first + end - 1)


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
def _plus(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled()
def _rows_gradient(x, y, w, u, v, sums):
    """Gradients of T's rows from those of p, of the depths, and of what came through w alone."""
    _, along, down, scale, centred_x, centred_y = _bent(x, y, w, u, v)
    constant = _cross(centred_x, centred_y)
    ga = sums[0] * scale, sums[1] * scale, sums[2] * scale
    gb = sums[3] * scale, sums[4] * scale, sums[5] * scale
    gc = sums[6] * scale, sums[7] * scale, sums[8] * scale
    gd = sums[G_DEPTH] * scale
    gx = _less(_plus(_cross(centred_y, ga), _cross(gc, w)), along, -gd)
    gy = _less(_plus(_cross(ga, centred_x), _cross(w, gb)), down, -gd)
    gw = _less(_plus(_cross(gb, centred_y), _cross(centred_x, gc)), constant, -gd)
    gw = _less(_less(gw, gx, u), gy, v)
    return gx, gy, (gw[0] + sums[G_DIRECT], gw[1] + sums[G_DIRECT + 1], gw[2] + sums[G_DIRECT + 2])


@compiled()
def _across(gx, gy, gw, pixels, a, k):
    """Gradient to the `a`-th number of what row-wise became column `k` of T."""
    return gx[k] * pixels[a, 0] + gy[k] * pixels[a, 1] + gw[k] * pixels[a, 2]


@compiled()
def _project_backward_block(
    begin, end, means, scales, quaternions, homographies, opacities, sh, colours, degree, modifier, pose, pixels,
    position, half, splats, clamped, firsts, gradients,
    g_means, g_scales, g_quaternions, g_homographies, g_opacities, g_sh, g_colours, g_view,
):  # fmt: skip
    handed = len(homographies) > 0
    coefficients = (degree + 1) * (degree + 1)
    basis, g_basis = np.empty(16, np.float32), np.empty(16, np.float32)
    sums = np.empty(GRADIENTS, np.float64)
    for i in range(begin, end):
        if firsts[i, FIRST_SUM] == firsts[i + 1, FIRST_SUM]:
            g_means[i] = 0
            g_opacities[i] = 0
            g_view[i] = 0
            if handed:
                g_homographies[i] = 0
            else:
                g_scales[i] = 0
                g_quaternions[i] = 0
            if len(colours) > 0:
                g_colours[i] = 0
            else:
                g_sh[i] = 0
            continue
        sums[:] = 0
        for row in range(firsts[i, FIRST_SUM], firsts[i + 1, FIRST_SUM]):
            for k in range(GRADIENTS):
                sums[k] += gradients[row, k]
        g_opacities[i, 0] = sums[G_OPACITY] / opacities[i, 0]
        x, y, w, _, turn = _shape(means, scales, quaternions, homographies, i, modifier, pose, pixels)
        gx, gy, gw = _rows_gradient(x, y, w, splats[i, CENTRE], splats[i, CENTRE + 1], sums)
        tap_x, tap_y = gx[2], gy[2]
        from_x, from_y, from_w = _box_gradient(x, y, w, sums[G_CENTRE], sums[G_CENTRE + 1])
        gx, gy, gw = _plus(gx, from_x), _plus(gy, from_y), _plus(gw, from_w)
        # As upstream: the view-space gradient leaves out what comes through the screen-space Gaussian's centre, but
        # for homographies that were handed in.
        if handed:
            tap_x, tap_y = gx[2], gy[2]
        g_view[i, 0], g_view[i, 1], g_view[i, 2] = tap_x * w[2] * half[0], tap_y * w[2] * half[1], 0

        mx = my = mz = 0.0
        if len(colours) > 0:
            g_colours[i, 0], g_colours[i, 1], g_colours[i, 2] = sums[G_COLOUR], sums[G_COLOUR + 1], sums[G_COLOUR + 2]
        else:
            dx, dy, dz, distance = direction(means, i, position)
            harmonics(degree, dx, dy, dz, basis)
            red = np.float32(0) if clamped[i, 0] else np.float32(sums[G_COLOUR])
            green = np.float32(0) if clamped[i, 1] else np.float32(sums[G_COLOUR + 1])
            blue = np.float32(0) if clamped[i, 2] else np.float32(sums[G_COLOUR + 2])
            for k in range(coefficients):
                g_sh[i, k, 0], g_sh[i, k, 1], g_sh[i, k, 2] = basis[k] * red, basis[k] * green, basis[k] * blue
                g_basis[k] = red * sh[i, k, 0] + green * sh[i, k, 1] + blue * sh[i, k, 2]
            g_sh[i, coefficients:] = 0
            vx, vy, vz = harmonics_gradient(degree, dx, dy, dz, g_basis)
            across = vx * dx + vy * dy + vz * dz
            nearness = 1 / distance
            mx, my, mz = (vx - across * dx) * nearness, (vy - across * dy) * nearness, (vz - across * dz) * nearness
        if handed:
            for k in range(3):
                g_homographies[i, k], g_homographies[i, 3 + k], g_homographies[i, 6 + k] = gx[k], gy[k], gw[k]
        else:
            mx += _across(gx, gy, gw, pixels, 0, 2)
            my += _across(gx, gy, gw, pixels, 1, 2)
            mz += _across(gx, gy, gw, pixels, 2, 2)
            axes, q, _ = _rotation(quaternions, i)
            long, short = modifier * np.float64(scales[i, 0]), modifier * np.float64(scales[i, 1])
            a0, a1, a2 = (
                _across(gx, gy, gw, pixels, 0, 0),
                _across(gx, gy, gw, pixels, 1, 0),
                _across(gx, gy, gw, pixels, 2, 0),
            )
            b0, b1, b2 = (
                _across(gx, gy, gw, pixels, 0, 1),
                _across(gx, gy, gw, pixels, 1, 1),
                _across(gx, gy, gw, pixels, 2, 1),
            )
            g_scales[i, 0] = modifier * (a0 * axes[0] + a1 * axes[3] + a2 * axes[6])
            g_scales[i, 1] = modifier * (b0 * axes[1] + b1 * axes[4] + b2 * axes[7])
            n0, n1, n2 = turn * sums[G_NORMAL], turn * sums[G_NORMAL + 1], turn * sums[G_NORMAL + 2]
            # As upstream: the gradient of the normalised quaternion, handed on as it is.
            w0, w1, w2, w3 = quaternion_partials(
                (
                    long * a0, short * b0, n0 * pose[0, 0] + n1 * pose[0, 1] + n2 * pose[0, 2],
                    long * a1, short * b1, n0 * pose[1, 0] + n1 * pose[1, 1] + n2 * pose[1, 2],
                    long * a2, short * b2, n0 * pose[2, 0] + n1 * pose[2, 1] + n2 * pose[2, 2],
                ),
                q,
            )  # fmt: skip
            g_quaternions[i, 0], g_quaternions[i, 1], g_quaternions[i, 2], g_quaternions[i, 3] = w0, w1, w2, w3
        g_means[i, 0], g_means[i, 1], g_means[i, 2] = mx, my, mz


@compiled(parallel=True)
def project_backward(
    means, scales, quaternions, homographies, opacities, sh, colours, degree, modifier, pose, pixels, position, half,
    splats, clamped, firsts, gradients,
    g_means, g_scales, g_quaternions, g_homographies, g_opacities, g_sh, g_colours, g_view,
):  # fmt: skip
    """Fill the gradients `g_...` of each disc from its sums in the bands; those of what was not given stay empty."""
    count = len(means)
    for block in prange((count + BLOCK - 1) // BLOCK):
        begin = block * BLOCK
        _project_backward_block(
            begin, min(begin + BLOCK, count), means, scales, quaternions, homographies, opacities, sh, colours, degree,
            modifier, pose, pixels, position, half, splats, clamped, firsts, gradients,
            g_means, g_scales, g_quaternions, g_homographies, g_opacities, g_sh, g_colours, g_view,
        )  # fmt: skip
