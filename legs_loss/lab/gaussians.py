"""The parameters of a set of 3D Gaussians, as an optimiser holds them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from legs_loss.lab.conventions import SH_C0


@dataclass
class Gaussians:
    """N Gaussians before activation; `rasterize` takes the activated properties below.

    means [N, 3] in the world; log_scales [N, 3]; quaternions [N, 4] wxyz of any length; opacity_logits [N, 1];
    sh [N, K, 3], K = (degree + 1)^2 coefficients of spherical harmonics a channel, the constant one first.
    """

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    opacity_logits: Tensor
    sh: Tensor

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def scales(self) -> Tensor:
        """Return standard deviations along the Gaussians' axes, [N, 3], world units."""
        return torch.exp(self.log_scales)

    @property
    def opacities(self) -> Tensor:
        """Return [N, 1] in (0, 1)."""
        return torch.sigmoid(self.opacity_logits)

    @classmethod
    def from_points(cls, xyz: Any, rgb: Any, sh_degree: int = 3, opacity: float = 0.1) -> Gaussians:
        """Start as 3DGS from a point cloud: round, opacity 0.1, as wide as the three nearest points are far.

        xyz [N, 3]; rgb [N, 3] uint8 (arrays or tensors). The scale is the root mean square of the three distances.
        """
        means = torch.as_tensor(xyz, dtype=torch.float32).clone()
        count = len(means)
        colour = torch.as_tensor(rgb).to(torch.float32) / 255
        sh = torch.zeros(count, (sh_degree + 1) ** 2, 3)
        sh[:, 0] = (colour - 0.5) / SH_C0
        log_scales = 0.5 * torch.log(_mean_square_distance(means).clamp_min(1e-7))
        quaternions = torch.zeros(count, 4)
        quaternions[:, 0] = 1
        logits = torch.logit(torch.full((count, 1), opacity))
        return cls(means, log_scales[:, None].repeat(1, 3), quaternions, logits, sh)


def rotations(quaternions: Tensor) -> Tensor:
    """Return the rotation matrices [N, 3, 3] of quaternions [N, 4], wxyz of any length."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=1).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def _mean_square_distance(points: Tensor) -> Tensor:
    """Return [N]: to each point's three nearest neighbours; block by block, so that memory stays bounded."""
    neighbours = min(3, len(points) - 1)
    if neighbours < 1:
        return torch.ones(len(points))
    result = []
    for rows in points.split(1024):
        squares = torch.cdist(rows, points, compute_mode="donot_use_mm_for_euclid_dist").square()
        nearest = squares.topk(neighbours + 1, largest=False).values  # the first is the point itself
        result.append(nearest[:, 1:].mean(1))
    return torch.cat(result)
