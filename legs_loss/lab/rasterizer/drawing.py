"""Draw for codebases whose rasterizer returns or changes more than 3DGS's: depth, sums per Gaussian, footprints."""

from __future__ import annotations

from typing import Any, NamedTuple, Optional, Tuple

import numpy as np
import torch
from torch import Tensor

from legs_loss.lab.conventions import DILATION, NEAR, SQUARE, Pinhole
from legs_loss.lab.gaussians import rotations
from legs_loss.lab.rasterizer import compiled, contributions, sorting
from legs_loss.lab.rasterizer.compiled import Clip, Tensors
from legs_loss.lab.rasterizer.groups import Footprint

LEAST_RATIO = 0.000025  # of determinants, as in Inria's antialiasing


class Lens(NamedTuple):
    """The ways in which a fork's footprints differ from 3DGS's.

    Attributes:
        dilation: pixels^2, added to the diagonal of the splat's covariance.
        compensated: whether the opacity is lowered by as much as the dilation widened the splat (Mip-Splatting).
        square: standard deviations: half the side of the square in whose tiles a splat is drawn at all.
        fade: view-space gradients of Gaussians nearer than this are scaled by (depth / fade)^2 (Pixel-GS); 0: none.
    """

    dilation: float = DILATION
    compensated: bool = False
    square: float = SQUARE
    fade: float = 0.0


class Contributions(NamedTuple):
    """Sums over the pixels that each Gaussian is blended into, [N] each (contributions.py says of what)."""

    pixels: Tensor  # int32
    blend: Tensor
    value: Tensor
    distance: Tensor
    most: Tensor


class Drawn:
    """A rendering, and the other results that can be derived from it.

    Attributes:
        image: [3, H, W].
        radii: int32 [N], pixels; 0 for what is not drawn.
    """

    def __init__(self, drawing: compiled.Drawing, tensors: Tensors, view: Pinhole) -> None:
        self._drawing, self._tensors, self._view = drawing, tensors, view
        self.image: Tensor
        self.radii: Tensor
        self.image, self.radii = compiled.attach(drawing, tensors)
        self._extras: Optional[Tensor] = None

    def depth(self) -> Tensor:
        """Return [1, H, W]: the sum of depth times transmittance times alpha; not divided by alpha."""
        return self._extra(0)

    def alpha(self) -> Tensor:
        """Return [1, H, W]: one minus the transmittance that is left."""
        return self._extra(1)

    def inverse_depth(self) -> Tensor:
        """Return [1, H, W]: as `depth`, of 1 / depth."""
        return self._extra(2)

    def centres(self) -> Tuple[Tensor, Tensor]:
        """Return pixels [N, 2] and depths [N] of what is drawn, 0 for what is not; no gradient."""
        drawn, none = self.radii > 0, torch.zeros(())
        pixels = torch.from_numpy(self._drawing.splats[:, :2]).to(torch.float32)
        depth = depths(self._tensors.means.detach(), self._view)
        return torch.where(drawn[:, None], pixels, none), torch.where(drawn, depth, none.to(depth.dtype))

    def features(self, values: Tensor) -> Tensor:
        """Blend any values [N, C] as colours are, on black: [C, H, W]."""
        images = []
        for group in torch.nn.functional.pad(values, (0, -values.shape[1] % 3)).split(3, 1):
            tensors = self._tensors._replace(sh=None, colours=group, viewspace=None)
            drawing = self._drawing.recoloured(group, np.zeros(3, np.float32))
            images.append(compiled.attach(drawing, tensors)[0])
        return torch.cat(images)[: values.shape[1]]

    def contributions(self, values: Optional[Tensor] = None) -> Contributions:
        """Return the sums; ``values`` [H, W] are summed too."""
        size = self._view.height, self._view.width
        plane = torch.zeros(size) if values is None else values.detach().to(torch.float32).reshape(size)
        found = self._summed(plane, torch.zeros_like(self.image)).to(torch.float32)
        return Contributions(found[:, 0].to(torch.int32), *found[:, 1 : contributions.SLOPES].unbind(1))

    def scored(self, scores: Tensor) -> Tensor:
        """Return the image; its backward pass leaves `squared_slopes` in the gradient of ``scores`` [N, 1]."""
        return _Scored.apply(self.image, scores, self)

    def squared_slopes(self, gradient: Tensor) -> Tensor:
        """Return [N]: the sum over pixels of the squared derivative by each Gaussian's falloff.

        ``gradient`` [3, H, W] is the image's. Source: Speedy-Splat (Hanson et al. 2025).
        """
        slopes = self._summed(torch.zeros(gradient.shape[1:]), gradient)[:, contributions.SLOPES]
        # By the falloff, not by alpha: the opacity is a factor. A row that was not drawn has none.
        opacity = torch.from_numpy(self._drawing.splats[:, 5]).exp()
        return torch.where(slopes > 0, opacity.square() * slopes, slopes)

    def _summed(self, plane: Tensor, gradient: Tensor) -> Tensor:
        it = self._drawing
        values, g_image = (tensor.detach().to(torch.float32).contiguous().numpy() for tensor in (plane, gradient))
        return torch.from_numpy(
            contributions.contribute(
                it.across, it.ranges, it.ends, it.splats, it.draws, it.entries, values, it.image, g_image
            )
        )

    def reaching(self) -> Tensor:
        """Return bool [N]: which Gaussians reach a pixel."""
        found = np.zeros(len(self.radii), np.bool_)
        found[self._drawing.draws[: len(self._drawing.entries), sorting.OWNER]] = True
        return torch.from_numpy(found)

    def _extra(self, channel: int) -> Tensor:
        if self._extras is None:
            depth = depths(self._tensors.means, self._view)
            inverse = torch.where(depth > NEAR, 1 / depth.clamp_min(NEAR), torch.zeros_like(depth))
            self._extras = self.features(torch.stack([depth, torch.ones_like(depth), inverse], 1))
        return self._extras[channel : channel + 1]


class _Scored(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, scores: Tensor, drawn: Drawn) -> Tensor:
        ctx.drawn, ctx.shape, ctx.kind = drawn, scores.shape, scores.dtype
        return image.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tuple[Tensor, Tensor, None]:
        return gradient, ctx.drawn.squared_slopes(gradient).to(ctx.kind).reshape(ctx.shape), None


def depths(means: Tensor, view: Pinhole) -> Tensor:
    """Return [N]: the depths along the camera's axis."""
    row = torch.from_numpy(view.world_to_camera[2]).to(means.dtype)
    return means @ row[:3] + row[3]


def covariance(scales: Tensor, quaternions: Tensor) -> Tensor:
    """Return the covariances [N, 3, 3] of Gaussians, from scales [N, 3] and wxyz [N, 4]."""
    axes = rotations(quaternions) * scales[:, None]
    return axes @ axes.transpose(1, 2)


def full(triangles: Tensor) -> Tensor:
    """Return the symmetric matrices [N, 3, 3] of upper triangles [N, 6]."""
    return triangles[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def compensation(means: Tensor, shapes: Tensor, view: Pinhole, dilation: float, least: float = LEAST_RATIO) -> Tensor:
    """Return [N, 1]: how far dilation widened each splat: the root of the determinants' ratio, at least sqrt(least)."""
    to_camera = torch.from_numpy(view.world_to_camera).to(means.dtype)
    points = means @ to_camera[:3, :3].T + to_camera[:3, 3]
    x, y, z = points[:, 0], points[:, 1], points[:, 2].clamp_min(NEAR)
    held = [value.clamp(-limit, limit) for value, limit in zip((x / z, y / z), view.limits)]
    zero = torch.zeros_like(z)
    rows = (view.fx / z, zero, -view.fx * held[0] / z), (zero, view.fy / z, -view.fy * held[1] / z)
    jacobian = torch.stack([torch.stack(row, 1) for row in rows], 1)
    axes = jacobian @ to_camera[:3, :3]
    flat = axes @ shapes @ axes.transpose(1, 2)
    a, b, c = flat[:, 0, 0], flat[:, 0, 1], flat[:, 1, 1]
    ratio = (a * c - b * b) / ((a + dilation) * (c + dilation) - b * b)
    return ratio.clamp_min(least).sqrt()[:, None]


def draw(
    tensors: Tensors,
    view: Pinhole,
    background: Tensor,
    sh_degree: int,
    lens: Lens = Lens(),  # noqa: B008 (immutable)
    clip: Optional[Clip] = None,
) -> Drawn:
    """Draw, differentiable in all of ``tensors``; ``clip`` as for `compiled.draw`. Values are not checked."""
    if lens.compensated:
        if tensors.covariances is None:
            assert tensors.scales is not None and tensors.quaternions is not None
            shapes = covariance(tensors.scales, tensors.quaternions)
        else:
            shapes = full(tensors.covariances)
        dimmed = tensors.opacities * compensation(tensors.means, shapes, view, lens.dilation)
        tensors = tensors._replace(opacities=dimmed)
    if tensors.viewspace is not None and tensors.viewspace.requires_grad and lens.fade > 0:
        scale = (depths(tensors.means, view).detach() / lens.fade).square().clamp_max(1)[:, None]
        tensors.viewspace.register_hook(lambda gradient: gradient * scale)
    footprint = Footprint(lens.dilation, lens.square)
    return Drawn(compiled.draw(tensors, view, background.detach(), sh_degree, footprint, clip), tensors, view)
