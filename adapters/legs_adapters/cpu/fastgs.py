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
from legs_adapters.cpu.camera import pinhole
from legs_adapters.cpu.drawing import Gaussians, Lens, draw, full
from legs_adapters.cpu.missing import complete, refuse_unknown
from legs_adapters.cpu.sparse_adam import SparseGaussianAdam
from legs_loss.reference.conventions import TILE, View
from legs_loss.reference.rasterizer import oracle

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
        from legs_adapters.cpu.compact_box import clip

        opacities = self.gaussians.opacities.detach().contiguous().numpy()
        clip(splats, opacities, float(self.settings.mult), tiles, boxes, slots, *arrays)
        radii = arrays[-1]
        # A Gaussian that reaches no pixel's centre is visible, to FastGS, if it enters a tile all the same.
        faint = np.nonzero((slots == 0) & (radii > 0))[0]
        radii[faint[~self._enters(torch.from_numpy(faint), tiles, radii[faint])]] = 0

    def _enters(self, rows: Tensor, tiles: Any, radii: Any) -> Any:
        from legs_adapters.cpu.compact_box import touches

        view = View.of(pinhole(self.settings, NAME))
        to_camera = torch.from_numpy(view.world_to_camera)
        points = self.gaussians.means3D.detach()[rows].double() @ to_camera[:3, :3].T + to_camera[:3, 3]
        centres = points[:, :2] / points[:, 2:] * torch.tensor([view.fx, view.fy])
        centres = centres + torch.tensor([view.cx - 0.5, view.cy - 0.5])
        reach, size = torch.from_numpy(radii)[:, None].double() + 1, TILE * torch.from_numpy(tiles)
        near = torch.nonzero(((centres + reach > 0) & (centres - reach < size)).all(1))[:, 0]
        chosen = rows[near]
        if self.gaussians.scales is None or not self.gaussians.scales.numel():
            scales, rotations = _axes(self.gaussians.cov3D_precomp.detach()[chosen].double())
        else:
            scales = self.gaussians.scales.detach()[chosen].double() * self.settings.scale_modifier
            rotations = self.gaussians.rotations.detach()[chosen].double()
        shapes = oracle.project(points[near], scales, rotations, view)
        opacities = self.gaussians.opacities.detach()[chosen, 0].double()
        found = np.zeros(len(rows), np.bool_)
        found[near.numpy()] = touches(
            torch.cat([shapes.centres, shapes.conics], 1).contiguous().numpy(),
            opacities.numpy(), float(self.settings.mult), tiles,
        )  # fmt: skip
        return found


def _axes(triangles: Tensor) -> Tuple[Tensor, Tensor]:
    """Scales [N, 3] and quaternions wxyz [N, 4] of covariances [N, 6]."""
    from scipy.spatial.transform import Rotation

    squares, axes = torch.linalg.eigh(full(triangles))
    axes[:, :, 2] *= torch.linalg.det(axes)[:, None]
    xyzw = torch.from_numpy(Rotation.from_matrix(axes.numpy()).as_quat().reshape(-1, 4))
    return squares.clamp_min(0).sqrt(), xyzw.roll(1, 1)


def module(name: str) -> types.ModuleType:
    """Return ``diff_gaussian_rasterization_fastgs``."""
    return complete(name, __doc__, GaussianRasterizationSettings, GaussianRasterizer, SparseGaussianAdam)
