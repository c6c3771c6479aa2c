"""fused_ssim: SSIM of two batches of images, as one differentiable number."""

from __future__ import annotations

from torch import Tensor

from legs_loss import LegsError, legs_loss

__all__ = ["fused_ssim"]


def fused_ssim(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """Return the mean SSIM of img1 and img2, [B, C, H, W]; the gradient goes to the first.

    ``padding``: "same" is 3DGS's zero padding; "valid" leaves the border of 5 pixels out. Source: fused-ssim
    (Mallick et al. 2024). LEGS_OFF=1 changes nothing here: this SSIM is the codebase's own.
    """
    if padding not in ("same", "valid"):
        raise LegsError(f'fused_ssim: padding must be "same" or "valid", got {padding!r}')
    weight = img1.new_ones(img1.shape[-2:])  # a loss with a weight is compiled, where one without is 3DGS's to the bit
    zeros_or_valid = "zeros" if padding == "same" else "valid"
    return 1.0 - legs_loss(img1, img2.detach(), weight=weight, lambda_dssim=1.0, padding=zeros_or_valid)
