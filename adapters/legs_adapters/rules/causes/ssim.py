"""Skip an SSIM that cannot be shown to be 3DGS's: legs-patch --ssim rewrites no other."""

from __future__ import annotations

from typing import List

from legs_adapters.rules.rule import Rule, Term
from legs_adapters.terms.findings import Decider

__all__ = ["UnprovenSsim"]


class UnprovenSsim(Rule):
    """With `--ssim`: it is no call of a known form of 3DGS's SSIM with its defaults, but a library's, or masked."""

    id = "ssim-unproven"
    reason = "unproven SSIM"
    VALID = ["loss = l1_loss(image, gt) - ssim(image, gt)", "loss = l1_loss(image, gt) - ssim(image, gt, 11)"]
    INVALID = [
        "loss = l1_loss(image, gt) - ssim(image, gt, window_size=7)",
        "loss = l1_loss(image, gt) - fused_ssim(image[None], gt[None])",
    ]

    def evidence(self, term: Term) -> List[Decider]:
        return [] if term.analysis.ssims.proven(term.function, term.form) is not None else term.here
