"""Sides of a term that are no pictures: numbers, constants, points, changes, leaves, parts of the model itself."""

from __future__ import annotations

from typing import List, Optional

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import arguments, attribute_chain, call_name, constant, dotted, walk_expressions, words
from legs_adapters.lexicon.depiction import Meanings
from legs_adapters.lexicon.names import kind_of_words
from legs_adapters.tensors.operations import JOINS
from legs_adapters.terms.form import Form

__all__ = [
    "is_change",
    "is_constant_tensor",
    "is_given_whole",
    "is_leaf",
    "is_number",
    "is_of_model",
    "is_of_points",
    "is_of_scanner",
    "made_of",
]

_MADE_UP = {f"torch.{name}{like}" for name in ("eye", "zeros", "ones", "full") for like in ("", "_like")}
_OF_LITERALS = {"torch.tensor", "torch.as_tensor", "torch.Tensor", "torch.FloatTensor"}
_SHAPED = {"cuda", "to", "float", "view", "reshape", "unsqueeze", "expand", "expand_as", "repeat"}
_DEPTH = 8


def is_number(meanings: Meanings, function: Function, node: cst.CSTNode, depth: int) -> bool:
    """Whether a side is one number made of a picture, ``image.mean()``, or one of each channel."""
    if isinstance(node, cst.Call):
        positional, keywords, _ = arguments(node)
        base = node.func.value if isinstance(node.func, cst.Attribute) else None
        own = base is not None and not (isinstance(base, cst.Name) and base.value == "torch")
        of = base if own else positional[0] if positional else None
        if call_name(node) in ("mean", "sum", "std", "var", "median"):
            axes = [*positional[0 if own else 1 :], *(keywords[key] for key in ("dim", "axis") if key in keywords)]
            return of is not None and all(isinstance(constant(axis), tuple) for axis in axes)
        moved = call_name(node) in ("detach", "clamp", "clip", "cuda", "to", "float", "sqrt")
        return moved and of is not None and is_number(meanings, function, of, depth)
    if isinstance(node, cst.BinaryOperation):
        for side, other in ((node.left, node.right), (node.right, node.left)):
            if is_number(meanings, function, side, depth) and meanings.of(function, other).kind != "image":
                return True
    if isinstance(node, cst.Name) and depth < 3:
        made = [d.value for d in function.flow.reaching(node) if d.kind == "assign" and d.value is not None]
        return bool(made) and all(is_number(meanings, function, value, depth + 1) for value in made)
    return False


def is_change(meanings: Meanings, function: Function, node: cst.CSTNode) -> bool:
    """``image_b - image_a``: how a picture changes, from view to view or under a filter."""
    sides = (node.left, node.right) if isinstance(node, cst.BinaryOperation) else ()
    changes = isinstance(node, cst.BinaryOperation) and isinstance(node.operator, cst.Subtract)
    return changes and all(meanings.of(function, side).kind == "image" for side in sides)


def is_of_model(program: Program, function: Function, target: cst.CSTNode) -> bool:
    """Whether a target is what the Gaussians themselves have: ``self.get_radiances.gather(1, index)``."""
    parts = list(attribute_chain(target))
    owner = program.owner_of(function)
    own = isinstance(parts[-1], cst.Name) and parts[-1].value == "self" and len(parts) > 1
    return own and owner is not None and bool({"get_xyz", "oneupSHdegree"} & set(owner.methods))


def is_given_whole(function: Function, node: cst.CSTNode) -> bool:
    """Whether it is what a parameter was given, as it was given."""
    found = function.flow.reaching(node)
    return bool(found) and all(definition.kind == "parameter" for definition in found)


def is_of_points(form: Form) -> bool:
    """``model.rgb_colors[point_indexes]``: rows of points, no picture."""
    indexed = [node for node in (form.first, form.second) if isinstance(node, cst.Subscript)]
    names = [element.slice.value for node in indexed for element in node.slice if isinstance(element.slice, cst.Index)]
    return any(isinstance(name, cst.Name) and {"point", "points"} & set(words(name.value)) for name in names)


def is_of_scanner(function: Function, form: Form) -> bool:
    """``scan[1:2]`` of a ``scan[2:3]`` that is called depth: a channel of what a laser sees, no photograph."""
    scans = {name for part in made_of(function, form) for name in [_one_channel_of(part)] if name is not None}
    depths = [place for place in function.flow.definitions if scans and kind_of_words(place) == "depth"]
    values = [definition.value for place in depths for definition in function.flow.definitions[place]]
    return any(_one_channel_of(part) in scans for value in values if value for part in walk_expressions(value))


def _one_channel_of(node: cst.CSTNode) -> Optional[str]:
    """``scan`` of ``scan[1:2, ...]``."""
    if not isinstance(node, cst.Subscript) or not isinstance(node.value, cst.Name):
        return None
    first = node.slice[0].slice
    if not isinstance(first, cst.Slice):
        return None
    lower, upper = constant(first.lower), constant(first.upper)
    return node.value.value if isinstance(lower, int) and upper == lower + 1 else None


def is_constant_tensor(function: Function, node: cst.CSTNode, depth: int = 0) -> bool:
    """Whether a side is a tensor of constants, ``torch.eye(3)``, ``torch.tensor([0, 0, 1])[:, None]``.

    Or a name for one, or for one of several, that nothing is written to.
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
    elif dotted(node.func) in _OF_LITERALS:
        parts = [*arguments(node)[0][:1]]
    elif isinstance(node.func, cst.Attribute) and call_name(node) in _SHAPED:
        parts = [node.func.value]
    else:
        return dotted(node.func) in _MADE_UP
    return (
        depth < _DEPTH
        and bool(parts)
        and all(p is not None and is_constant_tensor(function, p, depth + 1) for p in parts)
    )


def is_leaf(function: Function, node: cst.CSTNode) -> bool:
    """``image = torch.tensor(array).requires_grad_()``: whose gradient is looked at, made by no rendering.

    ``torch.cat(images).requires_grad_()`` has those of the renderings.
    """
    values = [definition.value for definition in function.flow.reaching(node) if definition.kind == "assign"]
    calls = [value for value in values if isinstance(value, cst.Call) and call_name(value) == "requires_grad_"]
    asked = [call.func.value for call in calls if isinstance(call.func, cst.Attribute)]
    return any(not (isinstance(base, cst.Call) and call_name(base) in JOINS) for base in asked)


def made_of(function: Function, form: Form) -> List[cst.CSTNode]:
    """The parts of both sides, and of what their names were made from."""
    parts: List[cst.CSTNode] = [*walk_expressions(form.first), *walk_expressions(form.second)]
    for part in list(parts):
        if isinstance(part, cst.Name):
            for definition in function.flow.reaching(part):
                if definition.value is not None:
                    parts.extend(walk_expressions(definition.value))
    return parts
