"""compute_relocation of 3DGS-MCMC: the opacity and scale at which N Gaussians in one place look like one."""

from __future__ import annotations

import math
from typing import Tuple

import torch
from torch import Tensor

__all__ = ["compute_relocation", "relocated"]


def relocated(opacities: Tensor, counts: Tensor) -> Tuple[Tensor, Tensor]:
    """Return the opacities [P] and scale factors [P] of ``counts`` [P] Gaussians that look like the original one.

    Source: 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024), equation 9.
    """
    old = opacities.double()
    new = 1 - (1 - old) ** (1 / counts.double())
    denominator = torch.zeros_like(old)
    for i in range(1, int(counts.max()) + 1 if len(counts) else 1):
        binomials, inner = 1.0, torch.zeros_like(old)
        for k in range(i):
            inner += binomials * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1)
            binomials *= (i - 1 - k) / (k + 1)
        denominator += torch.where(counts >= i, inner, torch.zeros_like(inner))
    return new.to(opacities.dtype), (old / denominator).to(opacities.dtype)


def compute_relocation(
    opacity_old: Tensor, scale_old: Tensor, N: Tensor, binoms: Tensor, n_max: int
) -> Tuple[Tensor, Tensor]:
    """Return the new opacities [P] and scales [P, 3] of Gaussians that become N [P] each.

    ``binoms`` [n_max, n_max], which holds n over k, is not needed.
    """
    new, ratio = relocated(opacity_old.reshape(-1), N.reshape(-1))
    return new.reshape(opacity_old.shape), (ratio[:, None] * scale_old.reshape(-1, 3)).reshape(scale_old.shape)
