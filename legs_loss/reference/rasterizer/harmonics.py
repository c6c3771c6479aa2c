"""Evaluate the colour of a Gaussian by spherical harmonics of the viewing direction, and its gradient, compiled."""

# mypy: ignore-errors
# (numba infers the types, by its own rules)

from __future__ import annotations

import math

import numpy as np

from legs_loss.kernels.compiling import compiled
from legs_loss.reference.conventions import SH_C0, SH_C1, SH_C2, SH_C3

_C0, _C1 = np.float32(SH_C0), np.float32(SH_C1)
_D0, _D1, _D2, _D3, _D4 = (np.float32(c) for c in SH_C2)
_E0, _E1, _E2, _E3, _E4, _E5, _E6 = (np.float32(c) for c in SH_C3)


@compiled()
def direction(means, i, position):
    """Return the direction from the camera's centre to the Gaussian's, of length 1, and the length it had."""
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
    """Return gradient to the direction, from the gradient `g` to each of its harmonics."""
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
def shade(means, i, position, degree, sh, basis, clamped, colour):
    """Fill Gaussian `i`'s `colour` [3] as seen from `position`, and which of its channels are clamped at 0."""
    dx, dy, dz, _ = direction(means, i, position)
    harmonics(degree, dx, dy, dz, basis)
    for channel in range(3):
        value = np.float32(0.5)
        for k in range((degree + 1) * (degree + 1)):
            value += basis[k] * sh[i, k, channel]
        clamped[i, channel] = value < np.float32(0)
        colour[channel] = max(value, np.float32(0))


@compiled()
def shade_gradient(means, i, position, degree, sh, clamped, red, green, blue, basis, g_basis, g_sh):
    """Fill Gaussian `i`'s `g_sh` from the gradient to its colour; return the gradient to its mean."""
    coefficients = (degree + 1) * (degree + 1)
    dx, dy, dz, distance = direction(means, i, position)
    harmonics(degree, dx, dy, dz, basis)
    red = np.float32(0) if clamped[i, 0] else np.float32(red)
    green = np.float32(0) if clamped[i, 1] else np.float32(green)
    blue = np.float32(0) if clamped[i, 2] else np.float32(blue)
    for k in range(coefficients):
        g_sh[i, k, 0], g_sh[i, k, 1], g_sh[i, k, 2] = basis[k] * red, basis[k] * green, basis[k] * blue
        g_basis[k] = red * sh[i, k, 0] + green * sh[i, k, 1] + blue * sh[i, k, 2]
    g_sh[i, coefficients:] = 0
    vx, vy, vz = harmonics_gradient(degree, dx, dy, dz, g_basis)
    along = vx * dx + vy * dy + vz * dz
    nearness = 1 / distance
    return (vx - along * dx) * nearness, (vy - along * dy) * nearness, (vz - along * dz) * nearness
