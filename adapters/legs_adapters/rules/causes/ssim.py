"""Skip an SSIM that cannot be shown to be 3DGS's: legs-patch --ssim rewrites no other."""

from __future__ import annotations

from legs_adapters.rules.rule import Rule


class UnprovenSsim(Rule):
    """With `--ssim`: nothing proves that it is 3DGS's SSIM with its defaults: a library's, perhaps, or masked.

    skipped:
        loss = l1_loss(image, gt) - ssim(image, gt, window_size=7)
    skipped:
        loss = l1_loss(image, gt) - fused_ssim(image[None], gt[None])
    weighted:
        loss = l1_loss(image, gt) - ssim(image, gt)
    weighted:
        loss = l1_loss(image, gt) - ssim(image, gt, 11)
    """

    id = "ssim-unproven"
    reason = "unproven SSIM"
