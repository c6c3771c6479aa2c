"""SparseGaussianAdam: Adam for the Gaussians that a view shows."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

__all__ = ["SparseGaussianAdam"]

BETA1, BETA2 = 0.9, 0.999


class SparseGaussianAdam(torch.optim.Adam):
    """Adam that updates only the rows of visible Gaussians, their moments included, without correcting the bias.

    Source: Taming 3DGS (Mallick et al. 2024).
    """

    def __init__(self, params: Any, lr: float, eps: float) -> None:
        super().__init__(params=params, lr=lr, eps=eps)

    @torch.no_grad()
    def step(self, visibility: Tensor, N: int) -> None:  # type: ignore[override]
        """Update from the gradients; visibility is bool [N], each parameter [N, ...]."""
        rows = torch.nonzero(visibility.reshape(-1)[:N])[:, 0]
        for group in self.param_groups:
            (parameter,) = group["params"]
            if parameter.grad is None:
                continue
            state = self.state[parameter]
            if not state:
                state["step"] = torch.tensor(0.0)
                state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
            gradient = parameter.grad[rows]
            first = state["exp_avg"][rows].mul_(BETA1).add_(gradient, alpha=1 - BETA1)
            second = state["exp_avg_sq"][rows].mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
            state["exp_avg"][rows], state["exp_avg_sq"][rows] = first, second
            parameter[rows] -= group["lr"] * first / (second.sqrt() + group["eps"])
