"""Skip a term that compares images of another kind than photographs: depth, normals, optical flow."""

from __future__ import annotations

from typing import List

import libcst as cst

from legs_adapters.code.syntax import call_name, key_of, walk_expressions, words
from legs_adapters.lexicon.meaning import Meaning
from legs_adapters.lexicon.names import kind_of_words
from legs_adapters.lexicon.words import LAID_OVER_PICTURES, MASKED, WARPED
from legs_adapters.rules.rule import CallOfTerm, Rule, Term, header, source_of
from legs_adapters.terms.findings import Decider
from legs_adapters.terms.form import Form
from legs_adapters.terms.ssim import is_beside_ssim

__all__ = [
    "Depth",
    "Features",
    "Flow",
    "Gradients",
    "ImageChange",
    "Mask",
    "Normals",
    "Parameters",
    "Synthetic",
    "Warping",
]


class _Kind(Rule):
    """Skip a term by the kind of its first side that is not a photograph or a rendering."""

    kind = ""

    def evidence(self, term: Term) -> List[Decider]:
        for meaning, side, beside in (
            (term.pair.a, term.pair.first, term.pair.b),
            (term.pair.b, term.pair.second, term.pair.a),
        ):
            if meaning.kind in _KINDS and not _is_named_picture(term, meaning, side, beside):
                return self._said(term, side) if meaning.kind == self.kind else []
        return []

    def of_call(self, call: CallOfTerm) -> List[Decider]:
        kinds = [meaning.kind for meaning in call.given if meaning.kind in _KINDS]
        return call.here if kinds[:1] == [self.kind] else []

    def _said(self, term: Term, side: cst.CSTNode) -> List[Decider]:
        said = source_of(term.function, side, lambda text: kind_of_words(text) == self.kind)
        return [said or source_of(term.function, side) or term.here[0]]


class Depth(_Kind):
    """One side is a depth map: its edges are not those of the photograph.

    left: loss = l1_loss(package["depth"], camera.invdepthmap)
    weighted: loss = l1_loss(package["render"], camera.original_image)
    """

    id = reason = kind = "depth"
    is_picture = True


class Normals(_Kind):
    """One side is a normal map.

    left: loss = l1_loss(package["normals"], camera.normal_map)
    weighted: loss = l1_loss(package["render"], gt)
    """

    id = reason = "normals"
    kind = "normal"
    is_picture = True


class Features(_Kind):
    """One side is a feature map, a label map or a transform of an image.

    left: loss = l1_loss(package["features"], camera.semantic_feature)
    weighted: loss = l1_loss(image, gt)
    """

    id = reason = "features"
    kind = "feature"
    is_picture = True


class Flow(_Kind):
    """One side is optical flow or motion.

    left: loss = l1_loss(package["flow"], camera.optical_flow)
    weighted: loss = l1_loss(image, gt)
    """

    id = reason = kind = "flow"
    is_picture = True


class Mask(_Kind):
    """One side is a mask or an opacity map; a masked photograph is not one.

    left: loss = l1_loss(package["alpha"], camera.mask)
    weighted: loss = l1_loss(image * camera.mask, gt * camera.mask)
    """

    id = reason = kind = "mask"
    is_picture = True


class _Synthetic(Rule):
    reason = "synthetic"

    def may_be_loss(self, term: Term) -> bool:
        """Return whether no name in the sides themselves says so, but only a caller's."""
        parts = [part for side in term.sides for part in walk_expressions(side)]
        said = [part.value for part in parts if isinstance(part, (cst.Name, cst.SimpleString))]
        return not any(kind_of_words(text) == "warp" for text in said)


class Synthetic(_Synthetic, _Kind):
    """One side is a warped, edited, inpainted or generated image, not a photograph.

    left: loss = l1_loss(image, warped_image)
    weighted: loss = l1_loss(image, gt)
    """

    id = "synthetic"
    kind = "warp"


class Warping(_Synthetic):
    """The name of the function says that it warps one view into another.

    left:
        def reprojection(gaussians, camera):
            image = render(camera, gaussians, None, None)["render"]
            loss = l1_loss(image, camera.original_image)
            loss.backward()
            gaussians.optimizer.step()

    weighted: loss = l1_loss(image, gt)
    """

    id = "warping"

    def evidence(self, term: Term) -> List[Decider]:
        return [header(term.function)] if set(words(term.function.name)) & WARPED else []


class Gradients(_Kind):
    """One side is an edge map or an image gradient.

    left: loss = l1_loss(sobel(image), camera.edges)
    weighted: loss = l1_loss(image, gt)
    """

    id = reason = "gradients"
    kind = "gradient"


class Parameters(_Kind):
    """One side is a parameter of the model, of a camera or of a material.

    left: loss = torch.abs(gaussians.get_scaling - initial_scaling).mean()
    weighted: loss = torch.abs(image - gt).mean()
    """

    id = "parameter"
    reason = "regulariser"
    kind = "parameter"


class ImageChange(Rule):
    """Both sides are differences of images, between pixels or between views.

    left: loss = l1_loss(image - blur(image), gt - blur(gt))
    weighted: loss = l1_loss(image, gt)
    """

    id = "image-change"
    reason = "gradients"

    def evidence(self, term: Term) -> List[Decider]:
        return term.here if all(_is_change(term, side) for side in term.sides) else []


_KINDS = {rule.kind for rule in (Depth, Normals, Features, Flow, Mask, Synthetic, Gradients, Parameters)}


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


def _is_change(term: Term, node: cst.CSTNode) -> bool:
    """Return whether a side is a difference of images, ``image_b - image_a``, of two views or of a filter."""
    sides = (node.left, node.right) if isinstance(node, cst.BinaryOperation) else ()
    changes = isinstance(node, cst.BinaryOperation) and isinstance(node.operator, cst.Subtract)
    return changes and all(term.analysis.meanings.of(term.function, side).kind == "image" for side in sides)
