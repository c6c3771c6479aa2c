"""Entries of dictionaries: the literal part of a key, and what functions store under it in what they return."""

from __future__ import annotations

from typing import Iterable, List, Optional, Tuple

import libcst as cst

from legs_adapters.code.calls import callees
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import constant, same

__all__ = ["called_makers", "computed_key", "default_key", "formatted_key", "forward_maker", "stored", "written"]

_Entry = Tuple[Function, cst.CSTNode]  # a value, and the function that it stands in


def called_makers(program: Program, function: Function, package: cst.CSTNode) -> List[Function]:
    """Return the functions that ``package = render(...)`` calls, of a package that nothing else has made."""
    made = list(function.flow.reaching(package))
    call = made[0].value if len(made) == 1 and made[0].kind == "assign" else None
    if not isinstance(call, cst.Call):
        return []
    return callees(program, function, call)


def forward_maker(function: Function, package: cst.CSTNode) -> List[Function]:
    """Return the ``forward`` of a method's class, where the package is a parameter of the method."""
    forward = function.owner.methods.get("forward") if function.owner is not None else None
    given = function.flow.reaching(package)
    if forward is None or forward is function or not given or any(d.kind != "parameter" for d in given):
        return []
    return [forward]


def written(makers: Iterable[Function], key: str) -> List[_Entry]:
    """Return what stands under a name in the dictionaries that functions return: ``{"photo": image}``."""
    returned = [
        (maker, value)
        for maker in makers
        for each in maker.flow.returns
        for value in ([d.value for d in maker.flow.reaching(each)] if isinstance(each, cst.Name) else [each])
    ]
    return [
        (maker, element.value)
        for maker, value in returned
        if isinstance(value, cst.Dict)
        for element in value.elements
        if isinstance(element, cst.DictElement) and constant(element.key) == key
    ]


def stored(makers: Iterable[Function], key: str) -> List[_Entry]:
    """Return what functions store under a name in what they return: ``package["photo"] = image``."""
    return [
        (maker, definition.value)
        for maker in makers
        for each in maker.flow.returns
        if isinstance(each, cst.Name)
        for definition in maker.flow.definitions.get(f"{each.value}[{key!r}]", [])
        if definition.value is not None
    ]


def formatted_key(node: cst.Subscript) -> Optional[str]:
    """Return what is literal in the key of ``outputs[f"image_{i}"]`` or ``outputs["color", i]``."""
    element = node.slice[0].slice
    values = [each.slice.value for each in node.slice if isinstance(each.slice, cst.Index)]
    values += [each.value for value in values if isinstance(value, cst.Tuple) for each in value.elements]
    texts = [text for text in map(constant, values) if isinstance(text, str)]
    if texts:
        return "_".join(texts)
    if len(node.slice) != 1 or not isinstance(element, cst.Index) or not isinstance(element.value, cst.FormattedString):
        return None
    return "_".join(p.value for p in element.value.parts if isinstance(p, cst.FormattedStringText)) or None


def computed_key(function: Function, node: cst.Subscript) -> Optional[str]:
    """Return what is literal in the key of ``target["target_" + key]``; of ``pred[key]`` beside it, nothing."""
    index = node.slice[0].slice
    if len(node.slice) != 1 or not isinstance(index, cst.Index):
        return None
    if isinstance(index.value, cst.BinaryOperation):
        return _added_text(index.value)
    sums = [part for part in function.flow.expressions if isinstance(part, cst.BinaryOperation) and _added_text(part)]
    known = any(same(side, index.value) for part in sums for side in (part.left, part.right))
    return "" if known and isinstance(index.value, cst.Name) else None


def default_key(function: Function, node: cst.Subscript) -> object:
    """Return ``"rgb"`` for ``preds[key]`` of a function with the parameter ``key="rgb"``."""
    index = node.slice[0].slice
    if len(node.slice) != 1 or not isinstance(index, cst.Index) or not isinstance(index.value, cst.Name):
        return None
    found = list(function.flow.reaching(index.value))
    return constant(found[0].value) if len(found) == 1 and found[0].kind == "parameter" else None


def _added_text(node: cst.BinaryOperation) -> Optional[str]:
    """Return ``target_`` of ``"target_" + key``."""
    texts = [text for text in map(constant, (node.left, node.right)) if isinstance(text, str)]
    return "_".join(texts) if texts and isinstance(node.operator, cst.Add) else None
