"""The calls of a function in a checkout: those by its name, and those that are certain."""

from __future__ import annotations

import ast
from itertools import islice
from typing import Iterator, List, Optional, Tuple

from legs_adapters.code.module import Class, Function
from legs_adapters.code.program import Program, Reference

_Call = Tuple[Function, ast.Call]  # with the function that it stands in


def _named(program: Program, function: Function, most: Optional[int] = None) -> Iterator[_Call]:
    """Yield the calls of a function's name elsewhere."""
    for caller in islice(program.mentioning(function.name, True), most):
        if caller is not function and caller.module.spend(len(caller.flow.calls)):
            yield from ((caller, call) for call in caller.flow.calls_of.get(function.name, ()))


def _resolved(program: Program, caller: Function, node: ast.AST) -> List[object]:
    return [reference.target for reference in program.resolve(caller, node)]


def likely_calls(program: Program, function: Function) -> Iterator[_Call]:
    """Yield the calls of a function's name, without those that resolve to another function."""
    for caller, call in _named(program, function):
        known = _resolved(program, caller, call.func)
        if not known or function in known:
            yield caller, call


def sure_calls(program: Program, function: Function) -> Iterator[_Call]:
    """Yield the calls that resolve to a function, if at most a dozen functions call its name."""
    for caller, call in _named(program, function, 12):
        if function in _resolved(program, caller, call.func):
            yield caller, call


def callees(program: Program, function: Function, call: ast.Call) -> List[Function]:
    """Return the functions of the checkout that a call resolves to for certain, without those of instances."""
    return [target for target in _resolved(program, function, call.func) if isinstance(target, Function)]


def values_of(program: Program, function: Function, node: Optional[ast.AST]) -> List[Tuple[Function, ast.AST]]:
    """Return what the functions return that an expression calls for certain, each value with its function."""
    runs = callees(program, function, node) if isinstance(node, ast.Call) else []
    return [(run, value) for run in runs for value in run.flow.returns]


def given_to(program: Program, function: Function, parameter: str) -> Iterator[Tuple[Function, Optional[ast.expr]]]:
    """Yield callers of a function's name, each with its argument for a parameter, None where it is missing."""
    return ((caller, function.given(call, parameter)) for caller, call in _named(program, function))


def handed(program: Program, function: Function, node: ast.AST) -> List[Reference]:
    """Return what callers pass for the parameter that is called: ``model(batch)``, ``model.loss(batch)``."""
    receiver = node.value if isinstance(node, ast.Attribute) else node
    kinds = {definition.kind for definition in function.flow.reaching(receiver)}
    if not function.name or not isinstance(receiver, ast.Name) or kinds - {"store"} != {"parameter"}:
        return []
    given = [(caller, value) for caller, value in given_to(program, function, receiver.id) if value is not None]
    found = [reference for caller, value in given for reference in program.resolve(caller, value)]
    instances = [reference for reference in dict.fromkeys(found) if reference.kind == "instance"]
    if not isinstance(node, ast.Attribute):
        return instances
    owners = [reference.target for reference in instances if isinstance(reference.target, Class)]
    return [reference for owner in owners for reference in program.member(owner, node.attr)]
