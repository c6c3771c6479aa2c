"""Skip a term that is not known to compare images."""

from __future__ import annotations

from typing import List

from legs_adapters.code.syntax import words_in
from legs_adapters.lexicon.meaning import swapped
from legs_adapters.lexicon.words import BACKGROUND, COLORS, KIND_OF
from legs_adapters.rules.rule import Rule, Term
from legs_adapters.tensors.absolute import is_no_picture, sides_of
from legs_adapters.terms.findings import Decider
from legs_adapters.terms.sides import same_root, speaks_of_images


class Unknown(Rule):
    """Neither side is known to be an image, or nothing shows which is the photograph and not both names are images.

    skipped:
        loss = l1_loss(network(camera), camera.something)
    skipped:
        loss = l1_loss(fused_image(camera), other(camera))
    skipped:
        loss = l1_loss(torch.abs(image - gt), 0.5)
    skipped:
        color = model.colors()
        loss = l1_loss(color, gt["color"])
    skipped:
        loss = l1_loss(model.current_rgb, sampled["target"])
    skipped:
        loss = l1_loss(sky_image, torch.zeros_like(sky_image), mask=1 - sky)
    skipped:
        bg_img = gt * 0 + background[:, None, None]
        loss = l1_loss(image, bg_img)
    """

    id = reason = "unknown"

    def evidence(self, term: Term) -> List[Decider]:
        pair = term.pair
        pictures = "image" in (pair.a.kind, pair.b.kind)
        if pictures and "render" not in (pair.a.role, pair.b.role):  # two colours may be of Gaussians
            named = {word for word in words_in(*term.sides) if KIND_OF.get(word) == "image"}
            pictures = not named or bool(named - COLORS)
        sure = swapped(pair.a, pair.b) is not None or all(map(speaks_of_images, (pair.first, pair.second)))
        changes = same_root(term.form) or all(map(sides_of, term.sides))  # of two views, or of neighbours
        changes = changes or any(map(is_no_picture, term.sides))  # the error of an error, of angles; darkness
        changes = changes or "logarithm" in (pair.a.kind, pair.b.kind)  # contours of dark places
        backdrop = {pair.a.role, pair.b.role} == {"render", None} and BACKGROUND & words_in(term.target)
        return [] if pictures and sure and not (changes or backdrop) else term.here

    def may_be_loss(self, term: Term) -> bool:
        return True
