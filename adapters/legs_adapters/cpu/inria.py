"""diff_gaussian_rasterization, the rasterizer of 3D Gaussian Splatting, on the CPU.

The interface is Inria's: settings as a named tuple, a Module that draws with them, the gradient of the image to the
splats' centres left in ``means2D.grad``. What it draws is `legs_loss.reference.rasterize`.
"""

from __future__ import annotations

import types
from typing import Any, NamedTuple, Optional, Tuple

import torch
from torch import Tensor, nn

from legs_adapters.cpu.camera import visible
from legs_adapters.cpu.drawing import Gaussians, draw
from legs_adapters.cpu.missing import complete, refuse_unknown
from legs_adapters.cpu.sparse_adam import SparseGaussianAdam

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "module"]

NAME = "diff_gaussian_rasterization"


class GaussianRasterizationSettings(NamedTuple):
    """A view, as Inria's renderer describes it; the matrices are transposed."""

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool
    debug: bool


class GaussianRasterizer(nn.Module):
    """Draws Gaussians from the view of its settings."""

    def __init__(self, raster_settings: Any) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    def markVisible(self, positions: Tensor) -> Tensor:
        """Bool [N]: which points are beyond the near plane."""
        with torch.no_grad():
            return visible(positions, self.raster_settings.viewmatrix)

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        shs: Optional[Tensor] = None,
        colors_precomp: Optional[Tensor] = None,
        scales: Optional[Tensor] = None,
        rotations: Optional[Tensor] = None,
        cov3D_precomp: Optional[Tensor] = None,
        **unknown: Any,
    ) -> Tuple[Tensor, Tensor]:
        """Return the image [3, H, W] and the radii int32 [N], 0 for what is not drawn."""
        refuse_unknown(NAME, unknown)
        gaussians = Gaussians(means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp)
        drawn = draw(gaussians, self.raster_settings, NAME)
        return drawn.image, drawn.radii


def module(name: str) -> types.ModuleType:
    """Return ``diff_gaussian_rasterization``."""
    return complete(name, __doc__, GaussianRasterizationSettings, GaussianRasterizer, SparseGaussianAdam)
