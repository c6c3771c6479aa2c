"""diff_gaussian_rasterization, the rasterizer of 3D Gaussian Splatting, on the CPU.

The interface is Inria's: settings as a named tuple, a Module that draws with them, the gradient of the image to the
splats' centres left in ``means2D.grad``. What it draws is `legs_loss.reference.rasterize`.
"""

from __future__ import annotations

import types
from typing import Any, NamedTuple, Optional, Tuple

import torch
from torch import Tensor

from legs_adapters.cpu.drawing import Gaussians, Lens, draw
from legs_adapters.cpu.missing import complete, refuse_unknown
from legs_adapters.cpu.rasterizer import Rasterizer
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


class GaussianRasterizer(Rasterizer):
    """Draws Gaussians from the view of its settings."""

    module = NAME

    def visible_filter(
        self,
        means3D: Tensor,
        scales: Optional[Tensor] = None,
        rotations: Optional[Tensor] = None,
        cov3D_precomp: Optional[Tensor] = None,
    ) -> Tensor:
        """Radii int32 [N], 0 for what is out of sight, of what is not drawn yet: Scaffold-GS and its family ask."""
        nothing = means3D.new_zeros(len(means3D), 3)
        with torch.no_grad():  # what is transparent has a radius, and costs no blending
            gaussians = Gaussians(means3D, nothing, nothing[:, :1], None, nothing, scales, rotations, cov3D_precomp)
            return draw(gaussians, self.raster_settings, self.module, self.lens()).radii

    def lens(self) -> Lens:
        """Return what the settings change about the picture."""
        return Lens()

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
