"""Distinguish images from lists of pixels: mask indexing, and reshapes that flatten images."""

from __future__ import annotations

import ast
from typing import Iterator, List, Optional, Tuple

from legs_adapters.code.calls import callees
from legs_adapters.code.module import Function
from legs_adapters.code.reaching import Definition, Reaching
from legs_adapters.code.syntax import (
    arguments,
    call_name,
    constant,
    entries,
    given,
    indices,
    key_of,
    root_of,
    words,
)
from legs_adapters.lexicon.depiction import Meanings
from legs_adapters.lexicon.words import PICKING
from legs_adapters.tensors.operations import JOINS, KEEPS_AXES


def is_mask(meanings: Meanings, function: Function, node: ast.expr) -> bool:
    """Return whether an index is a mask of pixels."""
    if isinstance(node, ast.Slice):
        return False
    if isinstance(node, (ast.Compare, ast.UnaryOp)):
        return constant(node) is None
    name = root_of(node) if isinstance(node, (ast.Name, ast.Attribute)) else ""
    return bool(set(words(name)) & PICKING) or meanings.meaning(function, node).kind == "mask"


def makes_mask(call: ast.Call) -> bool:
    """Return whether a function makes a mask of an error map, by its name."""
    return bool(set(words(call_name(call))) & PICKING) or call_name(call) == "quantile"


def is_rows(meanings: Meanings, function: Function, side: ast.AST) -> bool:
    """Return whether a side of a term, or what reaches it, is a list of pixels, ``image.reshape(-1, 3)``."""

    def rows(where: Function, node: ast.AST | Reaching) -> bool:
        taken = indices(node) if isinstance(node, ast.Subscript) and not isinstance(key_of(node), str) else ()
        if node is not side and any(is_mask(meanings, where, index) for index in taken):
            return True  # of a side itself, the images are written where both carry the mask
        parts = [*_made_from(where, node), *_entries(meanings, where, node)]
        return _flattens(node) or any(meanings.questions.answer(*part, rows, False) for part in parts)

    return meanings.questions.answer(function, side, rows, False)


def _made_from(function: Function, node: ast.AST | Reaching) -> List[Tuple[Function, ast.AST | Reaching]]:
    """Return what is a list of pixels where the whole is one."""
    parts: List[Optional[ast.AST | Reaching]] = []
    if isinstance(node, Definition):
        if node.kind == "mutate" and isinstance(node.value, ast.Call):
            parts += arguments(node.value)[0]  # crops = [], then crops.append(crop.flatten())
        parts += [node.value] if node.kind == "assign" else []
    elif isinstance(node, Reaching):
        parts += node.parts
    elif isinstance(node, ast.BinOp):
        parts += [node.left, node.right]
    elif isinstance(node, ast.Subscript):
        parts += [node.value]
    elif isinstance(node, ast.Name):
        parts += [function.flow.reaching(node)]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        parts += arguments(node)[0][:1] if call_name(node) in JOINS else []
        parts += [node.func.value] if call_name(node) in KEEPS_AXES else []
    return [(function, part) for part in parts if part is not None]


def _entries(meanings: Meanings, function: Function, node: ast.AST | Reaching) -> Iterator[Tuple[Function, ast.AST]]:
    """Yield the values that ``package = render_all(...)`` writes under the key of ``package["mouths"]``."""
    if isinstance(node, ast.Subscript) and isinstance(key_of(node), str):
        call = function.flow.value_of(node.value)
        for maker in callees(meanings.program, function, call) if isinstance(call, ast.Call) else ():
            literal = [entry for part in maker.walk() for entry in entries(part)]
            yield from ((maker, value) for key, value in literal if constant(key) == key_of(node))


def _flattens(node: object) -> bool:
    """Return whether a call makes rows: ``image.flatten()``, ``image.reshape(3, -1)``, ``torch.masked_select(...)``."""
    if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
        return False
    if call_name(node) in ("reshape", "view"):
        sizes = [constant(value) for value in arguments(node)[0]]
        return -1 in sizes and len(sizes) < 3
    return call_name(node) == "masked_select" or (call_name(node) in ("flatten", "ravel") and not given(node))
