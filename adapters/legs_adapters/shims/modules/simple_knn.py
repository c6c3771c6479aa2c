"""simple_knn: the mean squared distance of each point to its three nearest neighbours, exact."""

from __future__ import annotations

import types

import torch
from torch import Tensor

from legs_adapters.shims.inria.survey import Interface
from legs_adapters.shims.missing import complete

__all__ = ["distCUDA2", "module"]

NEIGHBOURS = 3


def distCUDA2(points: Tensor) -> Tensor:
    """Return [N], the mean of the squared distances of points [N, 3] to their three nearest neighbours.

    A point is not its own neighbour, but its copies are. Source: simple-knn (Kerbl et al. 2023), which finds the same
    neighbours by boxes along a Morton curve; with fewer than four points it counts the missing ones as infinitely far.
    """
    from scipy.spatial import cKDTree

    xyz = points.detach().to(torch.float64).cpu().numpy()
    if not len(xyz):
        return torch.zeros(0)
    # The point itself is found too, at distance 0: before or after its copies, with the same result.
    distances, _ = cKDTree(xyz).query(xyz, k=NEIGHBOURS + 1)
    squares = torch.from_numpy(distances[:, 1:]).square().mean(1)
    return squares.to(torch.float32).clamp_max(torch.finfo(torch.float32).max)


def module(name: str, interface: Interface) -> types.ModuleType:
    """Return ``simple_knn`` with its ``_C``."""
    return complete(name, __doc__, complete(f"{name}._C", None, distCUDA2))
