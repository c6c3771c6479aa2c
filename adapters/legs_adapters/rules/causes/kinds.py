"""Skip a term that compares images of another kind than photographs: depth, normals, optical flow."""

from __future__ import annotations

import ast
from typing import List

from legs_adapters.lexicon.names import kind_of_words
from legs_adapters.rules.rule import Rule, Term, source_of
from legs_adapters.terms.findings import Decider


class OtherKind(Rule):
    """By its name, index or source, one side is {what}.

    skipped:
        loss = l1_loss({sides})
    weighted:
        loss = l1_loss(image * camera.mask, gt * camera.mask)
    weighted:
        loss = l1_loss(package["render"], gt)
    """

    def __init__(self, id: str, kind: str, what: str, sides: str, reason: str = "") -> None:
        """Make the rule of a kind of image, a row of `KINDS`.

        Args:
            id: the rule's name.
            kind: the kind, a row of the words in ``lexicon/words.py``.
            what: the kind in words.
            sides: what a step compares that it skips.
            reason: the word in the report; default: the id.
        """
        self.id: str = id
        self.kind: str = kind
        self.reason: str = reason or id
        self.__doc__ = str(OtherKind.__doc__).format(what=what, sides=sides)

    def evidence(self, term: Term) -> List[Decider]:
        """Return what shows the kind of the first side that is of any of these kinds."""
        pair = term.pair
        for meaning, side in ((pair.a, pair.first), (pair.b, pair.second)):
            if meaning.kind in _NAMES:
                return self._shown(term, side) if meaning.kind == self.kind else []
        return []

    def _shown(self, term: Term, side: ast.AST) -> List[Decider]:
        shown = source_of(term.function, side, lambda text: kind_of_words(text) == self.kind)
        around = next((decider for name, decider in term.names_around if kind_of_words(name) == self.kind), None)
        made = source_of(term.function, side) if isinstance(side, ast.Name) else None
        return [shown or around or made or term.here[0]]


KINDS = (
    OtherKind("depth", "depth", "a depth map", 'package["depth"], camera.invdepthmap'),
    OtherKind("channel", "channel", "a channel behind the colours", "package[3:], camera.rgbd[3:]", "depth"),
    OtherKind("normals", "normal", "a normal map", 'package["normals"], camera.normal_map'),
    OtherKind("features", "feature", "a feature or label map", 'package["features"], camera.semantic_feature'),
    OtherKind("flow", "flow", "optical flow or motion", 'package["flow"], camera.optical_flow'),
    OtherKind("mask", "mask", "a mask or an opacity map", 'package["alpha"], camera.mask'),
    OtherKind("synthetic", "warp", "a warped, edited or generated image, no photograph", "image, warped_image"),
    OtherKind("gradients", "gradient", "an edge map, gradient or difference of pictures", "sobel(image), camera.edges"),
    OtherKind("parameter", "parameter", "a parameter, of the model or a camera", "model.scales, scales", "regulariser"),
)
_NAMES = {rule.kind for rule in KINDS}
