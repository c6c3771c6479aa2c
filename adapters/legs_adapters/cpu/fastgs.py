"""diff_gaussian_rasterization_fastgs: FastGS's rasterizer, with its compact box and its counts.

Beside Inria's settings: ``mult``, the size of the compact box; ``get_flag`` and ``metric_map`` [H * W], with which the
third result counts, for each Gaussian, the pixels marked 1 that it is blended into (empty without the flag). The
gradient of ``means2D`` has four columns: the last two are sums of absolute values.
"""

from __future__ import annotations

import types
from typing import Any, NamedTuple, Optional, Tuple

import numpy as np
import torch
from torch import Tensor

from legs_adapters.cpu import inria
from legs_adapters.cpu.drawing import Gaussians, Lens, draw
from legs_adapters.cpu.missing import complete, refuse_unknown
from legs_adapters.cpu.sparse_adam import SparseGaussianAdam

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "module"]

NAME = "diff_gaussian_rasterization_fastgs"
EVERYWHERE = 1e6  # standard deviations: no square cuts a splat off


class GaussianRasterizationSettings(NamedTuple):
    """A view, as FastGS's renderer describes it; the matrices are transposed."""

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
    mult: float
    prefiltered: bool
    debug: bool
    get_flag: Optional[bool]
    metric_map: Optional[Tensor]


class GaussianRasterizer(inria.GaussianRasterizer):
    """Draws Gaussians from the view of its settings, each in the tiles of its compact box."""

    module = NAME

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
    ) -> Tuple[Tensor, Tensor, Tensor]:
        """Return image [3, H, W], radii int32 [N], counts int32 [N]; dc is [N, 1, 3], shs the harmonics that remain."""
        refuse_unknown(NAME, unknown)
        shs = shs if dc is None or shs is None else torch.cat([dc, shs], 1)
        gaussians = Gaussians(means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp)
        settings = self.raster_settings
        drawn = draw(gaussians, settings, NAME, Lens(square=EVERYWHERE), _CompactBox(gaussians, settings))
        counts = torch.empty(0, dtype=torch.int32)
        if settings.get_flag:
            marked = (settings.metric_map == 1).reshape(int(settings.image_height), int(settings.image_width))
            counts = drawn.contributions(marked).value.round().to(torch.int32)
        return drawn.image, drawn.radii, counts


class _CompactBox:
    """What `compiled.draw` calls to have splats clipped."""

    def __init__(self, gaussians: Gaussians, settings: Any) -> None:
        self.gaussians, self.settings = gaussians, settings

    def __call__(self, tiles: Any, splats: Any, boxes: Any, slots: Any, *arrays: Any) -> None:
        from legs_adapters.cpu.compact_box import clip, touches

        opacities, mult = self.gaussians.opacities.detach().contiguous().numpy(), float(self.settings.mult)
        clip(splats, opacities, mult, tiles, boxes, slots, *arrays)
        radii = arrays[-1]
        # A Gaussian that reaches no pixel's centre is visible, to FastGS, if it enters a tile all the same.
        faint = np.nonzero((slots == 0) & (radii > 0))[0]
        radii[faint[~touches(splats[faint, :5], opacities[faint, 0].astype(np.float64), mult, tiles)]] = 0


def module(name: str) -> types.ModuleType:
    """Return ``diff_gaussian_rasterization_fastgs``."""
    return complete(name, __doc__, GaussianRasterizationSettings, GaussianRasterizer, SparseGaussianAdam)
