"""Draw surfels in plain torch, as a reference: autograd, any floating type.

A surfel is a disc with a Gaussian falloff in its own coordinates (u, v). A 3x3 homography T takes (u, v, 1) to
(x w, y w, w): the pixel (x, y) and the depth w. The ray through a pixel is met with the disc exactly, by inverting T
(Huang et al. 2024, "2D Gaussian Splatting for Geometrically Accurate Radiance Fields", section 4); a screen-space
Gaussian about the disc's centre keeps thin ones at least a pixel wide. The compiled rasterizer is checked against this.

Gradients are autograd's, except where those of the CUDA code differ from the derivative, marked "as upstream".
"""

from __future__ import annotations

from typing import Any, NamedTuple, Optional, Tuple

import torch
from torch import Tensor

from legs_loss.lab.conventions import FARTHEST, NEAR, TILE
from legs_loss.lab.surfels.model import (
    CHANNELS,
    CUTOFF,
    FAR,
    FILTER_RADIUS,
    MIN_EXTENT,
    Surfels,
    SurfelView,
)
from tests.lab.oracle import colours, cover, tile_bounds, unit_rotations


class Bounds(NamedTuple):
    """The boxes of surfels in the image."""

    centres: Tensor  # [N, 2] pixels; a pixel's centre has integer coordinates
    radii: Tensor  # [N] int32, pixels; 0: not drawn
    tiles: Tensor  # [N, 4] int64: the first tile across and down, and the ones past the last


def homographies(
    means: Tensor, scales: Tensor, quaternions: Tensor, projection: Tensor, width: int, height: int
) -> Tensor:
    """Return each surfel's T [N, 3, 3], from centres [N, 3], scales [N, 2], wxyz [N, 4] and transposed projection."""
    first, second, _ = axes(quaternions)
    pixels = to_pixels(projection, width, height)
    discs = torch.stack([first * scales[:, :1], second * scales[:, 1:], means], 1)  # [N, 3, 3]: u, v, 1 to the world
    transposed = discs.reshape(-1, 3) @ pixels[:3]
    origin = torch.cat([pixels.new_zeros(2, 3), pixels[3:]])
    return (transposed.reshape(-1, 3, 3) + origin).transpose(1, 2)


def to_pixels(projection: Tensor, width: int, height: int) -> Tensor:
    """Return the map from the world to homogeneous pixels [4, 3], whose centres are integers.

    ``projection`` is 3DGS's [4, 4], transposed: points are rows.
    """
    return projection @ projection.new_tensor(
        [[width / 2, 0, 0], [0, height / 2, 0], [0, 0, 0], [(width - 1) / 2, (height - 1) / 2, 1]]
    )


def axes(quaternions: Tensor) -> Tuple[Tensor, Tensor, Tensor]:
    """Return the disc's two axes and its normal, each [N, 3], in the world."""
    # As upstream: the gradient is that of the normalised quaternion, passed on unchanged.
    unit = torch.nn.functional.normalize(quaternions.detach(), dim=1)
    return unit_rotations(unit + (quaternions - quaternions.detach())).unbind(2)  # type: ignore[return-value]


def facing(normals: Tensor, points: Tensor) -> Tensor:
    """Turn normals [N, 3] towards the camera, in its axes; zero where the disc is seen exactly edge on."""
    return normals * torch.sign(-(points * normals).sum(1, keepdim=True)).detach()


def bounds(homography: Tensor, visible: Tensor, width: int, height: int) -> Bounds:
    """Return each surfel's centre, radius and tiles, from the box about the ellipse of CUTOFF standard deviations."""
    x, y, w = homography.unbind(1)
    signature = homography.new_tensor([CUTOFF**2, CUTOFF**2, -1.0])
    determinant = (signature * w * w).sum(1, keepdim=True)
    visible = visible & (determinant[:, 0] != 0)
    weights = signature / torch.where(visible[:, None], determinant, torch.ones_like(determinant))
    centres = torch.stack([(weights * x * w).sum(1), (weights * y * w).sum(1)], 1)
    squares = torch.stack([(weights * x * x).sum(1), (weights * y * y).sum(1)], 1)
    extents = (centres**2 - squares).clamp_min(MIN_EXTENT).sqrt().detach()
    radii = extents.max(1).values.clamp_min(CUTOFF * FILTER_RADIUS).ceil()

    tiles = tile_bounds(centres.detach(), radii, (-(-width // TILE), -(-height // TILE)))
    drawn = visible & (tiles[:, 2:] > tiles[:, :2]).all(1)
    radii = torch.where(drawn, radii.clamp_max(FARTHEST), torch.zeros_like(radii))
    return Bounds(centres, radii.to(torch.int32), tiles)


class Hit(NamedTuple):
    """The points where the rays of P pixels meet n discs, each [P, n]."""

    depth: Tensor
    falloff: Tensor  # squared distance in standard deviations: of the disc, or on the screen where that is less
    hit: Tensor  # bool: in front of the camera


def intersect(pixels: Tensor, homography: Tensor, centres: Tensor) -> Hit:
    """Intersect the rays of `pixels` [P, 2] with discs: a ray is where the planes of its row and column meet."""
    x, y, w = homography.unbind(1)
    column = pixels[:, None, :1] * w - x  # [P, n, 3]: the plane of the pixel's column, in the disc's coordinates
    row = pixels[:, None, 1:] * w - y
    point = torch.cross(column, row, dim=2)  # homogeneous (u, v)
    parallel = point[..., 2] == 0
    uv = point[..., :2] / torch.where(parallel, torch.ones_like(point[..., 2]), point[..., 2])[..., None]
    on_disc = (uv * uv).sum(2)
    on_screen = 2 * ((centres - pixels[:, None]) ** 2).sum(2)
    disc = on_disc <= on_screen
    # As upstream: where the screen-space Gaussian is taken, the depth moves with the disc's plane, not with (u, v).
    uv = torch.where(disc[..., None], uv, uv.detach())
    depth = (uv * w[:, :2]).sum(2) + w[:, 2]
    return Hit(depth, torch.where(disc, on_disc, on_screen), ~parallel & (depth >= NEAR))


def blend(hit: Hit, opacities: Tensor, rgb: Tensor, normals: Tensor, background: Tensor) -> Tuple[Tensor, Tensor]:
    """Return colour [P, 3] and the seven other channels [P, 7] of P pixels, from n discs in depth order."""
    response = opacities * torch.exp(-0.5 * hit.falloff)
    alpha, before, left = cover(torch.where(hit.hit, response, torch.zeros_like(response)))
    drawn, weight = alpha > 0, alpha * before
    depth = torch.where(drawn, hit.depth, torch.ones_like(hit.depth))

    # Distortion: the sum over pairs of w_i w_j (m_i - m_j)^2, m the depth mapped from [NEAR, FAR] to [0, 1].
    m = FAR / (FAR - NEAR) * (1 - NEAR / depth)
    first, second = _before(weight * m), _before(weight * m * m)
    distortion = ((m * m * (1 - before) + second - 2 * m * first) * weight).sum(1)

    # Median depth: of the last disc that is met while more than half of the light still passes; 0 if there is none.
    order = torch.arange(1, alpha.shape[1] + 1)
    last = torch.where(drawn & (before > 0.5), order, torch.zeros_like(order)).max(1).values
    median = depth.gather(1, (last - 1).clamp_min(0)[:, None])[:, 0]
    median = torch.where(last > 0, median, torch.zeros_like(median))

    others = [(weight * depth).sum(1, keepdim=True), 1 - left, weight @ normals, median[:, None], distortion[:, None]]
    return weight @ rgb + left * background, torch.cat(others, 1)


def _before(terms: Tensor) -> Tensor:
    """Return, for each column, the sum of those before it."""
    return torch.cumsum(terms, 1) - terms


class _Tap(torch.autograd.Function):
    """Pass homographies through; the backward pass also fills the view-space gradient, as upstream defines it.

    It is the gradient to the homogeneous pixel coordinates of the disc's centre, times its depth and half the image's
    size.
    """

    @staticmethod
    def forward(ctx: Any, homography: Tensor, viewspace: Tensor, width: int, height: int) -> Tensor:
        ctx.save_for_backward(homography)
        ctx.size = width, height
        return homography.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tuple[Tensor, Tensor, None, None]:
        width, height = ctx.size
        (homography,) = ctx.saved_tensors
        half = gradient.new_tensor([width / 2, height / 2])
        moved = gradient[:, :2, 2] * homography[:, 2, 2:] * half
        return gradient, torch.cat([moved, torch.zeros_like(moved[:, :1])], 1), None, None


def render(surfels: Surfels, view: SurfelView) -> Tuple[Tensor, Tensor, Tensor]:
    """Return image [3, H, W], the other channels [7, H, W] and radii [N]."""
    means, kind = surfels.means, surfels.means.dtype
    pose = view.world_to_camera.detach().to(kind)
    points = means.detach() @ pose[:3, :3] + pose[3, :3]
    if surfels.homographies is None:
        assert surfels.scales is not None and surfels.quaternions is not None
        projection = view.projection.detach().to(kind)
        homography = homographies(means, surfels.scales, surfels.quaternions, projection, view.width, view.height)
        normals = axes(surfels.quaternions)[2] @ pose[:3, :3]
    else:
        homography = surfels.homographies.reshape(-1, 3, 3)
        normals = means.new_tensor([0.0, 0.0, 1.0]).expand(len(means), 3)
    rgb = surfels.colours
    if rgb is None:
        assert surfels.sh is not None
        directions = torch.nn.functional.normalize(means - view.position.detach().to(kind), dim=1)
        rgb = colours(directions, surfels.sh, view.sh_degree)
    return draw(
        homography, facing(normals, points), points[:, 2], surfels.opacities, rgb, surfels.viewspace,
        view.background.detach().to(kind), view.width, view.height, surfels.homographies is not None,
    )  # fmt: skip


def draw(
    homography: Tensor,
    normals: Tensor,
    depths: Tensor,
    opacities: Tensor,
    rgb: Tensor,
    viewspace: Optional[Tensor],
    background: Tensor,
    width: int,
    height: int,
    whole_tap: bool,
) -> Tuple[Tensor, Tensor, Tensor]:
    """Draw as `render` does, from each disc's T, normal, depth and colour."""
    if viewspace is not None:
        tapped = _Tap.apply(homography, viewspace, width, height)
    else:
        tapped = homography
    # As upstream: the view-space gradient leaves out what comes through the screen-space Gaussian's centre, but for
    # homographies that were given.
    visible = (depths > NEAR) & (normals != 0).any(1)
    centres, radii, tiles = bounds(tapped if whole_tap else homography, visible, width, height)
    order = torch.sort(depths.detach().to(torch.float32), stable=True).indices
    order = order[radii[order] > 0]
    rows = []
    for top in range(0, height, TILE):
        row = []
        for left in range(0, width, TILE):
            xs = torch.arange(left, min(left + TILE, width), dtype=homography.dtype)
            ys = torch.arange(top, min(top + TILE, height), dtype=homography.dtype)
            tile = torch.tensor([left // TILE, top // TILE])
            here = order[(tiles[order, :2] <= tile).all(1) & (tile < tiles[order, 2:]).all(1)]
            if not len(here):
                empty = torch.cat([background, background.new_zeros(CHANNELS)])
                row.append(empty[:, None, None].expand(3 + CHANNELS, len(ys), len(xs)))
                continue
            pixels = torch.stack([xs.repeat(len(ys)), ys.repeat_interleave(len(xs))], 1)
            met = intersect(pixels, tapped[here], centres[here])
            blended = torch.cat(blend(met, opacities[here, 0], rgb[here], normals[here], background), 1)
            row.append(blended.T.reshape(3 + CHANNELS, len(ys), len(xs)))
        rows.append(torch.cat(row, 2))
    both = torch.cat(rows, 1)
    inputs = [homography, normals, opacities, rgb] + ([] if viewspace is None else [viewspace])
    nothing = 0 * sum(tensor.sum() for tensor in inputs)  # every input has a gradient, be it zero
    return both[:3] + nothing, both[3:] + nothing, radii
