"""A splat's geometry and its gradient: formulas on one Gaussian's numbers, written into the loops that use them.

The steps are those of the tests' oracle, in float64. Nothing here branches or is handed an array (references to it
would be counted in the loop), so that the compiler takes four Gaussians at a time; reading and keeping is left to the
loops.
A 3x3 matrix is nine numbers, row by row; a 2x3 one is six.
"""

# mypy: ignore-errors
# (numba infers the types, by its own rules)

from __future__ import annotations

import math

from legs_loss.kernels.compiling import inlined


@inlined
def numbers(intrinsics, pose):
    """Return a camera's arrays as numbers: intrinsics [6], the first three rows of a pose. No loop reads them again."""
    fx, fy, cx, cy, limit_x, limit_y = intrinsics
    rows = (
        (pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]),
        (pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]),
        (pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]),
    )
    return (fx, fy, cx, cy, limit_x, limit_y), rows


@inlined
def to_camera(a, b, c, pose):
    """Return a point in the camera's axes."""
    x = pose[0][0] * a + pose[0][1] * b + pose[0][2] * c + pose[0][3]
    y = pose[1][0] * a + pose[1][1] * b + pose[1][2] * c + pose[1][3]
    z = pose[2][0] * a + pose[2][1] * b + pose[2][2] * c + pose[2][3]
    return x, y, z


@inlined
def rotation(w, x, y, z):
    """Return rotation matrix, the normalised quaternion, and the length it had."""
    length = max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    shorter = 1 / length
    w, x, y, z = w * shorter, x * shorter, y * shorter, z * shorter
    matrix = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return matrix, (w, x, y, z), length


@inlined
def held(value, z, limit):
    """Return `value` (x or y), held where value / z leaves the guard, and whether it moves freely."""
    most = limit * z
    return max(min(value, most), -most), abs(value) <= most


@inlined
def linearised(x, y, z, intrinsics, pose):
    """Return the 2x3 map from world directions to pixels at a point in the camera's axes."""
    fx, fy, _, _, limit_x, limit_y = intrinsics
    held_x, _ = held(x, z, limit_x)
    held_y, _ = held(y, z, limit_y)
    inverse = 1 / z
    j00, j11 = fx * inverse, fy * inverse
    j02, j12 = -j00 * held_x * inverse, -j11 * held_y * inverse
    return (
        j00 * pose[0][0] + j02 * pose[2][0], j00 * pose[0][1] + j02 * pose[2][1], j00 * pose[0][2] + j02 * pose[2][2],
        j11 * pose[1][0] + j12 * pose[2][0], j11 * pose[1][1] + j12 * pose[2][1], j11 * pose[1][2] + j12 * pose[2][2],
    )  # fmt: skip


@inlined
def times_rotation(t, r):
    """Return a 2x3 matrix times a 3x3 one."""
    return (
        t[0] * r[0] + t[1] * r[3] + t[2] * r[6], t[0] * r[1] + t[1] * r[4] + t[2] * r[7],
        t[0] * r[2] + t[1] * r[5] + t[2] * r[8], t[3] * r[0] + t[4] * r[3] + t[5] * r[6],
        t[3] * r[1] + t[4] * r[4] + t[5] * r[7], t[3] * r[2] + t[4] * r[5] + t[5] * r[8],
    )  # fmt: skip


@inlined
def times_covariance(t, v):
    """Return a 2x3 matrix times a covariance, given by its upper triangle's rows."""
    xx, xy, xz, yy, yz, zz = v
    return (
        t[0] * xx + t[1] * xy + t[2] * xz, t[0] * xy + t[1] * yy + t[2] * yz, t[0] * xz + t[1] * yz + t[2] * zz,
        t[3] * xx + t[4] * xy + t[5] * xz, t[3] * xy + t[4] * yy + t[5] * yz, t[3] * xz + t[4] * yz + t[5] * zz,
    )  # fmt: skip


@inlined
def quaternion_partials(g, q):
    """Return the gradient of the four numbers in a rotation matrix's formula, from the matrix's (row-major)."""
    w, x, y, z = q
    gw = 2 * (z * (g[3] - g[1]) + y * (g[2] - g[6]) + x * (g[7] - g[5]))
    gx = 2 * (y * (g[1] + g[3]) + z * (g[2] + g[6]) - 2 * x * (g[4] + g[8]) + w * (g[7] - g[5]))
    gy = 2 * (x * (g[1] + g[3]) + z * (g[5] + g[7]) - 2 * y * (g[0] + g[8]) + w * (g[2] - g[6]))
    gz = 2 * (x * (g[2] + g[6]) + y * (g[5] + g[7]) - 2 * z * (g[0] + g[4]) + w * (g[3] - g[1]))
    return gw, gx, gy, gz


@inlined
def quaternion_gradient(g, q, length):
    """Return the gradient as `quaternion_partials`, of the quaternion before its normalisation."""
    gw, gx, gy, gz = quaternion_partials(g, q)
    w, x, y, z = q
    along = w * gw + x * gx + y * gy + z * gz
    scale = 1 / length
    return (gw - w * along) * scale, (gx - x * along) * scale, (gy - y * along) * scale, (gz - z * along) * scale


@inlined
def own_axes(a, b, determinant):
    """Return a splat's own coordinates p x + q y and r x (x, y from its centre), in which its spread is 1 everywhere.

    Their squares add up to -2 times its power: conic = L^t L, L = [[p, q], [r, 0]]. From the covariance's xx and xy.
    """
    inverse = 1 / math.sqrt(a * determinant)
    return -b * inverse, a * inverse, 1 / math.sqrt(a)


@inlined
def conic(p, q, r):
    """Return the conic's xx, xy and yy."""
    return p * p + r * r, p * q, q * q


@inlined
def centre_gradient(axes, m1, m2):
    """Return the gradient of a splat's centre from the first moments of dL/dpower, by its own coordinates."""
    p, q, r = axes
    return p * m1 + r * m2, q * m1


@inlined
def covariance_gradient(axes, m11, m12, m22):
    """Return the gradient of the covariance's three numbers, L^t M L / 2, from the second moments, a matrix M."""
    p, q, r = axes
    p1, q1 = p * m11 + r * m12, q * m11
    return 0.5 * (p * p1 + r * (p * m12 + r * m22)), 0.5 * q * p1, 0.5 * q * q1


@inlined
def mean_gradient(x, y, z, gu, gv, t, intrinsics, pose):
    """Return the gradient of the mean in the world from those of a splat's centre (gu, gv) and linearised map `t`."""
    fx, fy, _, _, limit_x, limit_y = intrinsics
    held_x, free_x = held(x, z, limit_x)
    held_y, free_y = held(y, z, limit_y)
    j00 = t[0] * pose[0][0] + t[1] * pose[0][1] + t[2] * pose[0][2]
    j02 = t[0] * pose[2][0] + t[1] * pose[2][1] + t[2] * pose[2][2]
    j11 = t[3] * pose[1][0] + t[4] * pose[1][1] + t[5] * pose[1][2]
    j12 = t[3] * pose[2][0] + t[4] * pose[2][1] + t[5] * pose[2][2]
    inverse = 1 / z
    ax, ay = fx * inverse, fy * inverse
    cx, cy = ax * gu, ay * gv
    cz = -(x * cx + y * cy + ax * j00 + ay * j11) * inverse
    # As upstream: the derivative of held_x / z^2 as if held_x were a constant; where x is free, exactly right.
    cz += 2 * (ax * held_x * j02 + ay * held_y * j12) * inverse * inverse
    cx -= ax * j02 * inverse if free_x else 0.0
    cy -= ay * j12 * inverse if free_y else 0.0
    return (
        pose[0][0] * cx + pose[1][0] * cy + pose[2][0] * cz,
        pose[0][1] * cx + pose[1][1] * cy + pose[2][1] * cz,
        pose[0][2] * cx + pose[1][2] * cy + pose[2][2] * cz,
    )
