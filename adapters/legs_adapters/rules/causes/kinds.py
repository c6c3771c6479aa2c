"""Skip a term that compares images of another kind than photographs: depth, normals, optical flow."""

from __future__ import annotations

from typing import List

import libcst as cst

from legs_adapters.code.syntax import call_name, key_of, words
from legs_adapters.lexicon.meaning import Meaning
from legs_adapters.lexicon.names import kind_of_words
from legs_adapters.lexicon.words import LAID_OVER_PICTURES, MASKED
from legs_adapters.rules.rule import CallOfTerm, Rule, Term, source_of
from legs_adapters.terms.findings import Decider
from legs_adapters.terms.form import Form
from legs_adapters.terms.ssim import is_beside_ssim

__all__ = ["KINDS", "OtherKind"]


class OtherKind(Rule):
    """Skip a term by the kind of its first side that is no photograph or rendering; each kind is a row of `KINDS`.

    Args:
        id: the rule's name.
        kind: the kind, a row of the words in ``lexicon/words.py``.
        what: the kind in words.
        invalid: code that it skips.
        reason: the word in the report; default: the id.
    """

    VALID = ["loss = l1_loss(image * camera.mask, gt * camera.mask)", 'loss = l1_loss(package["render"], gt)']
    is_picture = True

    def __init__(self, id: str, kind: str, what: str, invalid: List[str], reason: str = "") -> None:
        self.id: str = id
        self.kind: str = kind
        self.reason: str = reason or id
        self.why: str = f"One side is {what}."
        self.INVALID: List[str] = invalid

    def evidence(self, term: Term) -> List[Decider]:
        """Return what shows the kind of the first side that is of any of these kinds."""
        pair = term.pair
        for meaning, side, beside in ((pair.a, pair.first, pair.b), (pair.b, pair.second, pair.a)):
            if meaning.kind in _NAMES and not _is_named_picture(term, meaning, side, beside):
                return self._shown(term, side) if meaning.kind == self.kind else []
        return []

    def of_call(self, call: CallOfTerm) -> List[Decider]:
        """Return the call, where what it passes is of this kind."""
        kinds = [meaning.kind for meaning in call.given if meaning.kind in _NAMES]
        return call.here if kinds[:1] == [self.kind] else []

    def _shown(self, term: Term, side: cst.CSTNode) -> List[Decider]:
        shown = source_of(term.function, side, lambda text: kind_of_words(text) == self.kind)
        return [shown or source_of(term.function, side) or term.here[0]]


KINDS = (
    OtherKind("depth", "depth", "a depth map", ['loss = l1_loss(package["depth"], camera.invdepthmap)']),
    OtherKind("normals", "normal", "a normal map", ['loss = l1_loss(package["normals"], camera.normal_map)']),
    OtherKind(
        "features",
        "feature",
        "a feature map, a label map or a transform of an image",
        ['loss = l1_loss(package["features"], camera.semantic_feature)'],
    ),
    OtherKind("flow", "flow", "optical flow or motion", ['loss = l1_loss(package["flow"], camera.optical_flow)']),
    OtherKind("mask", "mask", "a mask or an opacity map", ['loss = l1_loss(package["alpha"], camera.mask)']),
    OtherKind(
        "synthetic",
        "warp",
        "a warped, edited, inpainted or generated image, not a photograph",
        ["loss = l1_loss(image, warped_image)"],
    ),
    OtherKind(
        "gradients", "gradient", "an edge map or an image gradient", ["loss = l1_loss(sobel(image), camera.edges)"]
    ),
    OtherKind(
        "parameter",
        "parameter",
        "a parameter of the model, of a camera or of a material",
        ["loss = torch.abs(gaussians.get_scaling - initial_scaling).mean()"],
        "regulariser",
    ),
)
_NAMES = {rule.kind for rule in KINDS}


def _is_named_picture(term: Term, meaning: Meaning, side: cst.CSTNode, beside: Meaning) -> bool:
    """Return whether a side is an image although its name has a word for a mask, a parameter or a gradient."""
    if meaning.kind not in LAID_OVER_PICTURES or beside.kind != "image":
        return False
    return is_beside_ssim(term.function, *term.sides) or _is_under_mask(term.form, side, meaning)


def _is_under_mask(form: Form, side: cst.CSTNode, meaning: Meaning) -> bool:
    """Return whether a call compares a masked photograph: ``l1_loss_masked(image, data["seg_im"], mask)``."""
    masked = form.callee is not None and MASKED & set(words(call_name(form.call))) and form.extras
    name = side.value if isinstance(side, cst.Name) else str(key_of(side) or "")
    return bool(masked) and meaning.kind == "mask" and any(kind_of_words(word) == "image" for word in words(name))
