"""What a package holds by name: ``package["photo"]``, in the dictionaries that functions of the codebase return."""

from __future__ import annotations

from typing import Iterable, List, Tuple

import libcst as cst

from legs_adapters.reading.module import Function
from legs_adapters.reading.program import Program
from legs_adapters.reading.syntax import constant

__all__ = ["called_makers", "forward_maker", "stored", "written"]

_Entry = Tuple[Function, cst.CSTNode]  # a value, and the function that it stands in


def called_makers(program: Program, function: Function, package: cst.CSTNode) -> List[Function]:
    """Return the functions that ``package = render(...)`` calls, of a package that nothing else has made."""
    made = list(function.flow.reaching(package))
    call = made[0].value if len(made) == 1 and made[0].kind == "assign" else None
    if not isinstance(call, cst.Call):
        return []
    called = [reference.target for reference in program.resolve(function, call.func) if not reference.guess]
    return [target for target in called if isinstance(target, Function)]


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
