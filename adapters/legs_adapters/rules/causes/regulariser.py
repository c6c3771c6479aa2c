"""Skip a term whose target is not a photograph: a constant, a statistic, the model itself."""

from __future__ import annotations

from typing import AbstractSet, List, Optional, Sequence

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import arguments, attribute_chain, call_name, constant, dotted, words
from legs_adapters.lexicon.depiction import Meanings
from legs_adapters.lexicon.words import GAUSSIAN_MODEL, POINTS
from legs_adapters.rules.rule import Rule, Term, source_of
from legs_adapters.tensors.operations import CONSTANT, KEEPS_VALUES, MAKES, MODULES, REDUCES
from legs_adapters.terms.findings import Decider
from legs_adapters.terms.sides import same_root

__all__ = ["Literal", "OfModel", "Statistic"]

_DEPTH = 8


class _Regulariser(Rule):
    reason = "regulariser"


class Literal(_Regulariser):
    """One side is a number, or rows of points selected by an index.

    left: loss = torch.abs(image - 0.5).mean()
    weighted: loss = torch.abs(image - gt).mean()
    """

    id = "literal"

    def evidence(self, term: Term) -> List[Decider]:
        literal = any(constant(side) is not None for side in term.sides)
        return term.here if literal or _is_of_points(term.sides) else []


class Statistic(_Regulariser):
    """One side is a constant tensor or a statistic of an image; or both sides are parts of one image.

    left: loss = l1_loss(image.mean(), gt.mean())
    weighted: loss = l1_loss(image, gt)
    """

    id = "statistic"

    def evidence(self, term: Term) -> List[Decider]:
        if same_root(term.form):
            return term.here
        for side in term.sides:
            if _is_number(term.analysis.meanings, term.function, side, 0) or _is_constant_tensor(term.function, side):
                return [source_of(term.function, side) or term.here[0]] if isinstance(side, cst.Name) else term.here
        return []


class OfModel(_Regulariser):
    """The target is stored by the Gaussian model itself.

    left:
        class GaussianModel:
            def get_xyz(self):
                return self._xyz

            def step(self, camera, index):
                image = render(camera, self, None, None)["render"]
                loss = l1_loss(image, self.images.gather(1, index))
                loss.backward()
                self.optimizer.step()

    weighted: loss = l1_loss(image, gt)
    """

    id = "of-model"

    def evidence(self, term: Term) -> List[Decider]:
        parts = list(attribute_chain(term.target))
        owner = term.analysis.program.owner_of(term.function)
        own = isinstance(parts[-1], cst.Name) and parts[-1].value == "self" and len(parts) > 1
        own = own and owner is not None and bool(GAUSSIAN_MODEL & set(owner.methods))
        return [(term.function, term.target)] if own else []


def _is_of_points(sides: Sequence[cst.CSTNode]) -> bool:
    """Return whether a side is rows of points, ``model.rgb_colors[point_indexes]``, not an image."""
    indexed = [node for node in sides if isinstance(node, cst.Subscript)]
    names = [element.slice.value for node in indexed for element in node.slice if isinstance(element.slice, cst.Index)]
    return any(isinstance(name, cst.Name) and POINTS & set(words(name.value)) for name in names)


def _is_number(meanings: Meanings, function: Function, node: cst.CSTNode, depth: int) -> bool:
    """Return whether a side is a statistic of an image, ``image.mean()``, or one per channel."""
    if isinstance(node, cst.Call):
        positional, keywords, _ = arguments(node)
        base = node.func.value if isinstance(node.func, cst.Attribute) else None
        own = base is not None and not (isinstance(base, cst.Name) and base.value in MODULES)
        of = base if own else positional[0] if positional else None
        if call_name(node) in REDUCES:
            axes = [*positional[0 if own else 1 :], *(keywords[key] for key in ("dim", "axis") if key in keywords)]
            return of is not None and all(isinstance(constant(axis), tuple) for axis in axes)
        moved = call_name(node) in KEEPS_VALUES | {"sqrt"}
        return moved and of is not None and _is_number(meanings, function, of, depth)
    if isinstance(node, cst.BinaryOperation):
        for side, other in ((node.left, node.right), (node.right, node.left)):
            if _is_number(meanings, function, side, depth) and meanings.of(function, other).kind != "image":
                return True
    if isinstance(node, cst.Name) and depth < 3:
        made = function.flow.assigned(node)
        return bool(made) and all(_is_number(meanings, function, value, depth + 1) for value in made)
    return False


def _is_torchs(node: cst.Call, operations: AbstractSet[str]) -> bool:
    """Return whether a call is ``torch.`` and one of some operations."""
    module, _, name = (dotted(node.func) or "").rpartition(".")
    return module == "torch" and name in operations


def _is_constant_tensor(function: Function, node: cst.CSTNode, depth: int = 0) -> bool:
    """Return whether a side is a tensor of constants, ``torch.eye(3)``, ``torch.tensor([0, 0, 1])[:, None]``.

    Or a name that is assigned one or several of them, and is not changed in place.
    """
    parts: List[Optional[cst.CSTNode]] = []
    if isinstance(node, cst.Name) and constant(node) is None:
        parts = [d.value if d.kind == "assign" else None for d in function.flow.reaching(node)]
    elif isinstance(node, cst.IfExp):
        parts = [node.body, node.orelse]
    elif isinstance(node, cst.Subscript):
        parts = [node.value]
    elif not isinstance(node, cst.Call):
        return constant(node) is not None
    elif _is_torchs(node, MAKES):
        parts = [*arguments(node)[0][:1]]
    elif isinstance(node.func, cst.Attribute) and call_name(node) in KEEPS_VALUES:
        parts = [node.func.value]
    else:
        return _is_torchs(node, CONSTANT)
    return (
        depth < _DEPTH
        and bool(parts)
        and all(p is not None and _is_constant_tensor(function, p, depth + 1) for p in parts)
    )
