"""Compute the backward slice of every ``.backward()``: the expressions that its value comes from, across files."""

from __future__ import annotations

import ast
import re
from typing import Dict, List, Optional, Sequence, Set, Tuple

from legs_adapters.code.calls import given_to, handed
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program, Reference
from legs_adapters.code.reaching import Definition, Reaching
from legs_adapters.code.syntax import (
    arguments,
    call_name,
    children,
    constant,
    entries,
    given,
    key_of,
)
from legs_adapters.tensors.operations import BACKWARD, ENDS_GRADIENT, HOOKS, LOSSES, SIZES
from legs_adapters.tensors.steps import is_backward

TRAINS = re.compile(r"(?:backward|grad(?<!\wgrad))\s*\(")  # a text that runs a backward pass
_Site = Tuple[Function, ast.Call]  # a call, behind the function that it stands in
_ANY = object()


class Training:
    """The slice of a program that its backward passes depend on.

    Attributes:
        roots: the functions that call ``.backward()`` or return what a framework trains on. A call of
            ``torch.autograd.grad`` only scores.
        sites: for a function that contributes, the calls (each with its caller) through which it does.
    """

    def __init__(self, program: Program) -> None:
        self.program = program
        self.roots: List[Function] = []
        self._sites: Dict[Function, Dict[int, _Site]] = {}
        # By an expression's id the call that alone takes its gradient, to be read; None for what is trained.
        self._reached: Dict[int, Optional[_Site]] = {}
        self._scoring: Optional[_Site] = None  # the call from which the slice begins now
        self._touched: Set[Function] = set()
        self._begun: Set[Function] = set()  # those in which the slice begins
        self._done: Set[Tuple[int, object]] = set()
        self._work: List[Tuple[Function, ast.AST | Reaching, object]] = []
        scoring: List[_Site] = []
        for module in program.matching(TRAINS):
            for function in module.scopes(TRAINS.search):
                passes = [call for call in function.flow.calls if is_backward(call)]
                scoring += [(function, call) for call in function.flow.calls if self._is_grad(function, call)]
                self._begin(function, [value for call in passes for value in _trained_by(call)], bool(passes))
        for method in (method for name in sorted(HOOKS) for method in program.methods_named(name)):
            self._begin(method, method.flow.returns, True)
        self._follow()
        for self._scoring in scoring:
            self._begin(self._scoring[0], _trained_by(self._scoring[1]), False)
            self._follow()
        self.sites: Dict[Function, List[_Site]] = {runs: list(calls.values()) for runs, calls in self._sites.items()}

    def _follow(self) -> None:
        while self._work:
            function, node, key = self._work.pop()
            if function.module.spend(1):
                self._reach(function, node, key) if isinstance(node, Reaching) else self._visit(function, node, key)

    def scores(self, node: ast.AST) -> Optional[_Site]:
        """Return the call of ``torch.autograd.grad`` that alone takes the gradient of this expression, to be read."""
        return self._reached.get(id(node))

    def _is_grad(self, function: Function, call: ast.Call) -> bool:
        """Return whether a call is ``torch.autograd.grad(...)``."""
        return call_name(call) == "grad" and any(map(_takes_gradient, self.program.resolve(function, call.func)))

    def includes(self, node: ast.AST) -> bool:
        """Return whether a backward pass reaches this expression."""
        return self._reached.get(id(node), ()) is None

    def touches(self, function: Function) -> bool:
        """Return whether a backward pass reaches an expression of this function."""
        return function in self._touched

    def _begin(self, function: Function, values: Sequence[ast.AST], is_root: bool) -> None:
        if is_root and function not in self.roots:
            self.roots.append(function)
        self._begun.update([function] if values else [])
        for value in values:
            self._push(function, value)

    def _push(self, function: Function, node: Optional[ast.AST | Reaching], key: object = _ANY) -> None:
        mark = (id(node), key if isinstance(key, (str, int)) else _ANY)
        if node is not None and mark not in self._done:
            self._done.add(mark)
            self._work.append((function, node, key))

    def _visit(self, function: Function, node: ast.AST, key: object) -> None:
        """Mark what ``node`` (or, with a key, ``node[key]``) gets its value from."""
        self._touched.add(function)
        found = _entries(node, key)
        for entry in found:
            self._push(function, entry)
        if found:
            return
        self._reached.setdefault(id(node), self._scoring)
        if isinstance(node, ast.Call):
            self._call(function, node, key)
        elif isinstance(node, ast.Attribute) and node.attr in SIZES:
            pass
        elif isinstance(node, (ast.Name, ast.Attribute, ast.Subscript)):
            self._place(function, node, key)
        elif isinstance(node, ast.DictComp):
            for part in (node.value, *node.generators):
                self._push(function, part)
        elif isinstance(node, ast.comprehension):
            self._push(function, node.iter)
        elif isinstance(node, ast.IfExp):
            self._push(function, node.body, key)
            self._push(function, node.orelse, key)
        elif not isinstance(node, ast.Compare):
            for child in children(node):
                self._push(function, child)

    def _call(self, function: Function, node: ast.Call, key: object) -> None:
        name, owner = call_name(node), node.func.value if isinstance(node.func, ast.Attribute) else None
        positional = arguments(node)[0]
        literal = constant(positional[0]) if positional else None
        if owner is not None and name in ENDS_GRADIENT | SIZES | BACKWARD:
            return
        if owner is not None and name == "get" and isinstance(literal, str):
            self._push(function, owner, literal)
            return
        references = self.program.resolve(function, node.func) or handed(self.program, function, node.func)
        if any(map(_takes_gradient, references)):
            return
        for reference in references:
            if isinstance(reference.target, ast.Lambda):
                self._push(function, reference.target.body)
            for callee in self.program.run_by(reference):
                self._sites.setdefault(callee, {})[id(node)] = (function, node)
                for value in callee.flow.returns:
                    self._push(callee, value, key)
        for arg in given(node):
            self._push(function, arg.value)
        if not isinstance(node.func, ast.Name):
            self._push(function, owner or node.func)

    def _place(self, function: Function, node: ast.AST, key: object) -> None:
        found = self.program.lookup(function, node)
        if found is not None:
            self._push(*found, key)
        elif isinstance(node, ast.Subscript):
            inner = key_of(node)
            self._push(function, node.value, _ANY if inner is None else inner)
        elif isinstance(node, ast.Attribute):
            owner = self.program.owner_of(function)
            if not isinstance(node.value, ast.Name) or node.value.id != "self":
                self._push(function, node.value, "." + node.attr)
            elif owner is not None:
                for one in self.program.lineage(owner):
                    for where, made in one.stores(node.attr):
                        self._push(where, made, key)

    def _reach(self, function: Function, definition: Reaching, key: object) -> None:
        if not isinstance(definition, Definition):
            for part in definition.parts:
                self._push(function, part, key)
            return
        value, kind = definition.value, definition.kind
        is_given = kind == "parameter" and definition.place in function.parameters and function in self._begun
        for caller, argument in given_to(self.program, function, definition.place) if is_given else ():
            self._push(caller, argument, key)  # def step(losses): sum(losses.values()).backward()
        if kind == "store":
            if definition.key in (None, key) or key is _ANY:
                self._push(function, value)
        elif isinstance(definition.node, ast.AugAssign):
            self._push(function, definition.node.target, key)
            self._push(function, value)
        elif kind in ("element", "part"):
            self._push(function, value, _ANY if definition.index is None or kind == "part" else definition.index)
        elif kind in ("mutate", "inplace") and isinstance(value, ast.Call):
            for arg in given(value):
                self._push(function, arg.value, key if call_name(value) == "update" else _ANY)
        else:
            self._push(function, value, key)


def _takes_gradient(reference: Reference) -> bool:
    return reference.kind == "external" and str(reference.target).endswith("autograd.grad")


def _trained_by(call: ast.Call) -> List[ast.expr]:
    """Return the value whose gradients a backward pass takes."""
    values = [arg.value for arg in given(call) if not arg.keyword or arg.keyword in LOSSES]
    if call_name(call) == "grad":
        return values[:1]
    return [*values, call.func.value] if isinstance(call.func, ast.Attribute) else values


def _entries(node: ast.AST, key: object) -> Sequence[ast.AST]:
    """Return the entry of a literal tuple, list or dictionary under a key; nothing where it is not known."""
    if isinstance(node, (ast.Tuple, ast.List)) and isinstance(key, int):
        return node.elts[key:][:1] if -len(node.elts) <= key else []
    if isinstance(node, ast.Dict) and key is not _ANY:
        found = [value for known, value in entries(node) if constant(known) == key]
        return found if None not in node.keys else []
    return []
