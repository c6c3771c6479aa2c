"""Skip a term that is not known to compare images."""

from __future__ import annotations

from typing import List

from legs_adapters.lexicon.meaning import swapped
from legs_adapters.rules.rule import Rule, Term
from legs_adapters.tensors.absolute import is_difference
from legs_adapters.terms.findings import Decider
from legs_adapters.terms.sides import same_root

__all__ = ["Unknown"]


class Unknown(Rule):
    """Neither side is known to be an image, or nothing shows which is the photograph and not both names are images."""

    id = reason = "unknown"
    INVALID = [
        "loss = l1_loss(network(camera), camera.something)",
        "loss = l1_loss(fused_image(camera), other(camera))",
    ]

    def evidence(self, term: Term) -> List[Decider]:
        pair = term.pair
        pictures = "image" in (pair.a.kind, pair.b.kind)
        sure = swapped(pair.a, pair.b) is not None or pair.speaks_of_images
        changes = same_root(term.form) or all(map(is_difference, term.sides))  # of two views, or of neighbours
        return [] if pictures and sure and not changes else term.here

    def may_be_loss(self, term: Term) -> bool:
        return True
