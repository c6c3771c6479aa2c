"""The calls of a function in a checkout: those by its name, those that are certain, and whether others are possible."""

from __future__ import annotations

import re
from itertools import islice
from typing import Iterator, List, NamedTuple, Optional, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program, Reference
from legs_adapters.code.syntax import call_name, root_of

__all__ = ["Calls", "callees", "calls_of", "given_to", "handed", "likely_calls", "sure_calls"]

_METHODS = {"staticmethod", "classmethod"}  # decorators that do not pass the function on
_Call = Tuple[Function, cst.Call]  # with the function that it stands in


class Calls(NamedTuple):
    """The calls of a function, each with its caller; and the place of a further possible call, None without one."""

    known: List[_Call]
    lost: Optional[str] = None


def _named(program: Program, function: Function, most: Optional[int] = None) -> Iterator[_Call]:
    """Yield the calls of a function's name elsewhere."""
    for caller in islice(program.mentioning(function.name, called=True), most):
        if caller is not function and caller.module.spend(len(caller.flow.calls)):
            yield from ((caller, call) for call in caller.flow.calls if call_name(call) == function.name)


def _resolved(program: Program, caller: Function, node: cst.CSTNode) -> List[object]:
    return [reference.target for reference in program.resolve(caller, node) if not reference.guess]


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


def callees(program: Program, function: Function, call: cst.Call) -> List[Function]:
    """Return the functions of the checkout that a call resolves to for certain, without those of instances."""
    return [target for target in _resolved(program, function, call.func) if isinstance(target, Function)]


def given_to(
    program: Program, function: Function, parameter: str
) -> Iterator[Tuple[Function, Optional[cst.BaseExpression]]]:
    """Yield callers of a function's name, each with its argument for a parameter, None where it is missing."""
    return ((caller, function.given(call, parameter)) for caller, call in _named(program, function))


def handed(program: Program, function: Function, node: cst.Name) -> List[Reference]:
    """Return the modules that callers pass for a parameter, ``model`` of ``train_epoch(model, loader)``."""
    kinds = {definition.kind for definition in function.flow.reaching(node)}
    if not function.name or kinds - {"store"} != {"parameter"}:
        return []
    given = [(caller, value) for caller, value in given_to(program, function, node.value) if value is not None]
    found = [reference for caller, value in given for reference in program.resolve(caller, value)]
    return [reference for reference in dict.fromkeys(found) if reference.kind == "instance"]


def calls_of(program: Program, function: Function) -> Calls:
    """Return the calls of a function.

    A further call is possible where it is a value, renamed in an import, in quotes or in a file that is not read. A
    ``forward`` and a decorated function may be called under any name.
    """
    known, name = list(likely_calls(program, function)), re.escape(function.name)
    if function.runs_by_instance or set(function.decorators) - _METHODS:
        return Calls(known, f"{function.module.path}:{function.line}")
    for scope in program.mentioning(function.name):
        called = {id(call.func) for call in scope.flow.calls}
        mentions: List[cst.CSTNode] = [
            node
            for node in scope.flow.places
            if root_of(node) == function.name and id(node) not in called and function in _resolved(program, scope, node)
        ]
        mentions += [alias for node in scope.flow.imports for alias in _renamed(node, function.name)]
        if mentions:
            return Calls(known, f"{scope.module.path}:{scope.place(mentions[0]).line}")
    quoted, unread = re.compile(rf"[\"']{name}[\"']"), re.compile(rf"\b{name}\b")
    texts = [(path, source.text, quoted) for path, source in program.sources.items() if path not in program.unreadable]
    texts += [(path, program.sources[path].text, unread) for path in program.unreadable]
    texts += [(path, text, unread) for path, text in program.unread.items()]
    return Calls(known, next((path for path, text, mention in sorted(texts) if mention.search(text)), None))


def _renamed(node: cst.CSTNode, name: str) -> List[cst.ImportAlias]:
    """Return ``from losses import photometric as loss`` of an import of a name."""
    names = node.names if isinstance(node, cst.ImportFrom) and not isinstance(node.names, cst.ImportStar) else ()
    return [alias for alias in names if alias.asname is not None and alias.evaluated_name == name]
