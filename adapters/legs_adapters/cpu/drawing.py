"""One way for every stand-in of Inria's family to draw: inputs checked, the camera read, the reference called."""

from __future__ import annotations

from typing import Any, Callable, NamedTuple, Optional, Tuple

import numpy as np
import torch
from torch import Tensor

from legs_adapters.cpu.camera import pinhole
from legs_loss import LegsError
from legs_loss.reference.conventions import DILATION, NEAR, View
from legs_loss.reference.rasterizer import compiled
from legs_loss.reference.rasterizer.oracle import rotations

__all__ = ["Contributions", "Drawn", "Gaussians", "Lens", "draw"]

LEAST_RATIO = 0.000025  # of determinants, as in Inria's antialiasing


class Gaussians(NamedTuple):
    """What Inria's rasterizer is given: colours as harmonics or ready, shapes as scales and rotations.

    means3D [N, 3]; means2D [N, 2 to 4], whose gradient is asked for; opacities [N, 1]; shs [N, K, 3];
    colors_precomp [N, 3]; scales [N, 3] and rotations [N, 4], wxyz; or cov3D_precomp [N, 6], the upper triangle of each
    covariance by its rows, in world units^2, to which no scale_modifier is applied.
    """

    means3D: Tensor
    means2D: Tensor
    opacities: Tensor
    shs: Any = None
    colors_precomp: Any = None
    scales: Any = None
    rotations: Any = None
    cov3D_precomp: Any = None


class Lens(NamedTuple):
    """Where forks draw other than 3DGS.

    Attributes:
        dilation: pixels^2, added to the diagonal of the splat's covariance.
        compensated: whether the opacity is lowered by as much as the dilation widened the splat (Mip-Splatting).
        square: standard deviations: half the side of the square in whose tiles a splat is drawn at all.
        fade: view-space gradients of Gaussians nearer than this are scaled by (depth / fade)^2 (Pixel-GS); 0: none.
    """

    dilation: float = DILATION
    compensated: bool = False
    square: float = 3.0
    fade: float = 0.0


class Contributions(NamedTuple):
    """Sums over the pixels that each Gaussian is blended into, [N] each: see contributions.py."""

    pixels: Tensor  # int32
    blend: Tensor
    value: Tensor
    distance: Tensor
    most: Tensor


class Drawn:
    """A rendering, and what else can be asked about it.

    Attributes:
        image: [3, H, W].
        radii: int32 [N], pixels; 0 for what is not drawn.
    """

    def __init__(self, drawing: compiled.Drawing, tensors: compiled.Tensors, view: View) -> None:
        self._drawing, self._tensors, self._view = drawing, tensors, view
        self.image, self.radii = compiled.attach(drawing, tensors)
        self._extras: Optional[Tensor] = None

    def depth(self) -> Tensor:
        """[1, H, W]: the sum of depth times transmittance times alpha; not divided by alpha."""
        return self._extra(0)

    def alpha(self) -> Tensor:
        """[1, H, W]: one minus the transmittance that is left."""
        return self._extra(1)

    def inverse_depth(self) -> Tensor:
        """[1, H, W]: as `depth`, of 1 / depth."""
        return self._extra(2)

    def centres(self) -> Tuple[Tensor, Tensor]:
        """Pixels [N, 2] and depths [N] of what is drawn, 0 for what is not; no gradient."""
        drawn = self.radii > 0
        pixels = torch.from_numpy(self._drawing.splats[:, :2]).to(torch.float32)
        depth = depths(self._tensors.means.detach(), self._view)
        return torch.where(drawn[:, None], pixels, torch.zeros_like(pixels)), torch.where(
            drawn, depth, torch.zeros_like(depth)
        )

    def features(self, values: Tensor) -> Tensor:
        """[C, H, W]: any values [N, C] blended as colours are, on black."""
        images = []
        for group in torch.nn.functional.pad(values, (0, -values.shape[1] % 3)).split(3, 1):
            tensors = self._tensors._replace(sh=None, colours=group, viewspace=None)
            drawing = self._drawing.recoloured(group, np.zeros(3, np.float32))
            images.append(compiled.attach(drawing, tensors)[0])
        return torch.cat(images)[: values.shape[1]]

    def contributions(self, values: Optional[Tensor] = None) -> Contributions:
        """The sums; ``values`` [H, W] are summed too."""
        from legs_adapters.cpu.contributions import FIELDS, contribute

        view, drawing = self._view, self._drawing
        plane = torch.zeros(view.height, view.width) if values is None else values.detach().to(torch.float32)
        sums = np.empty((len(self.radii), FIELDS))
        contribute(
            drawing.across, drawing.ranges, drawing.ends, drawing.splats, drawing.draws, drawing.entries,
            plane.reshape(view.height, view.width).contiguous().numpy(), sums,
        )  # fmt: skip
        found = torch.from_numpy(sums).to(torch.float32)
        return Contributions(found[:, 0].to(torch.int32), *found[:, 1:].unbind(1))

    def scored(self, scores: Tensor) -> Tensor:
        """The image, whose way back leaves in the gradient of ``scores`` [N, 1] what `squared_slopes` says."""
        return _Scored.apply(self.image, scores, self._drawing)

    def _extra(self, channel: int) -> Tensor:
        if self._extras is None:
            depth = depths(self._tensors.means, self._view)
            inverse = torch.where(depth > NEAR, 1 / depth.clamp_min(NEAR), torch.zeros_like(depth))
            self._extras = self.features(torch.stack([depth, torch.ones_like(depth), inverse], 1))
        return self._extras[channel : channel + 1]


def squared_slopes(drawing: compiled.Drawing, gradient: Tensor) -> Tensor:
    """[N]: the sum over pixels of the squared derivative by each Gaussian's falloff; ``gradient`` is the image's."""
    from legs_adapters.cpu.contributions import sensitivity

    sums, it = np.empty(len(drawing.radii)), drawing
    g_image = gradient.detach().to(torch.float32).contiguous().numpy()
    sensitivity(it.across, it.ranges, it.ends, it.splats, it.draws, it.entries, it.image, g_image, sums)
    return torch.from_numpy(sums)


class _Scored(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, scores: Tensor, drawing: compiled.Drawing) -> Tensor:
        ctx.drawing, ctx.shape, ctx.kind = drawing, scores.shape, scores.dtype
        return image.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tuple[Tensor, Tensor, None]:
        return gradient, squared_slopes(ctx.drawing, gradient).to(ctx.kind).reshape(ctx.shape), None


def depths(means: Tensor, view: View) -> Tensor:
    """[N]: along the camera's axis."""
    row = torch.from_numpy(view.world_to_camera[2]).to(means.dtype)
    return means @ row[:3] + row[3]


def covariance(scales: Tensor, quaternions: Tensor) -> Tensor:
    """[N, 3, 3] of Gaussians, from scales [N, 3] and wxyz [N, 4]."""
    axes = rotations(quaternions) * scales[:, None]
    return axes @ axes.transpose(1, 2)


def full(triangles: Tensor) -> Tensor:
    """[N, 3, 3] symmetric matrices of their upper triangles [N, 6]."""
    return triangles[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def compensation(means: Tensor, covariances: Tensor, view: View, dilation: float, least: float = LEAST_RATIO) -> Tensor:
    """[N, 1]: the square root of the splat's determinant before its dilation over that after, but at least `least`."""
    to_camera = torch.from_numpy(view.world_to_camera).to(means.dtype)
    points = means @ to_camera[:3, :3].T + to_camera[:3, 3]
    x, y, z = points[:, 0], points[:, 1], points[:, 2].clamp_min(NEAR)
    held = [value.clamp(-limit, limit) for value, limit in zip((x / z, y / z), view.limits)]
    zero = torch.zeros_like(z)
    rows = (view.fx / z, zero, -view.fx * held[0] / z), (zero, view.fy / z, -view.fy * held[1] / z)
    jacobian = torch.stack([torch.stack(row, 1) for row in rows], 1)
    axes = jacobian @ to_camera[:3, :3]
    flat = axes @ covariances @ axes.transpose(1, 2)
    a, b, c = flat[:, 0, 0], flat[:, 0, 1], flat[:, 1, 1]
    ratio = (a * c - b * b) / ((a + dilation) * (c + dilation) - b * b)
    return ratio.clamp_min(least).sqrt()[:, None]


def draw(
    gaussians: Gaussians,
    settings: Any,
    module: str,
    lens: Lens = Lens(),  # noqa: B008 (immutable)
    clip: Optional[Callable[..., None]] = None,
) -> Drawn:
    """Draw, differentiable in everything but the view; ``clip`` as for `compiled.Drawing`.

    Raises:
        LegsError: both or none of two ways to give colours or shapes; values that are not finite.
        MissingStandIn: a camera that is not covered.
    """
    if _given(gaussians.shs) == _given(gaussians.colors_precomp):
        raise LegsError(f"{module}: give either shs or colors_precomp")
    if (_given(gaussians.scales) and _given(gaussians.rotations)) == _given(gaussians.cov3D_precomp):
        raise LegsError(f"{module}: give either scales and rotations or cov3D_precomp")
    view = View.of(pinhole(settings, module))
    opacities, covariances = gaussians.opacities, None
    scales: Any = None
    quaternions: Any = None
    if _given(gaussians.cov3D_precomp):
        covariances = gaussians.cov3D_precomp
    else:
        scales, quaternions = gaussians.scales, gaussians.rotations
        scales = scales if settings.scale_modifier == 1 else scales * settings.scale_modifier
    if lens.compensated:
        shapes = covariance(scales, quaternions) if covariances is None else full(covariances)
        opacities = opacities * compensation(gaussians.means3D, shapes, view, lens.dilation)
    viewspace = None
    if gaussians.means2D.requires_grad:
        viewspace = gaussians.means2D[:, : 4 if gaussians.means2D.shape[1] == 4 else 2]
        if lens.fade > 0:
            scale = (depths(gaussians.means3D, view).detach() / lens.fade).square().clamp_max(1)[:, None]
            viewspace.register_hook(lambda gradient: gradient * scale)
    tensors = compiled.Tensors(
        gaussians.means3D, scales, quaternions, opacities, gaussians.shs, gaussians.colors_precomp, viewspace,
        covariances,
    )  # fmt: skip
    for name, tensor in tensors._asdict().items():
        if tensor is not None and not bool(torch.isfinite(tensor.detach().sum())):
            raise LegsError(f"{module}: {name} {list(tensor.shape)} holds NaN or infinity")
    drawing = compiled.draw(
        tensors,
        view,
        settings.bg.detach(),
        int(settings.sh_degree),
        compiled.Footprint(lens.dilation, lens.square),
        clip,
    )
    return Drawn(drawing, tensors, view)


def _given(tensor: Optional[Tensor]) -> bool:
    return tensor is not None and tensor.numel() > 0
