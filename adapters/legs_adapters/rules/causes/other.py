"""Skip a term that is not about Gaussian splatting: of rays, a mesh, another network."""

from __future__ import annotations

from typing import List

from legs_adapters.lexicon.names import is_of_other_framework
from legs_adapters.lexicon.words import RAYS, SPLATS
from legs_adapters.rules.rule import Rule, Term, header
from legs_adapters.terms.findings import Decider
from legs_adapters.terms.sides import of_rays


class NotSplats(Rule):
    """No word of Gaussian splatting in torch was found around the term, or names say that its sides are of rays.

    skipped:
        loss = l1_loss(image[ray_indexes], gt[ray_indexes])
    """

    id = "not-splats"
    reason = "unrelated"
    is_doubted_beside_sites = False

    def evidence(self, term: Term) -> List[Decider]:
        if is_of_other_framework(term.function.module.text):
            return term.here
        if not term.analysis.splats.is_about(term.function):
            return [header(term.function)]
        return term.here if of_rays(term.form) and not term.has_rows else []  # pixels of an image, by that name

    def may_be_loss(self, term: Term) -> bool:
        sources = term.analysis.program.sources.values()
        return RAYS.search(term.function.module.text) is None and any(SPLATS.search(each.text) for each in sources)
