"""The backward pass from splats to Gaussians (projection.py), a block of them at a time."""

# mypy: ignore-errors
# (numba infers the types, by its own rules: arrays of float32, or of float64 for geometry, and of integers)

from __future__ import annotations

import numpy as np

from legs_loss.kernels.compiling import claimed, compiled, inlined, part
from legs_loss.lab.rasterizer.geometry import (
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
from legs_loss.lab.rasterizer.harmonics import shade_gradient
from legs_loss.lab.rasterizer.projection import BLOCK, MEAN, SHAPE, lay_out
from legs_loss.lab.rasterizer.sorting import FIRST_SUM
from legs_loss.lab.rasterizer.strips import ABSOLUTE_MOMENTS, UNIT
from legs_loss.lab.simd.lanes import lane
from legs_loss.lab.simd.memory import load

# Rows of a block's state, behind mean and shape: the splat's own coordinates; the sums of dL/dpower, of its first and
# second moments by those coordinates, of the colour's gradient, and the two absolute ones. In place of mean and shape,
# then, their gradients.
AXES, POWER, FIRST, SECOND, COLOUR, ABSOLUTE = 10, 13, 14, 16, 19, 22

LENGTH = 1 / UNIT  # of a step of 1 in an entry's coordinates, in the splat's own


@part()
def _collect(first, end, sums, state, j):
    """Sum a Gaussian's gradients over the bands of the image into the state's column `j`."""
    total, blue, along_u, along_v = load(sums[first], 0), sums[first, 8], 0.0, 0.0
    for k in range(np.uint64(first + 1), np.uint64(end)):
        total = total + load(sums[k], 0)
        blue += sums[k, 8]
    if sums.shape[1] == ABSOLUTE_MOMENTS:
        for k in range(np.uint64(first), np.uint64(end)):
            along_u += sums[k, 9]
            along_v += sums[k, 10]
    state[POWER, j] = lane(total, 0)
    state[FIRST, j], state[FIRST + 1, j] = LENGTH * lane(total, 1), LENGTH * lane(total, 2)
    for k in range(3):
        state[SECOND + k, j] = LENGTH**2 * lane(total, 3 + k)
    state[COLOUR, j], state[COLOUR + 1, j], state[COLOUR + 2, j] = lane(total, 6), lane(total, 7), blue
    state[ABSOLUTE, j], state[ABSOLUTE + 1, j] = LENGTH**2 * along_u, LENGTH**2 * along_v


@inlined
def _in_the_image(state, j, intrinsics, pose):
    """Return mean and linear map of column `j`, and the gradients to the splat's centre and covariance."""
    x, y, z = to_camera(state[MEAN, j], state[MEAN + 1, j], state[MEAN + 2, j], pose)
    axes = state[AXES, j], state[AXES + 1, j], state[AXES + 2, j]
    gu, gv = centre_gradient(axes, state[FIRST, j], state[FIRST + 1, j])
    s00, s01, s11 = covariance_gradient(axes, state[SECOND, j], state[SECOND + 1, j], state[SECOND + 2, j])
    return x, y, z, linearised(x, y, z, intrinsics, pose), gu, gv, s00, s01, s11


@part()
def _shapes_backward(count, intrinsics, pose, state):
    intrinsics, pose = numbers(intrinsics, pose)
    for j in range(np.uint64(count)):
        x, y, z, t, gu, gv, s00, s01, s11 = _in_the_image(state, j, intrinsics, pose)
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
            e0 * r[0] + e1 * r[1] + e2 * r[2], e0 * r[3] + e1 * r[4] + e2 * r[5], e0 * r[6] + e1 * r[7] + e2 * r[8],
            e3 * r[0] + e4 * r[1] + e5 * r[2], e3 * r[3] + e4 * r[4] + e5 * r[5], e3 * r[6] + e4 * r[7] + e5 * r[8],
        )  # fmt: skip
        gx, gy, gz = mean_gradient(x, y, z, gu, gv, g_t, intrinsics, pose)
        state[MEAN, j], state[MEAN + 1, j], state[MEAN + 2, j] = gx, gy, gz


@part()
def _covariances_backward(count, intrinsics, pose, state):
    intrinsics, pose = numbers(intrinsics, pose)
    for j in range(np.uint64(count)):
        x, y, z, t, gu, gv, s00, s01, s11 = _in_the_image(state, j, intrinsics, pose)
        xx, xy, xz = state[SHAPE, j], state[SHAPE + 1, j], state[SHAPE + 2, j]
        yy, yz, zz = state[SHAPE + 3, j], state[SHAPE + 4, j], state[SHAPE + 5, j]
        # The image's is T V T^t: 2 G T V; and to V, of which the triangle has three numbers that stand twice.
        u = times_covariance(t, (xx, xy, xz, yy, yz, zz))
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


@part()
def _no_gradient(i, g_means, g_scales, g_quaternions, g_opacities, g_sh, g_covariances):
    """Set the gradients of a Gaussian that was not drawn."""
    g_means[i] = 0
    if g_scales is not None:
        g_scales[i] = 0
        g_quaternions[i] = 0
    if g_covariances is not None:
        g_covariances[i] = 0
    g_opacities[i] = 0
    g_sh[i] = 0


@part()
def _take_out(g_scales, g_quaternions, g_covariances, i, state, j):
    """Read the gradients of a Gaussian's shape from column `j` of a block's state."""
    if g_scales is not None:
        for k in range(3):
            g_scales[i, k] = state[SHAPE + k, j]
        for k in range(4):
            g_quaternions[i, k] = state[SHAPE + 3 + k, j]
    if g_covariances is not None:
        for k in range(6):
            g_covariances[i, k] = state[SHAPE + k, j]


@part()
def _backward(scales, covariances, count, intrinsics, pose, state):
    """Do what there is to do, as `_in_the_image` of projection.py."""
    if scales is not None:
        _shapes_backward(count, intrinsics, pose, state)
    if covariances is not None:
        _covariances_backward(count, intrinsics, pose, state)


@inlined
def _project_backward_block(own, first, end, parameters, camera, splats, clamped, firsts, sums, gradients, g_view):
    means, scales, quaternions, opacities, sh, covariances = parameters
    degree, intrinsics, pose, position, size = camera
    g_means, g_scales, g_quaternions, g_opacities, g_sh, g_covariances = gradients
    half = size[0] / 2, size[1] / 2
    (state, drawn, eight), count = own, np.int64(0)
    for i in range(np.uint64(first), np.uint64(end)):
        if firsts[i, FIRST_SUM] == firsts[i + np.uint64(1), FIRST_SUM]:
            _no_gradient(i, g_means, g_scales, g_quaternions, g_opacities, g_sh, g_covariances)
            g_view[i] = 0
            continue
        _collect(firsts[i, FIRST_SUM], firsts[i + np.uint64(1), FIRST_SUM], sums, state, count)
        lay_out(means, scales, quaternions, covariances, i, state, count)
        for k in range(3):
            state[AXES + k, count] = splats[i, 2 + k]
        drawn[count] = i
        count += 1
    _backward(scales, covariances, count, intrinsics, pose, state)
    # The colour: to the coefficients, and through the direction to the mean.
    colours, towards = state[COLOUR : COLOUR + 3], state[MEAN : MEAN + 3]
    shade_gradient(eight, drawn, count, means, position, degree, sh, clamped, colours, towards, g_sh)
    for j in range(np.uint64(count)):
        i = np.uint64(drawn[j])
        _take_out(g_scales, g_quaternions, g_covariances, i, state, j)
        g_opacities[i, 0] = state[POWER, j] / opacities[i, 0]
        axes = state[AXES, j], state[AXES + 1, j], state[AXES + 2, j]
        gu, gv = centre_gradient(axes, state[FIRST, j], state[FIRST + 1, j])
        g_view[i, 0], g_view[i, 1] = gu * half[0], gv * half[1]
        if g_view.shape[1] == 4:
            g_view[i, 2], g_view[i, 3] = state[ABSOLUTE, j] * half[0], state[ABSOLUTE + 1, j] * half[1]
        for k in range(3):
            g_means[i, k] = state[MEAN + k, j]


@compiled()
def project_backward(own, counter, blocks, parameters, camera, splats, clamped, firsts, sums, gradients, g_view):
    """Fill the gradients of each Gaussian from the sums of its entries'; of what is None, there is none.

    Args:
        own, counter, blocks: of `in_threads`, and of `memory`; a block is BLOCK Gaussians.
        parameters, gradients: `Parameters`, with None in the same places.
        camera: `GaussianCamera`.
        splats: [N, 9], as projected.
        clamped: [N, 3].
        firsts: [N + 1, 2], from the sorting.
        sums: [bands, MOMENTS or ABSOLUTE_MOMENTS].
        g_view: [N, 2 or 4], the view-space gradient, and that of absolute values.
    """
    count, block = len(parameters.means), claimed(counter)
    while block < blocks:
        first = block * BLOCK
        end = min(first + BLOCK, count)
        _project_backward_block(own, first, end, parameters, camera, splats, clamped, firsts, sums, gradients, g_view)
        block = claimed(counter)
