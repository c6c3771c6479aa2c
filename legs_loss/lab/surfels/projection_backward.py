"""Take the gradient from what the strips drew back to each disc (projection.py)."""

# mypy: ignore-errors
# (numba infers the types, by its own rules: arrays of float32, or of float64 for geometry, and of integers)

from __future__ import annotations

import numpy as np

from legs_loss.kernels.compiling import claimed, compiled, inlined, part
from legs_loss.lab.rasterizer.geometry import quaternion_partials
from legs_loss.lab.rasterizer.harmonics import shade_gradient
from legs_loss.lab.rasterizer.projection import BLOCK
from legs_loss.lab.rasterizer.sorting import FIRST_SUM
from legs_loss.lab.surfels.geometry import cross, less, plus, ray_map, shape, signed, turned
from legs_loss.lab.surfels.model import CUTOFF
from legs_loss.lab.surfels.projection import CENTRE

# An entry's gradient, float32: of p's nine numbers, of det T as a factor of the depth, of the centre, of w's three by
# the screen-space Gaussian's depth, of the natural logarithm of the opacity, of colour and normal.
G_DEPTH, G_CENTRE, G_DIRECT, G_OPACITY, G_COLOUR, G_NORMAL, GRADIENTS = 9, 10, 12, 15, 16, 19, 22


@part()
def _box_gradient(x, y, w, gu, gv):
    """Return the gradients of the rows from those of the box's centre at CUTOFF."""
    inverse = 1 / signed(w, w, CUTOFF)
    u, v = signed(x, w, CUTOFF) * inverse, signed(y, w, CUTOFF) * inverse
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


@part()
def _rows_gradient(x, y, w, u, v, sums):
    """Return the gradients of T's rows from those of p, of the depths, and of what came through w alone."""
    _, along, down, scale, centred_x, centred_y = ray_map(x, y, w, u, v)
    constant = cross(centred_x, centred_y)
    ga = sums[0] * scale, sums[1] * scale, sums[2] * scale
    gb = sums[3] * scale, sums[4] * scale, sums[5] * scale
    gc = sums[6] * scale, sums[7] * scale, sums[8] * scale
    gd = sums[G_DEPTH] * scale
    gx = less(plus(cross(centred_y, ga), cross(gc, w)), along, -gd)
    gy = less(plus(cross(ga, centred_x), cross(w, gb)), down, -gd)
    gw = less(plus(cross(gb, centred_y), cross(centred_x, gc)), constant, -gd)
    gw = less(less(gw, gx, u), gy, v)
    return gx, gy, (gw[0] + sums[G_DIRECT], gw[1] + sums[G_DIRECT + 1], gw[2] + sums[G_DIRECT + 2])


@part()
def _to_world(gx, gy, gw, pixels, k):
    """Return the gradient to what row-wise became column `k` of T: an axis of the disc, or its centre."""
    return (
        gx[k] * pixels[0, 0] + gy[k] * pixels[0, 1] + gw[k] * pixels[0, 2],
        gx[k] * pixels[1, 0] + gy[k] * pixels[1, 1] + gw[k] * pixels[1, 2],
        gx[k] * pixels[2, 0] + gy[k] * pixels[2, 1] + gw[k] * pixels[2, 2],
    )


@inlined
def _project_backward_block(eight, begin, end, discs, camera, splats, clamped, firsts, bands, gradients, g_view):
    means, scales, quaternions, homographies, opacities, sh, colours = discs
    degree, pose, pixels, position, width, height = camera
    g_means, g_scales, g_quaternions, g_homographies, g_opacities, g_sh, g_colours = gradients
    given = len(homographies) > 0
    drawn, count, colour, towards = np.empty(BLOCK, np.int64), 0, np.empty((3, BLOCK)), np.zeros((3, BLOCK))
    sums = np.empty(GRADIENTS, np.float64)
    for i in range(begin, end):
        if firsts[i, FIRST_SUM] == firsts[i + 1, FIRST_SUM]:
            continue
        sums[:] = 0
        for row in range(firsts[i, FIRST_SUM], firsts[i + 1, FIRST_SUM]):
            for k in range(GRADIENTS):
                sums[k] += bands[row, k]
        g_opacities[i, 0] = sums[G_OPACITY] / opacities[i, 0]
        x, y, w, _, turn = shape(means, scales, quaternions, homographies, i, pose, pixels)
        gx, gy, gw = _rows_gradient(x, y, w, splats[i, CENTRE], splats[i, CENTRE + 1], sums)
        tap_x, tap_y = gx[2], gy[2]
        from_x, from_y, from_w = _box_gradient(x, y, w, sums[G_CENTRE], sums[G_CENTRE + 1])
        gx, gy, gw = plus(gx, from_x), plus(gy, from_y), plus(gw, from_w)
        # As upstream: the view-space gradient leaves out what comes through the screen-space Gaussian's centre, but
        # for homographies that were given.
        if given:
            tap_x, tap_y = gx[2], gy[2]
        g_view[i, 0], g_view[i, 1], g_view[i, 2] = tap_x * w[2] * (width / 2), tap_y * w[2] * (height / 2), 0

        mx = my = mz = 0.0
        if len(colours) > 0:
            g_colours[i, 0], g_colours[i, 1], g_colours[i, 2] = sums[G_COLOUR], sums[G_COLOUR + 1], sums[G_COLOUR + 2]
        else:
            drawn[count] = i
            for k in range(3):
                colour[k, count] = sums[G_COLOUR + k]
            count += 1
        if given:
            for k in range(3):
                g_homographies[i, k], g_homographies[i, 3 + k], g_homographies[i, 6 + k] = gx[k], gy[k], gw[k]
        else:
            mx, my, mz = _to_world(gx, gy, gw, pixels, 2)
            axes, q, _ = turned(quaternions, i)
            long, short = np.float64(scales[i, 0]), np.float64(scales[i, 1])
            a0, a1, a2 = _to_world(gx, gy, gw, pixels, 0)
            b0, b1, b2 = _to_world(gx, gy, gw, pixels, 1)
            g_scales[i, 0] = a0 * axes[0] + a1 * axes[3] + a2 * axes[6]
            g_scales[i, 1] = b0 * axes[1] + b1 * axes[4] + b2 * axes[7]
            n0, n1, n2 = turn * sums[G_NORMAL], turn * sums[G_NORMAL + 1], turn * sums[G_NORMAL + 2]
            # As upstream: the gradient of the normalised quaternion, passed on unchanged.
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
    shade_gradient(eight, drawn, count, means, position, degree, sh, clamped, colour, towards, g_sh)
    for j in range(count):
        for k in range(3):
            g_means[drawn[j], k] += towards[k, j]


@compiled(_nrt=True)
def project_backward(eight, counter, blocks, discs, camera, splats, clamped, firsts, sums, gradients, g_view):
    """Fill the gradients, zeros, of each disc that is drawn from its sums in the bands.

    Args:
        eight, counter, blocks: of `in_threads` and `harmonics.memory`; a block is BLOCK discs.
        discs, gradients: `Discs`.
        camera: `DiscCamera`.
        splats: [N, SPLAT], as projected.
        clamped: [N, 3].
        firsts: [N + 1, 2], from the sorting.
        sums: [bands, GRADIENTS].
        g_view: [N, 3], the view-space gradient.
    """
    count, block = len(discs.means), claimed(counter)
    while block < blocks:
        begin = block * BLOCK
        end = min(begin + BLOCK, count)
        _project_backward_block(eight, begin, end, discs, camera, splats, clamped, firsts, sums, gradients, g_view)
        block = claimed(counter)
