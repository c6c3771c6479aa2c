"""One way for every stand-in of Inria's family to draw: its inputs checked, its camera read, the reference called."""

from __future__ import annotations

from typing import Any, NamedTuple, Optional

from torch import Tensor

from legs_adapters.cpu.camera import pinhole
from legs_adapters.cpu.missing import MissingStandIn
from legs_loss import LegsError
from legs_loss.reference.rasterizer import rasterize

__all__ = ["Drawn", "Gaussians", "draw"]


class Gaussians(NamedTuple):
    """What Inria's rasterizer is given: colours as harmonics or ready, shapes as scales and rotations or covariances.

    means3D [N, 3]; means2D [N, 2 to 4], whose gradient is asked for; opacities [N, 1]; shs [N, K, 3];
    colors_precomp [N, 3]; scales [N, 3]; rotations [N, 4], wxyz; cov3D_precomp [N, 6].
    """

    means3D: Tensor
    means2D: Tensor
    opacities: Tensor
    shs: Any = None
    colors_precomp: Any = None
    scales: Any = None
    rotations: Any = None
    cov3D_precomp: Any = None


class Drawn(NamedTuple):
    """The image [3, H, W] and the radii int32 [N]."""

    image: Tensor
    radii: Tensor


def draw(gaussians: Gaussians, settings: Any, module: str) -> Drawn:
    """Draw, differentiable in everything but the view.

    Raises:
        LegsError: both or none of two ways to give colours or shapes.
        MissingStandIn: a way of giving them, or a camera, that is not covered.
    """
    if _given(gaussians.shs) == _given(gaussians.colors_precomp):
        raise LegsError(f"{module}: give either shs or colors_precomp")
    if (_given(gaussians.scales) and _given(gaussians.rotations)) == _given(gaussians.cov3D_precomp):
        raise LegsError(f"{module}: give either scales and rotations or cov3D_precomp")
    if not _given(gaussians.shs):
        raise MissingStandIn(module, "GaussianRasterizer", "colors_precomp")
    if not _given(gaussians.scales):
        raise MissingStandIn(module, "GaussianRasterizer", "cov3D_precomp")
    scales = gaussians.scales if settings.scale_modifier == 1 else gaussians.scales * settings.scale_modifier
    columns = 4 if gaussians.means2D.shape[1] == 4 else 2
    rendering = rasterize(
        gaussians.means3D,
        scales,
        gaussians.rotations,
        gaussians.opacities,
        gaussians.shs,
        pinhole(settings, module),
        settings.bg,
        int(settings.sh_degree),
        viewspace=gaussians.means2D[:, :columns] if gaussians.means2D.requires_grad else None,
    )
    return Drawn(rendering.image, rendering.radii)


def _given(tensor: Optional[Tensor]) -> bool:
    return tensor is not None and tensor.numel() > 0
