"""A disc's geometry: formulas on one surfel's numbers, in float64, written into the loops that use them.

With the rows of a homography T = (x, y, w), the ray of the pixel (i, j) meets the disc at

    p = (i w - x) x (j w - y) = x x y + i (y x w) + j (w x x),      (u, v) = p_xy / p_z,      depth = det T / p_z

so p is linear in the pixel. It is computed about the disc's centre and divided by det T, so that depth = 1 / p_z. All
of it is in float64: the homography of a thin disc cancels badly in float32. The steps are those of the tests' oracle.
"""

# mypy: ignore-errors
# (numba infers the types, by its own rules: arrays of float32, or of float64 for geometry, and of integers)

from __future__ import annotations

import numpy as np

from legs_loss.kernels.compiling import part
from legs_loss.lab.rasterizer.geometry import rotation

# No promise that numbers are finite: a disc that is seen from its edge has a homography without inverse.
CAREFUL = {"nsz"}


@part()
def cross(a, b):
    """Return the cross product of two rows."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@part()
def dot(a, b):
    """Return the dot product of two rows."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@part()
def plus(a, b):
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@part()
def less(a, b, factor):
    """Return a - factor * b."""
    return a[0] - factor * b[0], a[1] - factor * b[1], a[2] - factor * b[2]


@part()
def signed(a, b, cutoff):
    """Return the product of two rows under the signature (c^2, c^2, -1), whose null set is the circle of radius c."""
    return cutoff * cutoff * (a[0] * b[0] + a[1] * b[1]) - a[2] * b[2]


@part(fastmath=CAREFUL)
def ellipse(x, y, w, cutoff):
    """Return the ellipse in which a disc's circle of radius `cutoff` is seen: centre, a, b, c, denominator.

    The denominator is below 0 where the circle is seen as an ellipse at all. A vector d from the centre is inside where
    d^T [[a, b], [b, c]]^-1 d < 1.
    """
    determinant = signed(w, w, cutoff)
    inverse = 1 / determinant
    u, v = signed(x, w, cutoff) * inverse, signed(y, w, cutoff) * inverse
    x, y = less(x, w, u), less(y, w, v)
    a, b, c = signed(x, x, cutoff), signed(x, y, cutoff), signed(y, y, cutoff)
    return u, v, -a * inverse, -b * inverse, -c * inverse, determinant


@part()
def point(means, i):
    """Return a mean in float64."""
    return np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])


@part()
def through(vector, matrix, k):
    """Return column `k` of a vector times a matrix's first three rows."""
    return vector[0] * matrix[0, k] + vector[1] * matrix[1, k] + vector[2] * matrix[2, k]


@part()
def _row(axes, long, short, mean, pixels, k):
    """Return row `k` of T: the disc's two axes, and its centre."""
    return (
        long * (axes[0] * pixels[0, k] + axes[3] * pixels[1, k] + axes[6] * pixels[2, k]),
        short * (axes[1] * pixels[0, k] + axes[4] * pixels[1, k] + axes[7] * pixels[2, k]),
        through(mean, pixels, k) + pixels[3, k],
    )


@part()
def turned(quaternions, i):
    """Return a disc's rotation matrix, normalised quaternion and the length that this had."""
    w, x = np.float64(quaternions[i, 0]), np.float64(quaternions[i, 1])
    y, z = np.float64(quaternions[i, 2]), np.float64(quaternions[i, 3])
    return rotation(w, x, y, z)


@part()
def _given(homographies, i, k):
    k *= 3
    return np.float64(homographies[i, k]), np.float64(homographies[i, k + 1]), np.float64(homographies[i, k + 2])


@part()
def shape(means, scales, quaternions, homographies, i, pose, pixels):
    """Return rows x, y, w of T, the normal in the camera's axes and its sign towards the camera (0: seen edge on)."""
    mean = point(means, i)
    if len(homographies) > 0:
        x, y, w = _given(homographies, i, 0), _given(homographies, i, 1), _given(homographies, i, 2)
        normal = 0.0, 0.0, 1.0
        return x, y, w, normal, -1.0
    axes, _, _ = turned(quaternions, i)
    long, short = np.float64(scales[i, 0]), np.float64(scales[i, 1])
    x = _row(axes, long, short, mean, pixels, 0)
    y = _row(axes, long, short, mean, pixels, 1)
    w = _row(axes, long, short, mean, pixels, 2)
    normal = axes[2], axes[5], axes[8]
    nx, ny, nz = through(normal, pose, 0), through(normal, pose, 1), through(normal, pose, 2)
    px, py, pz = through(mean, pose, 0), through(mean, pose, 1), through(mean, pose, 2)
    away = nx * (px + pose[3, 0]) + ny * (py + pose[3, 1]) + nz * (pz + pose[3, 2])
    turn = (1.0 if away < 0 else 0.0) - (1.0 if away > 0 else 0.0)
    return x, y, w, (nx, ny, nz), turn


@part()
def ray_map(x, y, w, u, v):
    """Return p about the centre (u, v), unscaled: constant, along, down; its scale; and the centred rows x and y."""
    centred_x, centred_y = less(x, w, u), less(y, w, v)
    constant, along, down = cross(centred_x, centred_y), cross(centred_y, w), cross(w, centred_x)
    return constant, along, down, 1 / dot(w, constant), centred_x, centred_y
