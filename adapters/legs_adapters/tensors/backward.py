"""Compute the backward slice of every ``.backward()``: the expressions that its value comes from, across files."""

from __future__ import annotations

import ast
import re
from typing import Dict, List, Optional, Sequence, Set, Tuple

from legs_adapters.code.calls import callees, given_to, handed, sure_calls
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program, Reference
from legs_adapters.code.reaching import Definition, Reaching
from legs_adapters.code.syntax import (
    arguments,
    attribute_chain,
    call_name,
    children,
    constant,
    entries,
    given,
    key_of,
    path_of,
    walk_expressions,
)
from legs_adapters.tensors.operations import APPLIES, BACKWARD, ENDS_GRADIENT, HOOKS, LOSSES, SIZES, depends
from legs_adapters.tensors.steps import is_backward

TRAINS = re.compile(r"(?:backward|grad(?<!\wgrad))\s*\(")  # a text that runs a backward pass
_Site = Tuple[Function, ast.Call]  # a call, behind the function that it stands in
_ANY = object()
_DEPTH = 2


class Training:
    """The slice of a program that its backward passes depend on.

    Attributes:
        roots: the functions that call ``.backward()`` or return what a framework trains on. A call of
            ``torch.autograd.grad`` is one where a parameter gets its result; else it only scores.
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
                grads = [call for call in function.flow.calls if self._is_grad(function, call)]
                passes = [call for call in function.flow.calls if is_backward(call)]
                passes += [call for call in grads if self._is_applied(function, call, set())]
                scoring += [(function, call) for call in grads if call not in passes]
                self._begin(function, [value for call in passes for value in _trained_by(call)], bool(passes))
        for method in (method for name in sorted(HOOKS) for method in program.methods_named(name)):
            self._begin(method, method.flow.returns, True)
        self._follow()
        for self._scoring in scoring:
            self._begin(self._scoring[0], _trained_by(self._scoring[1]), False)
            self._follow()
        self.sites: Dict[Function, List[_Site]] = {runs: list(calls.values()) for runs, calls in self._sites.items()}

    def _is_applied(self, function: Function, call: Optional[ast.Call], names: Set[str], depth: int = 0) -> bool:
        """Return whether a parameter steps by a gradient, a call's or one of these names: ``p.grad = g``, ``p -= g``.

        It is followed into functions that are given it, callers that get it, and methods of the class that stores it.
        """

        def has(value: ast.AST) -> bool:
            return depends(function, value, names, call)

        made = [(each, each.value) for each in function.flow.every_definition if each.value is not None]
        steps = [value for each, value in made if _is_less(each) or each.place.endswith(".grad")]
        steps += [arg.value for each in function.flow.calls if _is_downhill(each) for arg in given(each)]
        if any(has(value) and not any(map(_loses_sign, attribute_chain(value))) for value in steps):
            return True
        inner: List[Tuple[Function, Optional[ast.Call], Set[str]]] = []
        for each in function.flow.calls if depth < _DEPTH else ():
            for callee in callees(self.program, function, each):
                taken = [(name, callee.given(each, name)) for name in callee.parameters]
                inner += [(callee, None, {name}) for name, value in taken if value is not None and has(value)]
        if depth < _DEPTH and any(map(has, function.flow.returns)):
            inner += [(caller, site, set()) for caller, site in sure_calls(self.program, function)]
        owner = self.program.owner_of(function)
        kept = [(each.place, value) for each, value in made if each.place.startswith("self.") and depth < _DEPTH]
        stored = {place for place, value in kept if has(value)}
        others = owner.methods.values() if owner is not None and stored else ()
        inner += [(method, None, stored) for method in others if method is not function]
        return any(self._is_applied(*each, depth + 1) for each in inner)

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


def _is_less(made: Definition) -> bool:
    """Return whether a place becomes less: ``p -= rate * g``, ``p = (p - rate * g).detach()``."""
    parts = [part for part in attribute_chain(made.value or made.node) if isinstance(part, ast.BinOp)]
    less = any(isinstance(part.op, ast.Sub) and path_of(part.left) == made.place for part in parts)
    return less or (isinstance(made.node, ast.AugAssign) and isinstance(made.node.op, ast.Sub))


def _loses_sign(node: ast.AST) -> bool:
    """Return whether it is a size, ``gradient.abs()``: nothing steps by one."""
    return isinstance(node, ast.Call) and call_name(node) in ("abs", "norm", "square")


def _is_downhill(call: ast.Call) -> bool:
    """Return whether a call may step by its arguments: ``p.add_(g, alpha=-rate)``, no sum: ``scores.add_(g.abs())``."""
    if call_name(call) == "setattr" and len(given(call)) == 3:
        return constant(given(call)[1].value) == "grad"
    signs = [part.op for part in walk_expressions(call) if isinstance(part, ast.UnaryOp)]
    is_sum = call_name(call) == "add_" and not any(isinstance(sign, ast.USub) for sign in signs)
    return call_name(call) in APPLIES and not is_sum


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
