"""fused_ssim: SSIM of two batches of images, as one differentiable number."""

from __future__ import annotations

from torch import Tensor

from legs_loss import LegsError, ssim

__all__ = ["fused_ssim"]


def fused_ssim(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """Return the mean SSIM of img1 and img2, [B, C, H, W]; the gradient goes to the first.

    ``padding``: "same" is 3DGS's zero padding; "valid" leaves the border of 5 pixels out. Source: fused-ssim
    (Mallick et al. 2024).
    """
    if padding not in ("same", "valid"):
        raise LegsError(f'fused_ssim: padding must be "same" or "valid", got {padding!r}')
    return ssim(img1, img2.detach(), padding="zeros" if padding == "same" else "valid")
