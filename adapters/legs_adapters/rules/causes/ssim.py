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
    VALID = ["loss = 1.0 - ssim(image, gt)", "loss = 1.0 - ssim(image, gt, window_size=11)"]
    INVALID = ["loss = 1.0 - ssim(image, gt, window_size=7)", "loss = 1.0 - fused_ssim(image[None], gt[None])"]

    def evidence(self, term: Term) -> List[Decider]:
        return [] if term.analysis.ssims.proven(term.function, term.form) is not None else term.here
