"""2D Gaussian Splatting's rasterizer written to be read: plain torch, autograd, any floating type.

A surfel is a disc with a Gaussian falloff in its own coordinates (u, v). A 3x3 homography T takes (u, v, 1) to
(x w, y w, w): the pixel (x, y) and the depth w. The ray through a pixel is met with the disc exactly, by inverting T
(Huang et al. 2024, "2D Gaussian Splatting for Geometrically Accurate Radiance Fields", section 4); a screen-space
Gaussian about the disc's centre keeps thin ones at least a pixel wide. The compiled rasterizer is checked against this.

Gradients are autograd's, but for the places where the CUDA code's own differ from the derivative, marked "as upstream".
"""

from __future__ import annotations

from typing import Any, NamedTuple, Optional, Tuple

import torch
from torch import Tensor

from legs_loss.reference.conventions import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR, TILE
from legs_loss.reference.rasterizer.oracle import colours

FAR = 100.0  # with NEAR, the scale of the distortion's depths; nothing is cut off there
CUTOFF = 3.0  # standard deviations: where a surfel's square of tiles ends
FILTER_RADIUS = 0.707106  # pixels: the standard deviation of the screen-space Gaussian, as upstream rounds it
MIN_EXTENT = 1e-4  # pixels^2: the least half extent of the disc's box, squared
CHANNELS = 7  # of the second image: depth, alpha, normal x y z, median depth, distortion


class Bounds(NamedTuple):
    """Where surfels lie in the image."""

    centres: Tensor  # [N, 2] pixels; a pixel's centre has integer coordinates
    radii: Tensor  # [N] int32, pixels; 0: not drawn
    tiles: Tensor  # [N, 4] int64: the first tile across and down, and the ones past the last


def homographies(
    means: Tensor, scales: Tensor, quaternions: Tensor, modifier: float, projection: Tensor, width: int, height: int
) -> Tensor:
    """T of each surfel, [N, 3, 3], from centres [N, 3], radii [N, 2], wxyz [N, 4] and 3DGS's transposed projection."""
    first, second, _ = axes(quaternions)
    radii = modifier * scales
    pixels = to_pixels(projection, width, height)
    discs = torch.stack([first * radii[:, :1], second * radii[:, 1:], means], 1)  # [N, 3, 3]: u, v, 1 to the world
    transposed = discs.reshape(-1, 3) @ pixels[:3]
    origin = torch.cat([pixels.new_zeros(2, 3), pixels[3:]])
    return (transposed.reshape(-1, 3, 3) + origin).transpose(1, 2)


def to_pixels(projection: Tensor, width: int, height: int) -> Tensor:
    """3DGS's transposed projection [4, 4] from the world to homogeneous pixels, [4, 3]; their centres are integers."""
    return projection @ projection.new_tensor(
        [[width / 2, 0, 0], [0, height / 2, 0], [0, 0, 0], [(width - 1) / 2, (height - 1) / 2, 1]]
    )


def axes(quaternions: Tensor) -> Tuple[Tensor, Tensor, Tensor]:
    """The disc's two axes and its normal, each [N, 3], in the world."""
    # As upstream: the gradient is that of the normalised quaternion, handed on as it is.
    unit = torch.nn.functional.normalize(quaternions.detach(), dim=1)
    w, x, y, z = (unit + (quaternions - quaternions.detach())).unbind(1)
    return (
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1),
        torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1),
        torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1),
    )


def facing(normals: Tensor, points: Tensor) -> Tensor:
    """Normals [N, 3] turned towards the camera, both in its axes; zero where the disc is seen exactly from its edge."""
    return normals * torch.sign(-(points * normals).sum(1, keepdim=True)).detach()


def bounds(homography: Tensor, visible: Tensor, width: int, height: int) -> Bounds:
    """Centre, radius and tiles of each surfel, from the box about the ellipse of CUTOFF standard deviations."""
    x, y, w = homography.unbind(1)
    signature = homography.new_tensor([CUTOFF**2, CUTOFF**2, -1.0])
    determinant = (signature * w * w).sum(1, keepdim=True)
    visible = visible & (determinant[:, 0] != 0)
    weights = signature / torch.where(visible[:, None], determinant, torch.ones_like(determinant))
    centres = torch.stack([(weights * x * w).sum(1), (weights * y * w).sum(1)], 1)
    squares = torch.stack([(weights * x * x).sum(1), (weights * y * y).sum(1)], 1)
    extents = (centres**2 - squares).clamp_min(MIN_EXTENT).sqrt().detach()
    radii = extents.max(1).values.clamp_min(CUTOFF * FILTER_RADIUS).ceil()

    grid = torch.tensor([-(-width // TILE), -(-height // TILE)])
    position = centres.detach()
    start = ((position - radii[:, None]) / TILE).floor().clamp(-1, 1 << 24).to(torch.int64)
    end = ((position + radii[:, None] + (TILE - 1)) / TILE).floor().clamp(-1, 1 << 24).to(torch.int64)
    start, end = start.clamp_min(0).minimum(grid), end.clamp_min(0).minimum(grid)
    drawn = visible & (end > start).all(1)
    radii = torch.where(drawn, radii.clamp_max(1 << 20), torch.zeros_like(radii))
    return Bounds(centres, radii.to(torch.int32), torch.cat([start, end], 1))


class Hit(NamedTuple):
    """Rays of P pixels met with n discs, each [P, n]."""

    depth: Tensor
    falloff: Tensor  # squared distance in standard deviations: of the disc, or on the screen where that is less
    hit: Tensor  # bool: in front of the camera


def intersect(pixels: Tensor, homography: Tensor, centres: Tensor) -> Hit:
    """Meet the rays of `pixels` [P, 2] with discs: the pixel's row and column are two planes, their line is the ray."""
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
    """Colour [P, 3] and the seven other channels [P, 7] of P pixels, from n discs in depth order."""
    response = opacities * torch.exp(-0.5 * hit.falloff)
    # As upstream: the gradient passes the ceiling as if it were not there.
    alpha = response + (response.clamp_max(MAX_ALPHA) - response).detach()
    alpha = torch.where(hit.hit & (alpha >= MIN_ALPHA), alpha, torch.zeros_like(alpha))
    alpha = torch.where(torch.cumprod(1 - alpha, 1) >= MIN_TRANSMITTANCE, alpha, torch.zeros_like(alpha))
    drawn = alpha > 0
    behind = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], 1)
    weight = alpha * before
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

    left = behind[:, -1:]
    others = [(weight * depth).sum(1, keepdim=True), 1 - left, weight @ normals, median[:, None], distortion[:, None]]
    return weight @ rgb + left * background, torch.cat(others, 1)


def _before(terms: Tensor) -> Tensor:
    """For each column, the sum of those before it."""
    return torch.cumsum(terms, 1) - terms


class _Tap(torch.autograd.Function):
    """Homographies as they are; the backward pass also fills the view-space gradient, as upstream defines it.

    That is, of the homogeneous pixel coordinates of the disc's centre, times its depth and half the image's size.
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


def render(
    means: Tensor,
    viewspace: Optional[Tensor],
    opacities: Tensor,
    sh: Optional[Tensor],
    rgb: Optional[Tensor],
    scales: Optional[Tensor],
    quaternions: Optional[Tensor],
    handed: Optional[Tensor],
    settings: Any,
) -> Tuple[Tensor, Tensor, Tensor]:
    """Image [3, H, W], the other channels [7, H, W] and radii [N]; arguments as `surfels.rasterize` has them.

    `handed` [N, 9] are homographies in place of scales and quaternions.
    """
    width, height = int(settings.image_width), int(settings.image_height)
    view = settings.viewmatrix.detach().to(means.dtype)
    points = means.detach() @ view[:3, :3] + view[3, :3]
    if handed is None:
        assert scales is not None and quaternions is not None
        projection = settings.projmatrix.detach().to(means.dtype)
        homography = homographies(means, scales, quaternions, float(settings.scale_modifier), projection, width, height)
        normals = axes(quaternions)[2] @ view[:3, :3]
    else:
        homography = handed.reshape(-1, 3, 3)
        normals = means.new_tensor([0.0, 0.0, 1.0]).expand(len(means), 3)
    normals = facing(normals, points)
    if rgb is None:
        assert sh is not None
        directions = torch.nn.functional.normalize(means - settings.campos.detach().to(means.dtype), dim=1)
        rgb = colours(directions, sh, int(settings.sh_degree))
    background = settings.bg.detach().to(means.dtype)
    return draw(homography, normals, points[:, 2], opacities, rgb, viewspace, background, width, height,
                handed is not None)  # fmt: skip


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
    """As `render`, from each disc's T, normal, depth and colour."""
    if viewspace is not None:
        tapped = _Tap.apply(homography, viewspace, width, height)
    else:
        tapped = homography
    # As upstream: the view-space gradient leaves out what comes through the screen-space Gaussian's centre, but for
    # homographies that were handed in.
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
