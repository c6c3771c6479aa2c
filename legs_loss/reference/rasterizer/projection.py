"""The compiled rasterizer's work for each Gaussian: from three dimensions to a splat, and the gradient's way back.

A splat is a row of ten float64 numbers: centre (u, v) in pixels, conic (A, B, C), logarithm of the opacity, colour
(r, g, b), and the determinant of its covariance. All steps are those of oracle.py. The geometry is computed in
float64, and the determinant as a sum of squares (Cauchy-Binet), since a needle's a c - b b cancels to nothing.
"""

# mypy: ignore-errors
# (numba infers the types, by its own rules: arrays of float32, or of float64 for geometry, and of integers)

from __future__ import annotations

import math

import numpy as np
from numba import prange

from legs_loss.kernels.compiling import compiled
from legs_loss.reference.conventions import (
    FARTHEST,
    MIN_ALPHA,
    NEAR,
    SH_C0,
    SH_C1,
    SH_C2,
    SH_C3,
    SQUARE,
    TILE,
)
from legs_loss.reference.rasterizer.intrinsics import prefetch

BLOCK = 512  # Gaussians that one thread takes at a time
AHEAD = 4  # how many Gaussians before their turn the gradients of their entries are asked for
WIDE, TALL = 8, 32  # pixels: a strip of the image, see strips.py
FAINTEST = math.log(MIN_ALPHA) - 1e-3  # what is left out is fainter than MIN_ALPHA by more than rounding

_C0, _C1 = np.float32(SH_C0), np.float32(SH_C1)
_D0, _D1, _D2, _D3, _D4 = (np.float32(c) for c in SH_C2)
_E0, _E1, _E2, _E3, _E4, _E5, _E6 = (np.float32(c) for c in SH_C3)


@compiled()
def rotation(quaternions, i):
    """Row-major rotation matrix, the normalised quaternion, and the length it had."""
    w, x = np.float64(quaternions[i, 0]), np.float64(quaternions[i, 1])
    y, z = np.float64(quaternions[i, 2]), np.float64(quaternions[i, 3])
    length = max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    shorter = 1 / length
    w, x, y, z = w * shorter, x * shorter, y * shorter, z * shorter
    matrix = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )
    return matrix, (w, x, y, z), length


@compiled()
def _to_camera(means, i, pose):
    """The centre in the camera's axes."""
    a, b, c = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
    x = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3]
    y = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3]
    z = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3]
    return x, y, z


@compiled()
def _held(value, z, limit):
    """`value` (x or y), held where value / z leaves the guard, and whether it moves freely."""
    most = limit * z
    return max(min(value, most), -most), abs(value) <= most


@compiled()
def _linearised(fx, fy, held_x, held_y, z, pose):
    """The 2x3 map from world directions to pixels at the Gaussian's centre, row-major."""
    inverse = 1 / z
    j00, j11 = fx * inverse, fy * inverse
    j02, j12 = -j00 * held_x * inverse, -j11 * held_y * inverse
    return (
        j00 * pose[0, 0] + j02 * pose[2, 0],
        j00 * pose[0, 1] + j02 * pose[2, 1],
        j00 * pose[0, 2] + j02 * pose[2, 2],
        j11 * pose[1, 0] + j12 * pose[2, 0],
        j11 * pose[1, 1] + j12 * pose[2, 1],
        j11 * pose[1, 2] + j12 * pose[2, 2],
    )


@compiled()
def _times_rotation(t, r):
    """A 2x3 matrix times a 3x3 one."""
    return (
        t[0] * r[0] + t[1] * r[3] + t[2] * r[6],
        t[0] * r[1] + t[1] * r[4] + t[2] * r[7],
        t[0] * r[2] + t[1] * r[5] + t[2] * r[8],
        t[3] * r[0] + t[4] * r[3] + t[5] * r[6],
        t[3] * r[1] + t[4] * r[4] + t[5] * r[7],
        t[3] * r[2] + t[4] * r[5] + t[5] * r[8],
    )


@compiled()
def _times_covariance(t, v, i):
    """A 2x3 matrix times a Gaussian's covariance, given by the upper triangle's rows."""
    xx, xy, xz = np.float64(v[i, 0]), np.float64(v[i, 1]), np.float64(v[i, 2])
    yy, yz, zz = np.float64(v[i, 3]), np.float64(v[i, 4]), np.float64(v[i, 5])
    return (
        t[0] * xx + t[1] * xy + t[2] * xz,
        t[0] * xy + t[1] * yy + t[2] * yz,
        t[0] * xz + t[1] * yz + t[2] * zz,
        t[3] * xx + t[4] * xy + t[5] * xz,
        t[3] * xy + t[4] * yy + t[5] * yz,
        t[3] * xz + t[4] * yz + t[5] * zz,
    )


@compiled()
def direction(means, i, position):
    """From the camera's centre to the Gaussian's, of length 1, and the length it had."""
    x, y, z = means[i, 0] - position[0], means[i, 1] - position[1], means[i, 2] - position[2]
    length = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    shorter = 1 / length
    return np.float32(x * shorter), np.float32(y * shorter), np.float32(z * shorter), length


@compiled()
def harmonics(degree, x, y, z, basis):
    """Fill `basis` with the spherical harmonics of a direction."""
    two, three, four = np.float32(2), np.float32(3), np.float32(4)
    basis[0] = _C0
    if degree > 0:
        basis[1], basis[2], basis[3] = -_C1 * y, _C1 * z, -_C1 * x
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        basis[4], basis[5], basis[6] = _D0 * x * y, _D1 * y * z, _D2 * (two * zz - xx - yy)
        basis[7], basis[8] = _D3 * x * z, _D4 * (xx - yy)
        if degree > 2:
            basis[9] = _E0 * y * (three * xx - yy)
            basis[10] = _E1 * x * y * z
            basis[11] = _E2 * y * (four * zz - xx - yy)
            basis[12] = _E3 * z * (two * zz - three * (xx + yy))
            basis[13] = _E4 * x * (four * zz - xx - yy)
            basis[14] = _E5 * z * (xx - yy)
            basis[15] = _E6 * x * (xx - three * yy)


@compiled()
def harmonics_gradient(degree, x, y, z, g):
    """Gradient to the direction, from the gradient `g` to each of its harmonics."""
    two, three, four, six, eight = np.float32(2), np.float32(3), np.float32(4), np.float32(6), np.float32(8)
    gx = gy = gz = np.float32(0)
    if degree > 0:
        gx, gy, gz = -_C1 * g[3], -_C1 * g[1], _C1 * g[2]
    if degree > 1:
        gx += _D0 * y * g[4] - two * _D2 * x * g[6] + _D3 * z * g[7] + two * _D4 * x * g[8]
        gy += _D0 * x * g[4] + _D1 * z * g[5] - two * _D2 * y * g[6] - two * _D4 * y * g[8]
        gz += _D1 * y * g[5] + four * _D2 * z * g[6] + _D3 * x * g[7]
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        gx += (
            six * _E0 * x * y * g[9]
            + _E1 * y * z * g[10]
            - two * _E2 * x * y * g[11]
            - six * _E3 * x * z * g[12]
            + _E4 * (four * zz - three * xx - yy) * g[13]
            + two * _E5 * x * z * g[14]
            + three * _E6 * (xx - yy) * g[15]
        )
        gy += (
            three * _E0 * (xx - yy) * g[9]
            + _E1 * x * z * g[10]
            + _E2 * (four * zz - xx - three * yy) * g[11]
            - six * _E3 * y * z * g[12]
            - two * _E4 * x * y * g[13]
            - two * _E5 * y * z * g[14]
            - six * _E6 * x * y * g[15]
        )
        gz += (
            _E1 * x * y * g[10]
            + eight * _E2 * y * z * g[11]
            + three * _E3 * (two * zz - xx - yy) * g[12]
            + eight * _E4 * x * z * g[13]
            + _E5 * (xx - yy) * g[14]
        )
    return gx, gy, gz


@compiled()
def floor(value):
    """As an integer, within 1e8 of 0."""
    return np.int64(math.floor(max(min(value, 1e8), -1e8)))


@compiled()
def ceil(value):
    """As an integer, within 1e8 of 0."""
    return -floor(-value)


@compiled()
def tile_range(centre, radius, tiles):
    """First tile of the square around a splat, and the one past the last, by 3DGS's rounding."""
    first, end = floor((centre - radius) / TILE), floor((centre + radius + (TILE - 1)) / TILE)
    return min(max(first, 0), tiles), min(max(end, 0), tiles)


@compiled()
def _project_block(
    first, end, means, scales, quaternions, opacities, sh, covariances, degree, intrinsics, pose, position, size,
    dilation, square, splats, depths, radii, clamped, boxes, slots,
):  # fmt: skip
    fx, fy, cx, cy, limit_x, limit_y = intrinsics
    basis = np.empty(16, np.float32)
    coefficients = (degree + 1) * (degree + 1)
    for i in range(np.uint64(first), np.uint64(end)):
        radii[i] = 0
        slots[i] = 0
        x, y, z = _to_camera(means, i, pose)
        if not z > NEAR:
            continue
        held_x, _ = _held(x, z, limit_x)
        held_y, _ = _held(y, z, limit_y)
        t = _linearised(fx, fy, held_x, held_y, z, pose)
        if len(covariances) > 0:
            u = _times_covariance(t, covariances, i)
            a = u[0] * t[0] + u[1] * t[1] + u[2] * t[2]
            b = u[0] * t[3] + u[1] * t[4] + u[2] * t[5]
            c = u[3] * t[3] + u[4] * t[4] + u[5] * t[5]
            # A matrix that was handed in need be no covariance.
            determinant = dilation * (a + c + dilation) + a * c - b * b
            if not (determinant > 0 and a + dilation > 0):
                continue
        else:
            r, _, _ = rotation(quaternions, i)
            u = _times_rotation(t, r)
            s0, s1, s2 = np.float64(scales[i, 0]) ** 2, np.float64(scales[i, 1]) ** 2, np.float64(scales[i, 2]) ** 2
            a = u[0] * u[0] * s0 + u[1] * u[1] * s1 + u[2] * u[2] * s2
            b = u[0] * u[3] * s0 + u[1] * u[4] * s1 + u[2] * u[5] * s2
            c = u[3] * u[3] * s0 + u[4] * u[4] * s1 + u[5] * u[5] * s2
            determinant = dilation * (a + c + dilation)
            determinant += (u[0] * u[4] - u[1] * u[3]) ** 2 * s0 * s1
            determinant += (u[0] * u[5] - u[2] * u[3]) ** 2 * s0 * s2
            determinant += (u[1] * u[5] - u[2] * u[4]) ** 2 * s1 * s2
        a += dilation
        c += dilation
        middle = 0.5 * (a + c)
        largest = middle + math.sqrt(max(0.1, middle * middle - determinant))
        radius = min(math.ceil(SQUARE * math.sqrt(largest)), float(FARTHEST))
        reach = radius if square == SQUARE else min(math.ceil(square * math.sqrt(largest)), float(FARTHEST))
        nearness = 1 / z
        centre_x, centre_y = fx * x * nearness + cx - 0.5, fy * y * nearness + cy - 0.5
        left, right = tile_range(centre_x, reach, -(-size[0] // TILE))
        top, bottom = tile_range(centre_y, reach, -(-size[1] // TILE))
        if right <= left or bottom <= top:
            continue
        radii[i] = np.int32(radius)
        inverse = 1 / determinant
        splats[i, 0], splats[i, 1] = centre_x, centre_y
        splats[i, 2], splats[i, 3], splats[i, 4] = c * inverse, -b * inverse, a * inverse

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

        dx, dy, dz, _ = direction(means, i, position)
        harmonics(degree, dx, dy, dz, basis)
        for channel in range(3):
            colour = np.float32(0.5)
            for k in range(coefficients):
                colour += basis[k] * sh[i, k, channel]
            clamped[i, channel] = colour < np.float32(0)
            splats[i, 6 + channel] = max(colour, np.float32(0))
        splats[i, 5], splats[i, 9] = summit, determinant
        depths[i] = np.float32(z)


@compiled(parallel=True)
def project(
    means, scales, quaternions, opacities, sh, covariances, degree, intrinsics, pose, position, size,
    dilation, square, splats, depths, radii, clamped, boxes, slots,
):  # fmt: skip
    """Fill, for each Gaussian: splat, depth, radius, which channels are clamped, box of strips, how many they are.

    Shapes are `scales` and `quaternions`, or `covariances` [N, 6] (xx, xy, xz, yy, yz, zz); the others are [0, ...].
    """
    count = len(means)
    for block in prange((count + BLOCK - 1) // BLOCK):
        first = block * BLOCK
        _project_block(
            first, min(first + BLOCK, count), means, scales, quaternions, opacities, sh, covariances, degree,
            intrinsics, pose, position, size, dilation, square, splats, depths, radii, clamped, boxes, slots,
        )  # fmt: skip


@compiled()
def quaternion_partials(g, q):
    """From the gradient to the rotation matrix (row-major) to that of the four numbers in its formula."""
    w, x, y, z = q
    gw = 2 * (z * (g[3] - g[1]) + y * (g[2] - g[6]) + x * (g[7] - g[5]))
    gx = 2 * (y * (g[1] + g[3]) + z * (g[2] + g[6]) - 2 * x * (g[4] + g[8]) + w * (g[7] - g[5]))
    gy = 2 * (x * (g[1] + g[3]) + z * (g[5] + g[7]) - 2 * y * (g[0] + g[8]) + w * (g[2] - g[6]))
    gz = 2 * (x * (g[2] + g[6]) + y * (g[5] + g[7]) - 2 * z * (g[0] + g[4]) + w * (g[3] - g[1]))
    return gw, gx, gy, gz


@compiled()
def _quaternion_gradient(g, q, length):
    """As `quaternion_partials`, to the quaternion before its normalisation."""
    gw, gx, gy, gz = quaternion_partials(g, q)
    w, x, y, z = q
    along = w * gw + x * gx + y * gy + z * gz
    scale = 1 / length
    return (gw - w * along) * scale, (gx - x * along) * scale, (gy - y * along) * scale, (gz - z * along) * scale


@compiled()
def origin(strip_x, strip_y, rows):
    """The pixel coordinates about which a splat's polynomial in a strip is written: amid the rows that it reaches."""
    return strip_x * WIDE + 0.5 * (WIDE - 1), strip_y * TALL + 0.5 * ((rows & 255) + (rows >> 8) - 1)


@compiled()
def _ask_for(first, count, slot_rows, places, gradients):
    """Ask for the gradients of a Gaussian's slots, or of the first few of a giant's, ahead of `_collect`."""
    for slot in range(first, first + min(count, 16)):
        if slot_rows[slot] != 0:
            prefetch(gradients, places[slot])


@compiled()
def _collect(splats, boxes, i, slot_rows, places, slot, gradients, sums):
    """Sum a Gaussian's gradients over its slots, from `slot` on, into `sums`, in a fixed order.

    A row of `gradients` holds the moments of h = dL/dpower about its origin: h, hx, hy, hxx, hxy, hyy; then red, green,
    blue, and the two absolute sums. `sums`: u, v, A, B, C, h, red, green, blue, |u|, |v|.
    """
    sums[:] = 0.0
    u, v, a, b, c = splats[i, 0], splats[i, 1], splats[i, 2], splats[i, 3], splats[i, 4]
    for strip_y in range(boxes[i, 1] // TALL, (boxes[i, 3] - 1) // TALL + 1):
        for strip_x in range(boxes[i, 0], boxes[i, 2]):
            if slot_rows[slot] != 0:
                k = places[slot]
                h, hx, hy = np.float64(gradients[k, 0]), np.float64(gradients[k, 1]), np.float64(gradients[k, 2])
                x, y = origin(strip_x, strip_y, slot_rows[slot])
                x -= u
                y -= v
                sums[0] += (a * x + b * y) * h + a * hx + b * hy
                sums[1] += (b * x + c * y) * h + b * hx + c * hy
                sums[2] -= 0.5 * (gradients[k, 3] + x * (2 * hx + x * h))
                sums[3] -= gradients[k, 4] + x * hy + y * (hx + x * h)
                sums[4] -= 0.5 * (gradients[k, 5] + y * (2 * hy + y * h))
                sums[5] += h
                for field in range(6, 11):
                    sums[field] += gradients[k, field]
            slot += 1


@compiled()
def _project_backward_block(
    first, end, means, scales, quaternions, opacities, sh, covariances, degree, intrinsics, pose, position,
    splats, clamped, boxes, slots, first_slots, slot_rows, places, entry_gradients, half,
    g_means, g_scales, g_quaternions, g_opacities, g_sh, g_covariances, g_view,
):  # fmt: skip
    fx, fy, _, _, limit_x, limit_y = intrinsics
    coefficients = (degree + 1) * (degree + 1)
    basis, g_basis, sums = np.empty(16, np.float32), np.empty(16, np.float32), np.empty(11, np.float64)
    for i in range(first, end):
        if i + AHEAD < end:
            _ask_for(first_slots[i + AHEAD], slots[i + AHEAD], slot_rows, places, entry_gradients)
        if slots[i] == 0:
            g_means[i] = 0
            if len(covariances) > 0:
                g_covariances[i] = 0
            else:
                g_scales[i] = 0
                g_quaternions[i] = 0
            g_opacities[i] = 0
            g_sh[i] = 0
            g_view[i] = 0
            continue
        _collect(splats, boxes, i, slot_rows, places, first_slots[i], entry_gradients, sums)
        g_opacities[i, 0] = sums[5] / opacities[i, 0]
        g_view[i, 0], g_view[i, 1] = sums[0] * half[0], sums[1] * half[1]
        if g_view.shape[1] == 4:
            g_view[i, 2], g_view[i, 3] = sums[9] * half[0], sums[10] * half[1]

        # Colour: to the coefficients, and through the direction to the mean.
        dx, dy, dz, distance = direction(means, i, position)
        harmonics(degree, dx, dy, dz, basis)
        red = np.float32(0) if clamped[i, 0] else np.float32(sums[6])
        green = np.float32(0) if clamped[i, 1] else np.float32(sums[7])
        blue = np.float32(0) if clamped[i, 2] else np.float32(sums[8])
        for k in range(coefficients):
            g_sh[i, k, 0], g_sh[i, k, 1], g_sh[i, k, 2] = basis[k] * red, basis[k] * green, basis[k] * blue
            g_basis[k] = red * sh[i, k, 0] + green * sh[i, k, 1] + blue * sh[i, k, 2]
        g_sh[i, coefficients:] = 0
        vx, vy, vz = harmonics_gradient(degree, dx, dy, dz, g_basis)
        along = vx * dx + vy * dy + vz * dz
        nearness = 1 / distance
        mx, my, mz = (vx - along * dx) * nearness, (vy - along * dy) * nearness, (vz - along * dz) * nearness

        # Conic Q to covariance: -Q G Q, G the symmetric matrix of the conic's gradient.
        a, b, c = splats[i, 2], splats[i, 3], splats[i, 4]
        p00, p01 = a * sums[2] + b * sums[3] / 2, a * sums[3] / 2 + b * sums[4]
        p10, p11 = b * sums[2] + c * sums[3] / 2, b * sums[3] / 2 + c * sums[4]
        s00, s01, s11 = -(p00 * a + p01 * b), -(p00 * b + p01 * c), -(p10 * b + p11 * c)

        # Covariance to T = J W.
        x, y, z = _to_camera(means, i, pose)
        held_x, free_x = _held(x, z, limit_x)
        held_y, free_y = _held(y, z, limit_y)
        t = _linearised(fx, fy, held_x, held_y, z, pose)
        if len(covariances) > 0:
            # The image's is T V T^t: 2 G T V; and to V, of which the triangle has three numbers that stand twice.
            v = _times_covariance(t, covariances, i)
            t0, t1, t2 = 2 * (s00 * v[0] + s01 * v[3]), 2 * (s00 * v[1] + s01 * v[4]), 2 * (s00 * v[2] + s01 * v[5])
            t3, t4, t5 = 2 * (s01 * v[0] + s11 * v[3]), 2 * (s01 * v[1] + s11 * v[4]), 2 * (s01 * v[2] + s11 * v[5])
            h0, h1, h2 = s00 * t[0] + s01 * t[3], s00 * t[1] + s01 * t[4], s00 * t[2] + s01 * t[5]
            h3, h4, h5 = s01 * t[0] + s11 * t[3], s01 * t[1] + s11 * t[4], s01 * t[2] + s11 * t[5]
            g_covariances[i, 0], g_covariances[i, 3] = t[0] * h0 + t[3] * h3, t[1] * h1 + t[4] * h4
            g_covariances[i, 5] = t[2] * h2 + t[5] * h5
            g_covariances[i, 1] = 2 * (t[0] * h1 + t[3] * h4)
            g_covariances[i, 2] = 2 * (t[0] * h2 + t[3] * h5)
            g_covariances[i, 4] = 2 * (t[1] * h2 + t[4] * h5)
        else:
            # The scaled axes U S, U = T R: 2 G U S.
            r, q, length = rotation(quaternions, i)
            u = _times_rotation(t, r)
            n0, n1, n2 = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
            e0, e3 = 2 * (s00 * u[0] + s01 * u[3]), 2 * (s01 * u[0] + s11 * u[3])
            e1, e4 = 2 * (s00 * u[1] + s01 * u[4]), 2 * (s01 * u[1] + s11 * u[4])
            e2, e5 = 2 * (s00 * u[2] + s01 * u[5]), 2 * (s01 * u[2] + s11 * u[5])
            g_scales[i, 0] = n0 * (e0 * u[0] + e3 * u[3])
            g_scales[i, 1] = n1 * (e1 * u[1] + e4 * u[4])
            g_scales[i, 2] = n2 * (e2 * u[2] + e5 * u[5])
            e0, e1, e2, e3, e4, e5 = e0 * n0 * n0, e1 * n1 * n1, e2 * n2 * n2, e3 * n0 * n0, e4 * n1 * n1, e5 * n2 * n2
            g_rotation = (
                t[0] * e0 + t[3] * e3, t[0] * e1 + t[3] * e4, t[0] * e2 + t[3] * e5,
                t[1] * e0 + t[4] * e3, t[1] * e1 + t[4] * e4, t[1] * e2 + t[4] * e5,
                t[2] * e0 + t[5] * e3, t[2] * e1 + t[5] * e4, t[2] * e2 + t[5] * e5,
            )  # fmt: skip
            w0, w1, w2, w3 = _quaternion_gradient(g_rotation, q, length)
            g_quaternions[i, 0], g_quaternions[i, 1], g_quaternions[i, 2], g_quaternions[i, 3] = w0, w1, w2, w3
            t0, t1, t2 = (
                e0 * r[0] + e1 * r[1] + e2 * r[2],
                e0 * r[3] + e1 * r[4] + e2 * r[5],
                e0 * r[6] + e1 * r[7] + e2 * r[8],
            )
            t3, t4, t5 = (
                e3 * r[0] + e4 * r[1] + e5 * r[2],
                e3 * r[3] + e4 * r[4] + e5 * r[5],
                e3 * r[6] + e4 * r[7] + e5 * r[8],
            )

        # To the Jacobian, and with the centre's gradient to the mean.
        j00 = t0 * pose[0, 0] + t1 * pose[0, 1] + t2 * pose[0, 2]
        j02 = t0 * pose[2, 0] + t1 * pose[2, 1] + t2 * pose[2, 2]
        j11 = t3 * pose[1, 0] + t4 * pose[1, 1] + t5 * pose[1, 2]
        j12 = t3 * pose[2, 0] + t4 * pose[2, 1] + t5 * pose[2, 2]
        inverse = 1 / z
        ax, ay = fx * inverse, fy * inverse
        cx, cy = ax * sums[0], ay * sums[1]
        cz = -(x * cx + y * cy + ax * j00 + ay * j11) * inverse
        # As upstream: the derivative of held_x / z^2 as if held_x were a constant; where x is free, exactly right.
        cz += 2 * (ax * held_x * j02 + ay * held_y * j12) * inverse * inverse
        if free_x:
            cx -= ax * j02 * inverse
        if free_y:
            cy -= ay * j12 * inverse
        g_means[i, 0] = mx + pose[0, 0] * cx + pose[1, 0] * cy + pose[2, 0] * cz
        g_means[i, 1] = my + pose[0, 1] * cx + pose[1, 1] * cy + pose[2, 1] * cz
        g_means[i, 2] = mz + pose[0, 2] * cx + pose[1, 2] * cy + pose[2, 2] * cz


@compiled(parallel=True)
def project_backward(
    means, scales, quaternions, opacities, sh, covariances, degree, intrinsics, pose, position,
    splats, clamped, boxes, slots, first_slots, slot_rows, places, entry_gradients, half,
    g_means, g_scales, g_quaternions, g_opacities, g_sh, g_covariances, g_view,
):  # fmt: skip
    """Fill the gradients `g_...` of each Gaussian from those of its entries."""
    count = len(means)
    for block in prange((count + BLOCK - 1) // BLOCK):
        first = block * BLOCK
        _project_backward_block(
            first, min(first + BLOCK, count), means, scales, quaternions, opacities, sh, covariances, degree,
            intrinsics, pose, position, splats, clamped, boxes, slots, first_slots, slot_rows, places, entry_gradients,
            half, g_means, g_scales, g_quaternions, g_opacities, g_sh, g_covariances, g_view,
        )  # fmt: skip
