"""Distinguish images from lists of pixels: mask indexing, and reshapes that flatten images."""

from __future__ import annotations

from typing import List, Optional, Tuple

import libcst as cst

from legs_adapters.code.calls import callees
from legs_adapters.code.module import Function
from legs_adapters.code.reaching import Definition, Reaching
from legs_adapters.code.syntax import arguments, call_name, constant, key_of, walk_expressions, words
from legs_adapters.lexicon.depiction import Meanings
from legs_adapters.lexicon.words import PICKING
from legs_adapters.tensors.operations import JOINS, KEEPS_AXES

_DEPTH = 4


def is_mask(meanings: Meanings, function: Function, element: cst.SubscriptElement) -> bool:
    """Return whether an index is a mask of pixels."""
    if not isinstance(element.slice, cst.Index):
        return False
    node = element.slice.value
    if isinstance(node, (cst.Comparison, cst.UnaryOperation)):
        return constant(node) is None
    if isinstance(node, cst.BinaryOperation):
        return isinstance(node.operator, (cst.BitAnd, cst.BitOr, cst.BitXor))
    name = node.value if isinstance(node, cst.Name) else node.attr.value if isinstance(node, cst.Attribute) else ""
    return bool(set(words(name)) & PICKING) or meanings.meaning(function, node).kind == "mask"


def makes_mask(call: cst.Call) -> bool:
    """Return whether a function makes a mask of an error map, by its name."""
    return bool(set(words(call_name(call))) & PICKING) or call_name(call) == "quantile"


def is_rows(meanings: Meanings, function: Function, node: Optional[cst.CSTNode | Reaching], depth: int = 0) -> bool:
    """Return whether an expression, or what reaches it, is a list of pixels, ``image.reshape(-1, 3)``."""
    if node is None or depth > _DEPTH:
        return False
    known = meanings.rows
    if isinstance(node, Reaching) and not isinstance(node, Definition):
        for join in node.joins(lambda part: (id(part), depth) in known):
            known[id(join), depth] = any(is_rows(meanings, function, part, depth) for part in join.parts)
    if (id(node), depth) not in known:
        known[id(node), depth] = function.module.spend(1) and _is_rows(meanings, function, node, depth)
    return known[id(node), depth]


def _is_rows(meanings: Meanings, function: Function, node: cst.CSTNode | Reaching, depth: int) -> bool:
    parts: List[Optional[cst.CSTNode]] = []
    if isinstance(node, Definition):
        if node.kind == "mutate" and isinstance(node.value, cst.Call):
            parts = [*arguments(node.value)[0]]  # crops = [], then crops.append(crop.flatten())
        elif node.kind == "assign":
            parts = [node.value]
    elif isinstance(node, cst.BinaryOperation):
        parts = [node.left, node.right]
    elif isinstance(node, cst.Subscript):
        if depth and not isinstance(key_of(node), str) and any(is_mask(meanings, function, e) for e in node.slice):
            return True  # with a name: where both carry it, the images themselves are written
        if any(is_rows(meanings, maker, value, depth + 1) for maker, value in _entries(meanings, function, node)):
            return True
        parts = [node.value]
    elif isinstance(node, cst.Name):
        return is_rows(meanings, function, function.flow.reaching(node), depth)
    elif isinstance(node, cst.Call) and isinstance(node.func, cst.Attribute):
        if _flattens(node):
            return True
        parts = [*arguments(node)[0][:1]] if call_name(node) in JOINS else []
        parts += [node.func.value] if call_name(node) in KEEPS_AXES else []
    return any(is_rows(meanings, function, part, depth + 1) for part in parts)


def _entries(meanings: Meanings, function: Function, node: cst.Subscript) -> List[Tuple[Function, cst.CSTNode]]:
    """Return the values that ``package = render_all(...)`` writes under the key of ``package["mouths"]``."""
    key, call = key_of(node), function.flow.value_of(node.value)
    if not isinstance(key, str) or not isinstance(call, cst.Call):
        return []
    elements = [
        (maker, element)
        for maker in callees(meanings.program, function, call)
        for part in walk_expressions(maker.body)
        if isinstance(part, cst.Dict)
        for element in part.elements
    ]
    return [(m, e.value) for m, e in elements if isinstance(e, cst.DictElement) and constant(e.key) == key]


def _flattens(node: cst.Call) -> bool:
    """Return whether a call makes rows: ``image.flatten()``, ``image.reshape(3, -1)``, ``torch.masked_select(...)``."""
    if call_name(node) in ("reshape", "view"):
        sizes = [constant(value) for value in arguments(node)[0]]
        return -1 in sizes and len(sizes) < 3
    return call_name(node) == "masked_select" or (call_name(node) in ("flatten", "ravel") and not node.args)
