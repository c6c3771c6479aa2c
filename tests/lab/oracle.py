"""The oracle: 3D Gaussian Splatting in plain torch, autograd, any floating type. The compiled one is tested against it.

Each function below is one step of 3D Gaussian Splatting's forward pass; docs/rasterizer.md has the formulas. The
gradient is autograd's, but for the two places where 3DGS's own differs from the derivative, marked "as upstream".
"""

from __future__ import annotations

from typing import Any, NamedTuple, Optional, Tuple

import torch
from torch import Tensor

from legs_loss.lab.conventions import (
    DILATION,
    FARTHEST,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    NEAR,
    SH_C0,
    SH_C1,
    SH_C2,
    SH_C3,
    SQUARE,
    TILE,
    Pinhole,
)
from legs_loss.lab.rasterizer import Rendering


class Projections(NamedTuple):
    """Gaussians projected to the image."""

    centres: Tensor  # [N, 2] pixels; a pixel's centre has integer coordinates
    conics: Tensor  # [N, 3]: A, B, C of the inverse covariance [[A, B], [B, C]]
    depths: Tensor  # [N]
    radii: Tensor  # [N] int32, pixels: 3 standard deviations of the longer axis


def rotations(quaternions: Tensor) -> Tensor:
    """Return the rotation matrices [N, 3, 3] of quaternions [N, 4], wxyz of any length."""
    return unit_rotations(torch.nn.functional.normalize(quaternions, dim=1))


def unit_rotations(quaternions: Tensor) -> Tensor:
    """Return the rotation matrices [N, 3, 3] of normalised quaternions [N, 4], wxyz."""
    w, x, y, z = quaternions.unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def project(points: Tensor, scales: Tensor, quaternions: Tensor, view: Pinhole) -> Projections:
    """Project Gaussians by EWA; their centres `points` [N, 3] are in the camera's axes, beyond the near plane."""
    x, y, z = points.unbind(1)
    centres = torch.stack([view.fx * x / z + view.cx - 0.5, view.fy * y / z + view.cy - 0.5], 1)

    # As upstream: where the guard holds x, it is a constant, also to the gradient of z.
    limit_x, limit_y = view.limits
    held_x = torch.where((x / z).abs() > limit_x, (z * (x / z).clamp(-limit_x, limit_x)).detach(), x)
    held_y = torch.where((y / z).abs() > limit_y, (z * (y / z).clamp(-limit_y, limit_y)).detach(), y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([view.fx / z, zero, -view.fx * held_x / z**2], 1),
            torch.stack([zero, view.fy / z, -view.fy * held_y / z**2], 1),
        ],
        1,
    )
    to_camera = torch.as_tensor(view.world_to_camera[:3, :3], dtype=points.dtype)
    axes = jacobian @ to_camera @ rotations(quaternions) * scales[:, None]  # [N, 2, 3]: the scaled axes on the image
    covariance = axes @ axes.transpose(1, 2)
    a, b, c = covariance[:, 0, 0] + DILATION, covariance[:, 0, 1], covariance[:, 1, 1] + DILATION
    determinant = a * c - b * b
    conics = torch.stack([c, -b, a], 1) / determinant[:, None]

    middle = (a + c) / 2
    largest = middle + (middle**2 - determinant).clamp_min(0.1).sqrt()
    radii = (SQUARE * largest.sqrt()).ceil().clamp_max(FARTHEST).detach()
    radii = torch.where(determinant > 0, radii, torch.zeros_like(radii))
    return Projections(centres, conics, z, radii.to(torch.int32))


def tile_bounds(centres: Tensor, radii: Tensor, tiles: Tuple[int, int]) -> Tensor:
    """Return [N, 4] int64: of the tiles that a splat's square touches, the first in x and y, then past the last."""
    grid = torch.tensor(tiles)
    reach = radii[:, None].to(centres.dtype)
    first = ((centres - reach) / TILE).floor().clamp(-1, 1 << 24).to(torch.int64)
    end = ((centres + reach + (TILE - 1)) / TILE).floor().clamp(-1, 1 << 24).to(torch.int64)
    return torch.cat([first.clamp_min(0).minimum(grid), end.clamp_min(0).minimum(grid)], 1)


def colours(directions: Tensor, sh: Tensor, degree: int) -> Tensor:
    """Return RGB [N, 3] of harmonics [N, K, 3] along unit `directions` [N, 3], 0.5 added, not below 0."""
    x, y, z = directions[:, :, None].unbind(1)
    result = SH_C0 * sh[:, 0]
    if degree > 0:
        result = result - SH_C1 * y * sh[:, 1] + SH_C1 * z * sh[:, 2] - SH_C1 * x * sh[:, 3]
    if degree > 1:
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        result = (
            result
            + SH_C2[0] * xy * sh[:, 4]
            + SH_C2[1] * yz * sh[:, 5]
            + SH_C2[2] * (2 * zz - xx - yy) * sh[:, 6]
            + SH_C2[3] * xz * sh[:, 7]
            + SH_C2[4] * (xx - yy) * sh[:, 8]
        )
    if degree > 2:
        result = (
            result
            + SH_C3[0] * y * (3 * xx - yy) * sh[:, 9]
            + SH_C3[1] * xy * z * sh[:, 10]
            + SH_C3[2] * y * (4 * zz - xx - yy) * sh[:, 11]
            + SH_C3[3] * z * (2 * zz - 3 * xx - 3 * yy) * sh[:, 12]
            + SH_C3[4] * x * (4 * zz - xx - yy) * sh[:, 13]
            + SH_C3[5] * z * (xx - yy) * sh[:, 14]
            + SH_C3[6] * x * (xx - 3 * yy) * sh[:, 15]
        )
    return (result + 0.5).clamp_min(0)


def blend(offsets: Tensor, conics: Tensor, opacities: Tensor, rgb: Tensor, background: Tensor) -> Tensor:
    """Return colours [P, 3] of P pixels from n splats in depth order; `offsets` [P, n, 2] run from pixel to splat."""
    dx, dy = offsets.unbind(2)
    a, b, c = conics.unbind(1)
    alpha, before, left = cover(opacities * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy))
    return (alpha * before) @ rgb + left * background


def cover(response: Tensor) -> Tuple[Tensor, Tensor, Tensor]:
    """Apply the alpha thresholds to P pixels' responses [P, n], in depth order.

    Returns:
        Each splat's alpha [P, n], 0 where it is not drawn; the transmittance before it [P, n]; what is left [P, 1].
    """
    # As upstream: the gradient passes the ceiling as if it were not there.
    alpha = response + (response.clamp_max(MAX_ALPHA) - response).detach()
    alpha = torch.where(alpha >= MIN_ALPHA, alpha, torch.zeros_like(alpha))
    unfinished = torch.cumprod(1 - alpha, 1) >= MIN_TRANSMITTANCE
    alpha = torch.where(unfinished, alpha, torch.zeros_like(alpha))
    behind = torch.cumprod(1 - alpha, 1)  # the transmittance after each splat
    return alpha, torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], 1), behind[:, -1:]


class _Offsets(torch.autograd.Function):
    """Centres [n, 2] minus pixels [P, 2], [P, n, 2]; its backward also fills the view-space gradients."""

    @staticmethod
    def forward(ctx: Any, centres: Tensor, viewspace: Tensor, pixels: Tensor, half: Tensor) -> Tensor:
        ctx.half, ctx.columns = half, viewspace.shape[1]
        return centres[None] - pixels[:, None]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tuple[Tensor, Tensor, None, None]:
        summed = gradient.sum(0)
        both = torch.cat([summed * ctx.half, gradient.abs().sum(0) * ctx.half], 1)
        return summed, both[:, : ctx.columns], None, None


def rasterize(
    means: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    opacities: Tensor,
    sh: Tensor,
    camera: Any,
    background: Any,
    sh_degree: int,
    viewspace: Optional[Tensor] = None,
) -> Rendering:
    """Draw as the compiled `rasterize`, whose arguments these are, in any floating type; nothing is checked."""
    background = torch.as_tensor(background, dtype=means.dtype)
    view = Pinhole.from_camera(camera)
    return Rendering(*render(means, scales, quaternions, opacities, sh, view, background, sh_degree, viewspace))


def render(
    means: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    opacities: Tensor,
    sh: Tensor,
    view: Pinhole,
    background: Tensor,
    sh_degree: int,
    viewspace: Optional[Tensor],
) -> Tuple[Tensor, Tensor]:
    """Return image [3, H, W] and radii int32 [N]; arguments as of `rasterize`."""
    dtype = means.dtype
    to_camera = torch.as_tensor(view.world_to_camera, dtype=dtype)
    points = means @ to_camera[:3, :3].T + to_camera[:3, 3]
    seen = torch.nonzero(points[:, 2] > NEAR)[:, 0]
    # Front to back; equal depths keep their order. As upstream, depths are compared as float32 in whatever type.
    seen = seen[torch.sort(points[seen, 2].detach().to(torch.float32), stable=True).indices]

    splats = project(points[seen], scales[seen], quaternions[seen], view)
    directions = torch.nn.functional.normalize(means[seen] - torch.as_tensor(view.position, dtype=dtype), dim=1)
    rgb = colours(directions, sh[seen], sh_degree)
    bounds = tile_bounds(splats.centres.detach(), splats.radii, view.tiles)
    drawn = (splats.radii > 0) & (bounds[:, 2:] > bounds[:, :2]).all(1)
    radii = torch.zeros(len(means), dtype=torch.int32)
    radii[seen] = torch.where(drawn, splats.radii, torch.zeros_like(splats.radii))

    half = torch.tensor([view.width / 2, view.height / 2], dtype=dtype)
    rows = []
    for tile_y in range(view.tiles[1]):
        ys = torch.arange(tile_y * TILE, min((tile_y + 1) * TILE, view.height), dtype=dtype)
        in_row = drawn & (bounds[:, 1] <= tile_y) & (tile_y < bounds[:, 3])
        row = []
        for tile_x in range(view.tiles[0]):
            xs = torch.arange(tile_x * TILE, min((tile_x + 1) * TILE, view.width), dtype=dtype)
            here = torch.nonzero(in_row & (bounds[:, 0] <= tile_x) & (tile_x < bounds[:, 2]))[:, 0]
            if not len(here):
                row.append(background[:, None, None].expand(3, len(ys), len(xs)))
                continue
            pixels = torch.stack([xs.repeat(len(ys)), ys.repeat_interleave(len(xs))], 1)
            if viewspace is None:
                offsets = splats.centres[here][None] - pixels[:, None]
            else:
                offsets = _Offsets.apply(splats.centres[here], viewspace[seen[here]], pixels, half)
            pixel_colours = blend(offsets, splats.conics[here], opacities[seen[here], 0], rgb[here], background)
            row.append(pixel_colours.T.reshape(3, len(ys), len(xs)))
        rows.append(torch.cat(row, 2))
    inputs = [means, scales, quaternions, opacities, sh] + ([] if viewspace is None else [viewspace])
    nothing = 0 * sum(tensor.sum() for tensor in inputs)  # every input has a gradient, be it zero
    return torch.cat(rows, 1) + nothing, radii
