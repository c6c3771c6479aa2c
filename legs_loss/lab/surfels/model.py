"""Describe a set of surfels and the camera that sees them."""

from __future__ import annotations

from typing import NamedTuple, Optional

import torch
from torch import Tensor

# The numbers that make a rasterizer 2DGS's, beside those of conventions.py.
FAR = 100.0  # with NEAR, the scale of the distortion's depths; nothing is cut off there
CUTOFF = 3.0  # standard deviations: where a surfel's square of tiles ends
FILTER_RADIUS = 0.707106  # pixels: the standard deviation of the screen-space Gaussian, as upstream rounds it
MIN_EXTENT = 1e-4  # pixels^2: the least half extent of the disc's box, squared
CHANNELS = 7  # of the second image: depth, alpha, normal x y z, median depth, distortion


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

    @property
    def pixels(self) -> Tensor:
        """Return the map from the world to homogeneous pixels, float64 [4, 3]; pixels' centres are integers."""
        width, height = self.width, self.height
        to_image = [[width / 2, 0, 0], [0, height / 2, 0], [0, 0, 0], [(width - 1) / 2, (height - 1) / 2, 1]]
        return self.projection.detach().double() @ torch.tensor(to_image, dtype=torch.float64)
