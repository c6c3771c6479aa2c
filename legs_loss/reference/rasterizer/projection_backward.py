"""The gradient's way back from splats to Gaussians (projection.py), a block of them at a time."""

# mypy: ignore-errors
# (numba infers the types, by its own rules: arrays of float32, or of float64 for geometry, and of integers)

from __future__ import annotations

import numpy as np
from numba import prange

from legs_loss.kernels.compiling import compiled
from legs_loss.reference.rasterizer.geometry import (
    centre_gradient,
    covariance_gradient,
    linearised,
    mean_gradient,
    numbers,
    quaternion_gradient,
    rotation,
    times_covariance,
    times_rotation,
    to_camera,
)
from legs_loss.reference.rasterizer.harmonics import direction, harmonics, harmonics_gradient
from legs_loss.reference.rasterizer.intrinsics import prefetch
from legs_loss.reference.rasterizer.projection import BLOCK, MEAN, SHAPE, TALL, lay_out, origin

AHEAD = 4  # how many Gaussians before their turn the gradients of their entries are asked for

# Rows of a block's state, behind mean and shape: its splat's conic, and the sums over its entries. In place of mean and
# shape, then, their gradients.
CONIC, SUMS = 10, 13
# Of the sums: moments of h about the splat's centre (h; hx, hy; hxx, hxy, hyy), red, green, blue, two absolute ones.
POWER, FIRST, SECOND, RED, ABSOLUTE, END = 0, 1, 3, 6, 9, 11
STATE = SUMS + END, BLOCK + 8  # see projection.py


@compiled()
def _ask_for(first, count, slot_rows, places, gradients):
    """Ask for the gradients of a Gaussian's slots, or of the first few of a giant's, ahead of `_collect`."""
    for slot in range(first, first + min(count, 16)):
        if slot_rows[slot] != 0:
            prefetch(gradients, places[slot])


@compiled()
def _collect(splats, boxes, i, slot_rows, places, slot, gradients, state, j):
    """Sum a Gaussian's gradients over its slots, from `slot` on, into the state's column `j`, in a fixed order.

    A row of `gradients` holds the moments of h = dL/dpower about its origin: h, hx, hy, hxx, hxy, hyy; then red, green,
    blue, and the two absolute sums.
    """
    u, v = splats[i, 0], splats[i, 1]
    m = mx = my = mxx = mxy = myy = red = green = blue = absolute_u = absolute_v = 0.0
    for strip_y in range(boxes[i, 1] // TALL, (boxes[i, 3] - 1) // TALL + 1):
        for strip_x in range(boxes[i, 0], boxes[i, 2]):
            if slot_rows[slot] != 0:
                k = np.uint64(places[slot])
                h, hx, hy = np.float64(gradients[k, 0]), np.float64(gradients[k, 1]), np.float64(gradients[k, 2])
                x, y = origin(strip_x, strip_y, slot_rows[slot])
                x -= u
                y -= v
                about_x, about_y = hx + x * h, hy + y * h
                m += h
                mx += about_x
                my += about_y
                mxx += gradients[k, 3] + x * (hx + about_x)
                mxy += gradients[k, 4] + x * hy + y * about_x
                myy += gradients[k, 5] + y * (hy + about_y)
                red += gradients[k, 6]
                green += gradients[k, 7]
                blue += gradients[k, 8]
                absolute_u += gradients[k, 9]
                absolute_v += gradients[k, 10]
            slot += 1
    state[SUMS, j], state[SUMS + 1, j], state[SUMS + 2, j] = m, mx, my
    state[SUMS + 3, j], state[SUMS + 4, j], state[SUMS + 5, j] = mxx, mxy, myy
    state[SUMS + 6, j], state[SUMS + 7, j], state[SUMS + 8, j] = red, green, blue
    state[SUMS + 9, j], state[SUMS + 10, j] = absolute_u, absolute_v


@compiled()
def _shapes_backward(count, intrinsics, pose, state):
    intrinsics, pose = numbers(intrinsics, pose)
    for j in range(np.uint64(count)):
        x, y, z = to_camera(state[MEAN, j], state[MEAN + 1, j], state[MEAN + 2, j], pose)
        t = linearised(x, y, z, intrinsics, pose)
        a, b, c = state[CONIC, j], state[CONIC + 1, j], state[CONIC + 2, j]
        gu, gv = centre_gradient(a, b, c, state[SUMS + FIRST, j], state[SUMS + FIRST + 1, j])
        mxx, mxy, myy = state[SUMS + SECOND, j], state[SUMS + SECOND + 1, j], state[SUMS + SECOND + 2, j]
        s00, s01, s11 = covariance_gradient(a, b, c, mxx, mxy, myy)
        # The scaled axes U S, U = T R: 2 G U S.
        r, q, length = rotation(state[SHAPE + 3, j], state[SHAPE + 4, j], state[SHAPE + 5, j], state[SHAPE + 6, j])
        u = times_rotation(t, r)
        n0, n1, n2 = state[SHAPE, j], state[SHAPE + 1, j], state[SHAPE + 2, j]
        e0, e3 = 2 * (s00 * u[0] + s01 * u[3]), 2 * (s01 * u[0] + s11 * u[3])
        e1, e4 = 2 * (s00 * u[1] + s01 * u[4]), 2 * (s01 * u[1] + s11 * u[4])
        e2, e5 = 2 * (s00 * u[2] + s01 * u[5]), 2 * (s01 * u[2] + s11 * u[5])
        state[SHAPE, j] = n0 * (e0 * u[0] + e3 * u[3])
        state[SHAPE + 1, j] = n1 * (e1 * u[1] + e4 * u[4])
        state[SHAPE + 2, j] = n2 * (e2 * u[2] + e5 * u[5])
        e0, e1, e2, e3, e4, e5 = e0 * n0 * n0, e1 * n1 * n1, e2 * n2 * n2, e3 * n0 * n0, e4 * n1 * n1, e5 * n2 * n2
        g_rotation = (
            t[0] * e0 + t[3] * e3, t[0] * e1 + t[3] * e4, t[0] * e2 + t[3] * e5,
            t[1] * e0 + t[4] * e3, t[1] * e1 + t[4] * e4, t[1] * e2 + t[4] * e5,
            t[2] * e0 + t[5] * e3, t[2] * e1 + t[5] * e4, t[2] * e2 + t[5] * e5,
        )  # fmt: skip
        w0, w1, w2, w3 = quaternion_gradient(g_rotation, q, length)
        state[SHAPE + 3, j], state[SHAPE + 4, j], state[SHAPE + 5, j], state[SHAPE + 6, j] = w0, w1, w2, w3
        g_t = (
            e0 * r[0] + e1 * r[1] + e2 * r[2],
            e0 * r[3] + e1 * r[4] + e2 * r[5],
            e0 * r[6] + e1 * r[7] + e2 * r[8],
            e3 * r[0] + e4 * r[1] + e5 * r[2],
            e3 * r[3] + e4 * r[4] + e5 * r[5],
            e3 * r[6] + e4 * r[7] + e5 * r[8],
        )
        gx, gy, gz = mean_gradient(x, y, z, gu, gv, g_t, intrinsics, pose)
        state[MEAN, j], state[MEAN + 1, j], state[MEAN + 2, j] = gx, gy, gz


@compiled()
def _covariances_backward(count, intrinsics, pose, state):
    intrinsics, pose = numbers(intrinsics, pose)
    for j in range(np.uint64(count)):
        x, y, z = to_camera(state[MEAN, j], state[MEAN + 1, j], state[MEAN + 2, j], pose)
        t = linearised(x, y, z, intrinsics, pose)
        a, b, c = state[CONIC, j], state[CONIC + 1, j], state[CONIC + 2, j]
        gu, gv = centre_gradient(a, b, c, state[SUMS + FIRST, j], state[SUMS + FIRST + 1, j])
        mxx, mxy, myy = state[SUMS + SECOND, j], state[SUMS + SECOND + 1, j], state[SUMS + SECOND + 2, j]
        s00, s01, s11 = covariance_gradient(a, b, c, mxx, mxy, myy)
        v = (
            state[SHAPE, j],
            state[SHAPE + 1, j],
            state[SHAPE + 2, j],
            state[SHAPE + 3, j],
            state[SHAPE + 4, j],
            state[SHAPE + 5, j],
        )
        # The image's is T V T^t: 2 G T V; and to V, of which the triangle has three numbers that stand twice.
        u = times_covariance(t, v)
        h0, h1, h2 = s00 * t[0] + s01 * t[3], s00 * t[1] + s01 * t[4], s00 * t[2] + s01 * t[5]
        h3, h4, h5 = s01 * t[0] + s11 * t[3], s01 * t[1] + s11 * t[4], s01 * t[2] + s11 * t[5]
        state[SHAPE, j], state[SHAPE + 3, j] = t[0] * h0 + t[3] * h3, t[1] * h1 + t[4] * h4
        state[SHAPE + 5, j] = t[2] * h2 + t[5] * h5
        state[SHAPE + 1, j] = 2 * (t[0] * h1 + t[3] * h4)
        state[SHAPE + 2, j] = 2 * (t[0] * h2 + t[3] * h5)
        state[SHAPE + 4, j] = 2 * (t[1] * h2 + t[4] * h5)
        g_t = (
            2 * (s00 * u[0] + s01 * u[3]), 2 * (s00 * u[1] + s01 * u[4]), 2 * (s00 * u[2] + s01 * u[5]),
            2 * (s01 * u[0] + s11 * u[3]), 2 * (s01 * u[1] + s11 * u[4]), 2 * (s01 * u[2] + s11 * u[5]),
        )  # fmt: skip
        gx, gy, gz = mean_gradient(x, y, z, gu, gv, g_t, intrinsics, pose)
        state[MEAN, j], state[MEAN + 1, j], state[MEAN + 2, j] = gx, gy, gz


@compiled()
def _project_backward_block(
    first, end, means, scales, quaternions, opacities, sh, covariances, degree, intrinsics, pose, position,
    splats, clamped, boxes, slots, first_slots, slot_rows, places, entry_gradients, half,
    g_means, g_scales, g_quaternions, g_opacities, g_sh, g_covariances, g_view,
):  # fmt: skip
    coefficients = (degree + 1) * (degree + 1)
    basis, g_basis = np.empty(16, np.float32), np.empty(16, np.float32)
    state, drawn, count = np.empty(STATE), np.empty(BLOCK, np.int64), np.int64(0)
    for i in range(first, end):
        if i + AHEAD < end:
            _ask_for(first_slots[i + AHEAD], slots[i + AHEAD], slot_rows, places, entry_gradients)
        if slots[i] == 0:
            g_means[i] = 0
            if scales is not None:
                g_scales[i] = 0
                g_quaternions[i] = 0
            if covariances is not None:
                g_covariances[i] = 0
            g_opacities[i] = 0
            g_sh[i] = 0
            g_view[i] = 0
            continue
        _collect(splats, boxes, i, slot_rows, places, first_slots[i], entry_gradients, state, count)
        lay_out(means, scales, quaternions, covariances, i, state, count)
        for k in range(3):
            state[CONIC + k, count] = splats[i, 2 + k]
        drawn[count] = i
        count += 1
    if scales is not None:
        _shapes_backward(count, intrinsics, pose, state)
    if covariances is not None:
        _covariances_backward(count, intrinsics, pose, state)
    for j in range(np.uint64(count)):
        i = np.uint64(drawn[j])
        if scales is not None:
            for k in range(3):
                g_scales[i, k] = state[SHAPE + k, j]
            for k in range(4):
                g_quaternions[i, k] = state[SHAPE + 3 + k, j]
        if covariances is not None:
            for k in range(6):
                g_covariances[i, k] = state[SHAPE + k, j]
        g_opacities[i, 0] = state[SUMS + POWER, j] / opacities[i, 0]
        a, b, c = state[CONIC, j], state[CONIC + 1, j], state[CONIC + 2, j]
        gu, gv = centre_gradient(a, b, c, state[SUMS + FIRST, j], state[SUMS + FIRST + 1, j])
        g_view[i, 0], g_view[i, 1] = gu * half[0], gv * half[1]
        if g_view.shape[1] == 4:
            g_view[i, 2], g_view[i, 3] = state[SUMS + ABSOLUTE, j] * half[0], state[SUMS + ABSOLUTE + 1, j] * half[1]

        # Colour: to the coefficients, and through the direction to the mean.
        dx, dy, dz, distance = direction(means, i, position)
        harmonics(degree, dx, dy, dz, basis)
        red = np.float32(0) if clamped[i, 0] else np.float32(state[SUMS + RED, j])
        green = np.float32(0) if clamped[i, 1] else np.float32(state[SUMS + RED + 1, j])
        blue = np.float32(0) if clamped[i, 2] else np.float32(state[SUMS + RED + 2, j])
        for k in range(coefficients):
            g_sh[i, k, 0], g_sh[i, k, 1], g_sh[i, k, 2] = basis[k] * red, basis[k] * green, basis[k] * blue
            g_basis[k] = red * sh[i, k, 0] + green * sh[i, k, 1] + blue * sh[i, k, 2]
        g_sh[i, coefficients:] = 0
        vx, vy, vz = harmonics_gradient(degree, dx, dy, dz, g_basis)
        along = vx * dx + vy * dy + vz * dz
        nearness = 1 / distance
        g_means[i, 0] = state[MEAN, j] + (vx - along * dx) * nearness
        g_means[i, 1] = state[MEAN + 1, j] + (vy - along * dy) * nearness
        g_means[i, 2] = state[MEAN + 2, j] + (vz - along * dz) * nearness


@compiled(parallel=True)
def project_backward(
    means, scales, quaternions, opacities, sh, covariances, degree, intrinsics, pose, position,
    splats, clamped, boxes, slots, first_slots, slot_rows, places, entry_gradients, half,
    g_means, g_scales, g_quaternions, g_opacities, g_sh, g_covariances, g_view,
):  # fmt: skip
    """Fill the gradients `g_...` of each Gaussian from those of its entries; of what is None, there is none."""
    count = len(means)
    for block in prange((count + BLOCK - 1) // BLOCK):
        first = block * BLOCK
        _project_backward_block(
            first, min(first + BLOCK, count), means, scales, quaternions, opacities, sh, covariances, degree,
            intrinsics, pose, position, splats, clamped, boxes, slots, first_slots, slot_rows, places, entry_gradients,
            half, g_means, g_scales, g_quaternions, g_opacities, g_sh, g_covariances, g_view,
        )  # fmt: skip
