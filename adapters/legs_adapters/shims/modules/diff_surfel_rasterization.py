"""diff_surfel_rasterization, the rasterizer of 2D Gaussian Splatting, on the CPU: legs_loss's surfels."""

from __future__ import annotations

from typing import Any, Optional, Tuple

from torch import Tensor

from legs_adapters.shims.inria.rasterizer import RasterizerBase, check_one_of, given_or_none
from legs_adapters.shims.inria.settings import settings_type
from legs_loss.lab.surfels import Surfels, SurfelView, rasterize_surfels

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "rasterize_gaussians"]

GaussianRasterizationSettings: Any = settings_type(__name__)


class GaussianRasterizer(RasterizerBase):
    """Draw surfels for one camera."""

    def forward(self, *args: Any, **kwargs: Any) -> Tuple[Tensor, Tensor, Tensor]:
        """Return image [3, H, W], radii int32 [N], and depth, alpha, normal, median depth, distortion [7, H, W].

        `cov3D_precomp` [N, 9] holds the rows of each surfel's homography to pixels, in place of scales and rotations.
        """
        given = self.bind(args, kwargs)
        colours, shapes = (given["shs"], given["colors_precomp"]), (given["scales"], given["rotations"])
        return rasterize_gaussians(
            given["means3D"], given["means2D"], *colours, given["opacities"], *shapes, given["cov3D_precomp"],
            self.raster_settings,
        )  # fmt: skip


def rasterize_gaussians(
    means3D: Tensor,
    means2D: Optional[Tensor],
    sh: Optional[Tensor],
    colors_precomp: Optional[Tensor],
    opacities: Tensor,
    scales: Optional[Tensor],
    rotations: Optional[Tensor],
    cov3Ds_precomp: Optional[Tensor],
    raster_settings: Any,
) -> Tuple[Tensor, Tensor, Tensor]:
    """Draw as `GaussianRasterizer`'s forward does; missing inputs are None or empty."""
    settings = raster_settings
    sh, colours, scales, rotations, rows = (
        given_or_none(tensor) for tensor in (sh, colors_precomp, scales, rotations, cov3Ds_precomp)
    )
    if len(means3D):
        check_one_of("diff_surfel_rasterization", sh, colours, scales, rotations, rows)
    if scales is not None and settings.scale_modifier != 1:
        scales = scales * settings.scale_modifier
    view = SurfelView(
        width=int(settings.image_width),
        height=int(settings.image_height),
        world_to_camera=settings.viewmatrix,
        projection=settings.projmatrix,
        position=settings.campos,
        background=settings.bg,
        sh_degree=int(settings.sh_degree),
    )
    return rasterize_surfels(Surfels(means3D, opacities, scales, rotations, rows, sh, colours, means2D), view)
