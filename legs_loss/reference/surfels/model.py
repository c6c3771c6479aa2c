"""Describe a set of surfels and the camera that sees them."""

from __future__ import annotations

from typing import NamedTuple, Optional

from torch import Tensor

__all__ = ["SurfelView", "Surfels"]


class Surfels(NamedTuple):
    """N discs with a Gaussian falloff, activated: shaped by scales and quaternions, or by homographies.

    Attributes:
        means: [N, 3], world units.
        opacities: [N, 1], in [0, 1].
        scales: [N, 2], standard deviations along the disc's axes, world units.
        quaternions: [N, 4], wxyz, normalised.
        homographies: [N, 9], in place of scales and quaternions: the rows of the map from the disc's coordinates
            (u, v, 1) to homogeneous pixels.
        sh: [N, K, 3], spherical harmonics, or in their place
        colours: [N, 3].
        viewspace: zeros [N, 3]; its gradient becomes the one that 2DGS's densification reads.
    """

    means: Tensor
    opacities: Tensor
    scales: Optional[Tensor] = None
    quaternions: Optional[Tensor] = None
    homographies: Optional[Tensor] = None
    sh: Optional[Tensor] = None
    colours: Optional[Tensor] = None
    viewspace: Optional[Tensor] = None


class SurfelView(NamedTuple):
    """A camera, the background and the degree of the harmonics; matrices act on points that are rows, as in 3DGS."""

    width: int
    height: int
    world_to_camera: Tensor  # [4, 4]
    projection: Tensor  # [4, 4]: from the world to clip space
    position: Tensor  # [3]: the camera's centre in the world
    background: Tensor  # [3]
    sh_degree: int
