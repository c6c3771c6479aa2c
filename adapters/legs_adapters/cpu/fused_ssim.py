"""fused_ssim: SSIM of two batches of images, as one differentiable number."""

from __future__ import annotations

import types

import torch
from torch import Tensor

from legs_adapters.cpu.missing import complete
from legs_loss import LegsError, ssim

__all__ = ["fused_ssim", "module"]


def fused_ssim(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """Return the mean SSIM of img1 and img2, [B, C, H, W]; the gradient goes to the first.

    ``padding``: "same" is 3DGS's zero padding; "valid" leaves the border of 5 pixels out. Source: fused-ssim
    (Mallick et al. 2024).
    """
    if padding == "same" and img1.dtype == torch.float32:
        from legs_loss.kernels.numba_loss import fused_loss

        return 1 - fused_loss(img1, img2, lambda_dssim=1.0)
    if padding not in ("same", "valid"):
        raise LegsError(f'fused_ssim: padding must be "same" or "valid", got {padding!r}')
    return ssim(img1, img2.detach(), padding="zeros" if padding == "same" else "valid")


def module(name: str) -> types.ModuleType:
    """Return ``fused_ssim``."""
    return complete(name, __doc__, fused_ssim)
