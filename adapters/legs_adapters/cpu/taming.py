"""diff_gaussian_rasterization of Taming 3DGS: Inria's, with the sums by which it scores Gaussians.

With ``pixel_weights`` [H, W] in the settings, four more results hold what contributions.py sums; without, they are
empty. Upstream's per-pixel counts and lists, which its own code does not use, are not there.
"""

from __future__ import annotations

import types
from typing import Any, NamedTuple, Optional, Tuple

import torch
from torch import Tensor

from legs_adapters.cpu import inria
from legs_adapters.cpu.drawing import Gaussians, draw
from legs_adapters.cpu.missing import Absent, complete, refuse_unknown
from legs_adapters.cpu.sparse_adam import SparseGaussianAdam

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "module"]

NAME = "diff_gaussian_rasterization"


class GaussianRasterizationSettings(NamedTuple):
    """A view, as Taming 3DGS's renderer describes it; the matrices are transposed."""

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
    pixel_weights: Optional[Tensor]


class GaussianRasterizer(inria.GaussianRasterizer):
    """Draws Gaussians from the view of its settings."""

    def forward(  # type: ignore[override]
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        dc: Optional[Tensor] = None,
        shs: Optional[Tensor] = None,
        colors_precomp: Optional[Tensor] = None,
        scales: Optional[Tensor] = None,
        rotations: Optional[Tensor] = None,
        cov3D_precomp: Optional[Tensor] = None,
        **unknown: Any,
    ) -> Tuple[Any, ...]:
        """Return image, radii; counts, lists, listsRender, listsDistance; centres, depths, radii; and four sums.

        The sums, [N] each: of the pixels' weights, of pixels (int32), of transmittance times alpha, and of the
        distance from the centre in pixels.
        """
        refuse_unknown(NAME, unknown)
        shs = shs if dc is None or shs is None else torch.cat([dc, shs], 1)
        gaussians = Gaussians(means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp)
        settings = self.raster_settings
        drawn = draw(gaussians, settings, NAME)
        weights = settings.pixel_weights
        nothing, none = torch.empty(0), torch.empty(0, dtype=torch.int32)
        sums = (nothing, none, nothing, nothing)
        if weights is not None and weights.numel() > 1:
            found = drawn.contributions(weights)
            sums = (found.value, found.pixels, found.blend, found.distance)
        unused = (Absent(NAME, name) for name in ("counts", "lists", "listsRender", "listsDistance"))
        return (drawn.image, drawn.radii, *unused, *drawn.centres(), drawn.radii.clone(), *sums)


def module(name: str) -> types.ModuleType:
    """Return ``diff_gaussian_rasterization`` as Taming 3DGS has it."""
    return complete(name, __doc__, GaussianRasterizationSettings, GaussianRasterizer, SparseGaussianAdam)
