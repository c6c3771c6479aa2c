"""Skip a Huber loss."""

from __future__ import annotations

from typing import List

from legs_adapters.rules.rule import Rule, Term
from legs_adapters.terms.error_maps import is_huber
from legs_adapters.terms.findings import Decider

__all__ = ["Huber"]


class Huber(Rule):
    """The error is squared below a threshold, and a weight would move that threshold.

    left:
        error = torch.abs(image - gt)
        loss = torch.where(error < 0.1, error ** 2 / 0.2, error - 0.05).mean()

    weighted:
        error = torch.abs(image - gt)
        loss = error.mean()
    """

    id = reason = "huber"
    is_always_listed = True
    needs_target = False

    def evidence(self, term: Term) -> List[Decider]:
        return term.here if is_huber(term.analysis.training, term.function, term.form) else []

    def may_be_loss(self, term: Term) -> bool:
        return True
