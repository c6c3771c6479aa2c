"""Distinguish images from lists of pixels: mask indexing, and reshapes that flatten images."""

from __future__ import annotations

from typing import Iterable, Optional, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.returned import called_makers, written
from legs_adapters.code.syntax import arguments, call_name, constant, key_of, words
from legs_adapters.lexicon.depiction import Meanings
from legs_adapters.lexicon.words import PICKING
from legs_adapters.tensors.operations import JOINS, KEEPS_AXES, MAKES

__all__ = ["is_mask", "is_rows", "makes_mask", "picked_from", "without_rows"]

_DEPTH = 4


def is_mask(meanings: Meanings, function: Function, element: cst.SubscriptElement) -> bool:
    """Return whether an index is a mask of pixels."""
    if not isinstance(element.slice, cst.Index):
        return False
    node: cst.CSTNode = element.slice.value
    if isinstance(node, (cst.Comparison, cst.UnaryOperation)):
        return constant(node) is None
    if isinstance(node, cst.BinaryOperation):
        return isinstance(node.operator, (cst.BitAnd, cst.BitOr, cst.BitXor))
    if isinstance(node, cst.Call):
        return call_name(node) in ("bool", "squeeze", "expand", "expand_as", "repeat", "logical_not", "logical_and")
    name = node.value if isinstance(node, cst.Name) else node.attr.value if isinstance(node, cst.Attribute) else ""
    if _is_list_of_views(function, node):
        return False
    return bool(set(words(name)) & PICKING) or meanings.of(function, node).kind == "mask"


def _is_list_of_views(function: Function, node: cst.CSTNode) -> bool:
    """Return whether a mask is made of a list, and selects views: ``tensor([camera.is_seen for camera in batch])``."""
    made = function.flow.assigned(node)
    made = [value.body if isinstance(value, cst.IfExp) else value for value in made]
    return bool(made) and all(
        isinstance(value, cst.Call)
        and call_name(value) in MAKES
        and any(_is_list(function, part) for part in arguments(value)[0][:1])
        for value in made
    )


def _is_list(function: Function, node: cst.CSTNode) -> bool:
    """Return whether an expression is a list, ``[... for camera in batch]``, or a name of one."""
    if isinstance(node, (cst.ListComp, cst.List)):
        return True
    made = function.flow.assigned(node) if isinstance(node, cst.Name) else []
    return bool(made) and all(isinstance(value, (cst.ListComp, cst.List)) for value in made)


def makes_mask(call: cst.Call) -> bool:
    """Return whether a function makes a mask of an error map, by its name."""
    return bool(set(words(call_name(call))) & PICKING) or call_name(call) == "quantile"


def _is_picked(meanings: Meanings, function: Function, node: Optional[cst.CSTNode]) -> bool:
    """Return whether an expression is mask indexing, ``image[:, mask]``."""
    return isinstance(node, cst.Subscript) and any(is_mask(meanings, function, part) for part in node.slice)


def picked_from(meanings: Meanings, function: Function, node: cst.CSTNode) -> Optional[cst.Subscript]:
    """Return ``image[:, mask]``, also for a name whose only definition it is."""
    found = function.flow.reaching(node) if isinstance(node, cst.Name) else ()
    values = [definition.value for definition in found if definition.kind == "assign"]
    value = values[0] if len(found) == len(values) == 1 else None
    return value if isinstance(value, cst.Subscript) and _is_picked(meanings, function, value) else None


def is_rows(meanings: Meanings, function: Function, node: cst.CSTNode, depth: int = 0) -> bool:
    """Return whether an expression is a list of pixels, ``image.reshape(-1, 3)``, without neighbours."""

    def are(parts: Iterable[Tuple[Function, cst.CSTNode]]) -> bool:
        return any(is_rows(meanings, where, part, depth + 1) for where, part in parts)

    if depth > _DEPTH:
        return False
    if isinstance(node, cst.BinaryOperation):
        return are([(function, node.left), (function, node.right)])
    if isinstance(node, cst.Subscript):
        key = key_of(node)
        makers = called_makers(meanings.program, function, node.value) if isinstance(key, str) else []
        return are(written(makers, str(key)) or [(function, node.value)])
    if isinstance(node, cst.Name):
        found = [d for d in function.flow.reaching(node) if constant(d.value, d) is not None]
        if any(d.kind == "assign" and _is_picked(meanings, function, d.value) for d in found):
            return True
        added = [d.value for d in found if d.kind == "mutate" and isinstance(d.value, cst.Call)]
        if added:  # crops = [], then crops.append(crop.flatten())
            return are((function, value) for call in added for value in arguments(call)[0])
        return are((function, d.value) for d in found if d.kind == "assign" and d.value is not None)
    if isinstance(node, cst.Call) and isinstance(node.func, cst.Attribute):
        if _to_rows(node) or _flattens(node):
            return True
        if call_name(node) in JOINS:
            return are((function, arg.value) for arg in node.args[:1])
        return call_name(node) in KEEPS_AXES and are([(function, node.func.value)])
    return False


def _flattens(node: cst.Call) -> bool:
    """Return whether a call makes rows: ``image.flatten()``, ``image.reshape(3, -1)``, ``torch.masked_select(...)``."""
    if call_name(node) in ("reshape", "view"):
        sizes = [constant(value) for value in arguments(node)[0]]
        return -1 in sizes and len(sizes) < 3
    return call_name(node) == "masked_select" or (call_name(node) in ("flatten", "ravel") and not node.args)


def _to_rows(node: cst.Call) -> bool:
    sizes = [constant(value) for value in arguments(node)[0]]
    if len(sizes) == 1 and isinstance(sizes[0], tuple):
        sizes = list(sizes[0])
    return call_name(node) in ("reshape", "view") and len(sizes) == 2 and sizes[0] == -1 and sizes[1] in (1, 3, 4)


def without_rows(node: cst.BaseExpression) -> cst.BaseExpression:
    """Return ``image`` of ``image.reshape(-1, 3)``; anything else as it is."""
    if isinstance(node, cst.Call) and isinstance(node.func, cst.Attribute) and _to_rows(node):
        return node.func.value
    return node
