"""Find what functions return: one expression, a parameter, the entries of a dictionary and their keys."""

from __future__ import annotations

from typing import Dict, Iterable, List, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.calls import callees
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import arguments, constant, same

__all__ = [
    "called_makers",
    "computed_key",
    "default_key",
    "formatted_key",
    "forward_maker",
    "known_arguments",
    "passed_on",
    "returned",
    "stored",
    "written",
]

_Entry = Tuple[Function, cst.CSTNode]  # a value, and the function that it stands in


def returned(function: Function, known: Dict[str, object]) -> Optional[cst.CSTNode]:
    """Return what a function returns, its local names filled in; None where that is not one expression.

    ``known`` are values of parameters, which decide the branches that test them.
    """
    return _follow(function.body.body, {}, known)


def known_arguments(function: Function, call: Optional[cst.Call]) -> Dict[str, object]:
    """Return the parameters whose values a call fixes: literals, and defaults of missing arguments."""
    assert isinstance(function.node, cst.FunctionDef)
    if call is None:
        return {}
    positional, keywords, starred = arguments(call)
    known: Dict[str, object] = {}
    missing = object()
    if starred:
        return known
    params = [p for p in (*function.node.params.posonly_params, *function.node.params.params)]
    params = [p for p in params if p.name.value in function.parameters]
    for i, param in enumerate([*params, *function.node.params.kwonly_params]):
        name = param.name.value
        if i < len(positional) and param in params:
            value = constant(positional[i], missing)
        elif name in keywords:
            value = constant(keywords[name], missing)
        else:
            value = constant(param.default, missing) if param.default is not None else missing
        if value is not missing:
            known[name] = value
    return known


def _follow(
    statements: object, names: Dict[str, cst.BaseExpression], known: Dict[str, object]
) -> Optional[cst.CSTNode]:
    """Return what straight-line code returns, its local names filled in; None where that is not one expression."""
    flat: List[cst.CSTNode] = []
    for statement in statements:  # type: ignore[attr-defined]
        flat.extend(statement.body if isinstance(statement, cst.SimpleStatementLine) else [statement])
    for statement in flat:
        if isinstance(statement, cst.Return):
            if statement.value is None:
                return None
            return _decide(_fill(statement.value, names), known)
        if isinstance(statement, cst.Assign) and len(statement.targets) == 1:
            target = statement.targets[0].target
            if not isinstance(target, cst.Name):
                return None
            names[target.value] = _fill(statement.value, names)
        elif isinstance(statement, cst.If):
            truth = _truth(statement.test, known)
            if truth is None:
                return None
            if truth:
                returned = _follow(statement.body.body, names, known)
                if returned is not None or _leaves(statement.body.body):
                    return returned
            elif isinstance(statement.orelse, cst.Else):
                returned = _follow(statement.orelse.body.body, names, known)
                if returned is not None or _leaves(statement.orelse.body.body):
                    return returned
            elif statement.orelse is not None:
                return None
        elif (
            isinstance(statement, cst.Expr) and isinstance(statement.value, (cst.SimpleString, cst.ConcatenatedString))
        ) or isinstance(statement, (cst.Assert, cst.Pass)):
            continue
        else:
            return None
    return None


def _leaves(statements: object) -> bool:
    last = list(statements)[-1]  # type: ignore[call-overload]
    return isinstance(last, cst.SimpleStatementLine) and isinstance(last.body[-1], (cst.Return, cst.Raise))


def _fill(node: cst.BaseExpression, names: Dict[str, cst.BaseExpression]) -> cst.BaseExpression:
    if not names:
        return node

    class Fill(cst.CSTTransformer):
        def leave_Name(self, original_node: cst.Name, updated_node: cst.Name) -> cst.BaseExpression:
            return names.get(original_node.value, updated_node)

        def visit_Attribute_attr(self, node: cst.Attribute) -> None:
            pass

        def leave_Attribute(self, original_node: cst.Attribute, updated_node: cst.Attribute) -> cst.BaseExpression:
            return updated_node.with_changes(attr=original_node.attr)

        def leave_Arg(self, original_node: cst.Arg, updated_node: cst.Arg) -> cst.Arg:
            return updated_node.with_changes(keyword=original_node.keyword)

    filled = node.visit(Fill())
    assert isinstance(filled, cst.BaseExpression)
    return filled


def _decide(node: cst.BaseExpression, known: Dict[str, object]) -> cst.BaseExpression:
    if isinstance(node, cst.IfExp):
        truth = _truth(node.test, known)
        if truth is not None:
            return _decide(node.body if truth else node.orelse, known)
    return node


def _truth(node: cst.BaseExpression, known: Dict[str, object]) -> Optional[bool]:
    if isinstance(node, cst.Name) and node.value in known:
        return bool(known[node.value])
    if isinstance(node, cst.UnaryOperation) and isinstance(node.operator, cst.Not):
        inner = _truth(node.expression, known)
        return None if inner is None else not inner
    if isinstance(node, cst.Comparison) and len(node.comparisons) == 1 and isinstance(node.left, cst.Name):
        comparison = node.comparisons[0]
        missing = object()
        right = constant(comparison.comparator, missing)
        if node.left.value in known and right is not missing:
            left = known[node.left.value]
            if isinstance(comparison.operator, (cst.Is, cst.Equal)):
                return left == right
            if isinstance(comparison.operator, (cst.IsNot, cst.NotEqual)):
                return left != right
    return None


def passed_on(function: Function, node: cst.CSTNode) -> Optional[str]:
    """Return the parameter that an expression is, or is an element of, on every path."""
    found: Set[Optional[str]] = set()
    work, seen = [node], set()
    while work:
        part = work.pop()
        while isinstance(part, cst.Subscript):
            part = part.value
        if not isinstance(part, cst.Name):
            return None
        for definition in function.flow.reaching(part):
            value: Optional[cst.CSTNode] = definition.value
            if definition.kind == "parameter":
                found.add(definition.place)
            elif definition.kind not in ("assign", "element") or value is None:
                return None
            elif id(definition) not in seen:
                seen.add(id(definition))
                if definition.kind == "element" and isinstance(value, cst.Tuple):
                    if definition.index is None or definition.index >= len(value.elements):
                        return None
                    value = value.elements[definition.index].value
                work.append(value)
    return found.pop() if len(found) == 1 else None


def called_makers(program: Program, function: Function, package: cst.CSTNode) -> List[Function]:
    """Return the functions that ``package = render(...)`` calls, where that is the only definition of the package."""
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
    """Return the values of a key in the dictionaries that functions return: ``{"photo": image}``."""
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
    """Return the values that functions store under a key of their result: ``package["photo"] = image``."""
    return [
        (maker, definition.value)
        for maker in makers
        for each in maker.flow.returns
        if isinstance(each, cst.Name)
        for definition in maker.flow.definitions.get(f"{each.value}[{key!r}]", [])
        if definition.value is not None
    ]


def formatted_key(node: cst.Subscript) -> Optional[str]:
    """Return the literal part of the key of ``outputs[f"image_{i}"]`` or ``outputs["color", i]``."""
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
    """Return the literal part of the key of ``target["target_" + key]``; nothing for ``pred[key]`` beside it."""
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
