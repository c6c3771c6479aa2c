"""Distinguish images from lists of pixels: mask indexing, and reshapes that flatten images."""

from __future__ import annotations

from typing import Iterator, List, Optional, Tuple

import libcst as cst

from legs_adapters.code.calls import callees
from legs_adapters.code.module import Function
from legs_adapters.code.reaching import Definition, Reaching
from legs_adapters.code.syntax import arguments, call_name, constant, key_of, walk_expressions, words
from legs_adapters.lexicon.depiction import Meanings
from legs_adapters.lexicon.words import PICKING
from legs_adapters.tensors.operations import JOINS, KEEPS_AXES


def is_mask(meanings: Meanings, function: Function, element: cst.SubscriptElement) -> bool:
    """Return whether an index is a mask of pixels."""
    if not isinstance(element.slice, cst.Index):
        return False
    node = element.slice.value
    if isinstance(node, (cst.Comparison, cst.UnaryOperation)):
        return constant(node) is None
    name = node.value if isinstance(node, cst.Name) else node.attr.value if isinstance(node, cst.Attribute) else ""
    return bool(set(words(name)) & PICKING) or meanings.meaning(function, node).kind == "mask"


def makes_mask(call: cst.Call) -> bool:
    """Return whether a function makes a mask of an error map, by its name."""
    return bool(set(words(call_name(call))) & PICKING) or call_name(call) == "quantile"


def is_rows(meanings: Meanings, function: Function, side: cst.CSTNode) -> bool:
    """Return whether a side of a term, or what reaches it, is a list of pixels, ``image.reshape(-1, 3)``."""

    def rows(where: Function, node: cst.CSTNode | Reaching) -> bool:
        indices = node.slice if isinstance(node, cst.Subscript) and not isinstance(key_of(node), str) else ()
        if node is not side and any(is_mask(meanings, where, index) for index in indices):
            return True  # of a side itself, the images are written where both carry the mask
        parts = [*_made_from(where, node), *_entries(meanings, where, node)]
        return _flattens(node) or any(meanings.questions.answer(*part, rows, False) for part in parts)

    return meanings.questions.answer(function, side, rows, False)


def _made_from(function: Function, node: cst.CSTNode | Reaching) -> List[Tuple[Function, cst.CSTNode | Reaching]]:
    """Return what is a list of pixels where the whole is one."""
    parts: List[Optional[cst.CSTNode | Reaching]] = []
    if isinstance(node, Definition):
        if node.kind == "mutate" and isinstance(node.value, cst.Call):
            parts += arguments(node.value)[0]  # crops = [], then crops.append(crop.flatten())
        parts += [node.value] if node.kind == "assign" else []
    elif isinstance(node, Reaching):
        parts += node.parts
    elif isinstance(node, cst.BinaryOperation):
        parts += [node.left, node.right]
    elif isinstance(node, cst.Subscript):
        parts += [node.value]
    elif isinstance(node, cst.Name):
        parts += [function.flow.reaching(node)]
    elif isinstance(node, cst.Call) and isinstance(node.func, cst.Attribute):
        parts += arguments(node)[0][:1] if call_name(node) in JOINS else []
        parts += [node.func.value] if call_name(node) in KEEPS_AXES else []
    return [(function, part) for part in parts if part is not None]


def _entries(
    meanings: Meanings, function: Function, node: cst.CSTNode | Reaching
) -> Iterator[Tuple[Function, cst.CSTNode]]:
    """Yield the values that ``package = render_all(...)`` writes under the key of ``package["mouths"]``."""
    if isinstance(node, cst.Subscript) and isinstance(key_of(node), str):
        call = function.flow.value_of(node.value)
        for maker in callees(meanings.program, function, call) if isinstance(call, cst.Call) else ():
            literal = [part for part in walk_expressions(maker.body) if isinstance(part, cst.DictElement)]
            yield from ((maker, each.value) for each in literal if constant(each.key) == key_of(node))


def _flattens(node: object) -> bool:
    """Return whether a call makes rows: ``image.flatten()``, ``image.reshape(3, -1)``, ``torch.masked_select(...)``."""
    if not isinstance(node, cst.Call) or not isinstance(node.func, cst.Attribute):
        return False
    if call_name(node) in ("reshape", "view"):
        sizes = [constant(value) for value in arguments(node)[0]]
        return -1 in sizes and len(sizes) < 3
    return call_name(node) == "masked_select" or (call_name(node) in ("flatten", "ravel") and not node.args)
