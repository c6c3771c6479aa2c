"""Trace a value to the calls that produced it, and tell renderings by those calls' names."""

from __future__ import annotations

from typing import List, Optional, Set

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.reaching import Definition
from legs_adapters.code.syntax import arguments, call_name, constant, key_of, words
from legs_adapters.lexicon.names import role_of_words
from legs_adapters.tensors.operations import KEEPS_VALUES, MODULES

__all__ = ["is_rendering"]


def is_rendering(function: Function, node: cst.CSTNode) -> bool:
    """Return whether a value was produced by functions that render, on every path."""
    makers = _makers(function, node, set())
    return bool(makers) and all(maker is not None and _renders(maker) for maker in makers)


def _renders(call: cst.Call) -> bool:
    name = call_name(call)
    return words(name)[:1] in (("render",), ("rendering",)) and role_of_words(name) == "render"


def _makers(function: Function, node: Optional[cst.CSTNode], seen: Set[int]) -> List[Optional[cst.Call]]:
    """Return the calls that produced a value, through changes of type, axes and range; None for anything else.

    A value that depends on itself has no producer there.
    """
    if node is None:
        return [None]
    if id(node) in seen:
        return []
    seen.add(id(node))
    if isinstance(node, cst.Name):
        definitions = sorted(function.flow.reaching(node), key=lambda d: d.order)
        filled = any(definition.kind == "mutate" for definition in definitions)
        parts = [_value(definition) for definition in definitions if not (filled and _is_empty(definition.value))]
        return [maker for part in parts for maker in _makers(function, part, seen)] if parts else [None]
    if isinstance(node, (cst.Subscript, cst.Attribute)):
        part = node.attr.value if isinstance(node, cst.Attribute) else str(key_of(node))
        return [None] if role_of_words(part) == "target" else _makers(function, node.value, seen)
    if isinstance(node, (cst.ListComp, cst.GeneratorExp)):
        return _makers(function, node.elt, seen)
    if isinstance(node, cst.BinaryOperation) and constant(node.right) is not None:
        return _makers(function, node.left, seen)
    if isinstance(node, cst.BinaryOperation) and isinstance(node.operator, cst.Multiply):  # image * mask
        return [*_makers(function, node.left, seen), *_makers(function, node.right, seen)]
    if isinstance(node, cst.Call) and call_name(node) in KEEPS_VALUES:
        base = node.func.value if isinstance(node.func, cst.Attribute) else None
        if base is None or (isinstance(base, cst.Name) and base.value in MODULES):
            return _makers(function, arguments(node)[0][0] if arguments(node)[0] else None, seen)
        return _makers(function, base, seen)
    return [node if isinstance(node, cst.Call) else None]


def _is_empty(node: Optional[cst.CSTNode]) -> bool:
    return isinstance(node, cst.List) and not node.elements


def _value(definition: Definition) -> Optional[cst.CSTNode]:
    """Return the value that is assigned, or that a loop iterates over."""
    value = definition.value
    if definition.kind == "mutate" and isinstance(value, cst.Call):  # renderings.append(image)
        given = arguments(value)[0]
        return given[0] if call_name(value) == "append" and given else None
    if definition.kind == "element" and isinstance(value, cst.Call):
        given, index = arguments(value)[0], definition.index
        if call_name(value) == "enumerate" and given:
            return given[0] if index == 1 else None
        if call_name(value) == "zip" and index is not None:
            return given[index] if index < len(given) else None
        return None if index else value  # a renderer returns the rendering first
    return value if definition.kind in ("assign", "element") else None
