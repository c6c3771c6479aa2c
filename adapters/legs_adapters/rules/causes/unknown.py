"""Skip a term that is not known to compare images."""

from __future__ import annotations

from typing import List

from legs_adapters.lexicon.meaning import swapped
from legs_adapters.rules.rule import Rule, Term
from legs_adapters.terms.findings import Decider
from legs_adapters.terms.sides import are_counterparts

__all__ = ["Ambiguous", "Unknown"]


class _Unknown(Rule):
    reason = "unknown"

    def may_be_loss(self, term: Term) -> bool:
        return True


class Unknown(_Unknown):
    """Neither side is known to be an image.

    left: loss = l1_loss(network(camera), camera.something)
    weighted: loss = l1_loss(image, camera.something)
    """

    id = "unknown"

    def evidence(self, term: Term) -> List[Decider]:
        pictures = "image" in (term.pair.a.kind, term.pair.b.kind) or are_counterparts(term.form)
        return [] if pictures else term.here


class Ambiguous(_Unknown):
    """Neither side is known to be the rendering or the photograph, and not both names are about images.

    left: loss = l1_loss(fused_image(camera), other(camera))
    weighted: loss = l1_loss(image, gt)
    """

    id = "ambiguous"

    def evidence(self, term: Term) -> List[Decider]:
        sure = swapped(term.pair.a, term.pair.b) is not None
        return [] if sure or term.pair.speaks_of_images else term.here
