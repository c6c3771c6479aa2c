"""compute_relocation of 3DGS-MCMC: the opacity and scale with which N Gaussians in one place look like one."""

from __future__ import annotations

from typing import Tuple

import torch
from torch import Tensor

__all__ = ["compute_relocation"]


def compute_relocation(
    opacity_old: Tensor, scale_old: Tensor, N: Tensor, binoms: Tensor, n_max: int
) -> Tuple[Tensor, Tensor]:
    """Return the new opacities [P] and scales [P, 3] of Gaussians that become N [P] each.

    binoms [n_max, n_max] holds n over k. Source: 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al.
    2024), equation 9.
    """
    count = N.reshape(-1).to(torch.int64)
    old = opacity_old.reshape(-1)
    new = 1 - (1 - old) ** (1 / count.to(old.dtype))
    denominator = torch.zeros_like(old)
    for i in range(1, int(count.max()) + 1 if len(count) else 1):
        inner = torch.zeros_like(old)
        for k in range(i):
            inner = inner + binoms[i - 1, k] * (-1) ** k / (k + 1) ** 0.5 * new ** (k + 1)
        denominator = denominator + torch.where(count >= i, inner, torch.zeros_like(inner))
    scale = (old / denominator)[:, None] * scale_old.reshape(-1, 3)
    return new.reshape(opacity_old.shape), scale.reshape(scale_old.shape)
