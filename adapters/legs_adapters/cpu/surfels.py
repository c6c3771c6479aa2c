"""2D Gaussian Splatting's `diff_surfel_rasterization` on the CPU, with its names, arguments and results.

What a surfel is and how it is drawn stands in surfels_oracle.py; surfels_compiled.py does the same fast.
"""

from __future__ import annotations

import types
from typing import Any, NamedTuple, Optional, Tuple

import torch
from torch import Tensor

from legs_adapters.cpu.missing import attribute_guard
from legs_adapters.cpu.rasterizer import Rasterizer
from legs_loss.errors import LegsError


class GaussianRasterizationSettings(NamedTuple):
    """A camera, and how to draw for it; matrices as 3DGS has them, transposed."""

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor  # [3]
    scale_modifier: float
    viewmatrix: Tensor  # [4, 4]
    projmatrix: Tensor  # [4, 4]: view and projection
    sh_degree: int
    campos: Tensor  # [3]
    prefiltered: bool
    debug: bool


class GaussianRasterizer(Rasterizer):
    """Draws surfels for one camera."""

    module = "diff_surfel_rasterization"

    def forward(
        self,
        means3D: Tensor,
        means2D: Optional[Tensor],
        opacities: Tensor,
        shs: Optional[Tensor] = None,
        colors_precomp: Optional[Tensor] = None,
        scales: Optional[Tensor] = None,
        rotations: Optional[Tensor] = None,
        cov3D_precomp: Optional[Tensor] = None,
    ) -> Tuple[Tensor, Tensor, Tensor]:
        """Image [3, H, W], radii int32 [N], and depth, alpha, normal x y z, median depth, distortion [7, H, W].

        `cov3D_precomp` [N, 9] holds the rows of each surfel's homography to pixels, in place of scales and rotations.
        """
        return rasterize(
            means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp, self.raster_settings
        )


def rasterize_gaussians(
    means3D: Tensor,
    means2D: Optional[Tensor],
    sh: Optional[Tensor],
    colors_precomp: Optional[Tensor],
    opacities: Tensor,
    scales: Optional[Tensor],
    rotations: Optional[Tensor],
    cov3Ds_precomp: Optional[Tensor],
    raster_settings: GaussianRasterizationSettings,
) -> Tuple[Tensor, Tensor, Tensor]:
    """As `GaussianRasterizer`'s forward; what is not given may be None or empty."""
    return rasterize(
        means3D, means2D, opacities, sh, colors_precomp, scales, rotations, cov3Ds_precomp, raster_settings
    )


def rasterize(
    means: Tensor,
    viewspace: Optional[Tensor],
    opacities: Tensor,
    sh: Optional[Tensor],
    rgb: Optional[Tensor],
    scales: Optional[Tensor],
    quaternions: Optional[Tensor],
    homography: Optional[Tensor],
    settings: GaussianRasterizationSettings,
    backend: str = "numba",
) -> Tuple[Tensor, Tensor, Tensor]:
    """Draw surfels, differentiable in all tensors but the camera's.

    Args:
        means: [N, 3], world units.
        viewspace: zeros [N, 3] or None; its gradient becomes the one that 2DGS's densification reads.
        opacities: [N, 1], activated.
        sh: [N, K, 3], or `rgb` [N, 3] in its place.
        scales: [N, 2], activated, and `quaternions` wxyz [N, 4], normalised; or `homography` [N, 9] in their place.
        settings: the camera.
        backend: "numba", or "torch": the oracle, slow, in any floating type.

    Returns:
        Image [3, H, W], radii int32 [N], other channels [7, H, W].

    Raises:
        LegsError: shapes that do not fit.
    """
    rgb, sh, homography, scales, quaternions = (
        None if tensor is None or tensor.numel() == 0 else tensor
        for tensor in (rgb, sh, homography, scales, quaternions)
    )
    width, height = int(settings.image_width), int(settings.image_height)
    if not len(means):  # as upstream: nothing at all, not even the background
        empty = means.sum() * 0
        return empty.expand(3, height, width), torch.zeros(0, dtype=torch.int32), empty.expand(7, height, width)
    _check(means, viewspace, opacities, sh, rgb, scales, quaternions, homography, settings.sh_degree)

    if backend == "torch":
        from legs_adapters.cpu.surfels_oracle import render
    else:
        from legs_adapters.cpu.surfels_compiled import render
    image, others, radii = render(means, viewspace, opacities, sh, rgb, scales, quaternions, homography, settings)
    return image, radii, others


def _to_camera(points: Tensor, view: Tensor) -> Tensor:
    return points @ view[:3, :3] + view[3, :3]


def _check(
    means: Tensor,
    viewspace: Optional[Tensor],
    opacities: Tensor,
    sh: Optional[Tensor],
    rgb: Optional[Tensor],
    scales: Optional[Tensor],
    quaternions: Optional[Tensor],
    homography: Optional[Tensor],
    degree: int,
) -> None:
    if (sh is None) == (rgb is None):
        raise LegsError("diff_surfel_rasterization: pass either shs or colors_precomp")
    if (scales is None or quaternions is None) == (homography is None) or (scales is None) != (quaternions is None):
        raise LegsError("diff_surfel_rasterization: pass either scales and rotations or cov3D_precomp")
    count = len(means)
    coefficients = 0 if sh is None else sh.shape[1]
    if sh is not None and coefficients < (degree + 1) ** 2:
        raise LegsError(f"diff_surfel_rasterization: sh_degree {degree} needs more than {coefficients} coefficients")
    expected = {
        "means3D": (means, (count, 3)),
        "means2D": (viewspace, (count, 3)),
        "opacities": (opacities, (count, 1)),
        "shs": (sh, (count, coefficients, 3)),
        "colors_precomp": (rgb, (count, 3)),
        "scales": (scales, (count, 2)),
        "rotations": (quaternions, (count, 4)),
        "cov3D_precomp": (homography, (count, 9)),
    }
    wrong = [
        f"{name} {list(tensor.shape)}, expected {list(shape)}"
        for name, (tensor, shape) in expected.items()
        if tensor is not None and tuple(tensor.shape) != shape
    ]
    if wrong:
        raise LegsError(f"diff_surfel_rasterization: {'; '.join(wrong)}")


def module(name: str) -> types.ModuleType:
    """The stand-in to be imported as `name`."""
    made = types.ModuleType(name, __doc__)
    public: Any = (GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians)
    for item in public:
        setattr(made, item.__name__, item)
    made.__getattr__ = attribute_guard(name)  # type: ignore[method-assign]
    return made
