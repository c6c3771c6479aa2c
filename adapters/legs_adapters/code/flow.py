"""Reaching definitions: for every place that a function reads, the assignments that its value can come from.

A body is walked in the order of execution. Branches are joined; the body of an outermost loop is walked twice.
"""

from __future__ import annotations

import math
import re
from typing import Any, Dict, List, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.limits import remembered
from legs_adapters.code.reaching import Definition, Env, Reaching
from legs_adapters.code.syntax import (
    call_name,
    children,
    dotted,
    every_parameter,
    key_of,
    path_of,
    walk_expressions,
)

_NOTHING = Reaching()
_PART = re.compile(r"[.\[]")
MUTATORS = {"append", "add", "extend", "insert", "update", "setdefault", "appendleft", "__setitem__"}


class Flow:
    """Walk one function body, or a module's top level.

    Args:
        body: its statements.
        parameters: the function's parameters; None for a module.
        most: the steps after which the walk ends.

    Attributes:
        definitions: every definition by place, in source order: what a nested function sees.
        calls, calls_of: every call in the body, in source order, nested functions excepted; those of a name.
        expressions: every call and binary operation.
        reads: every name that is read, in source order.
        returns: the expressions that it returns or yields.
        imports: its import statements.
        contexts: by a node's id, the loops, the context managers (``with torch.no_grad():``) and the tests that must be
            true around it (``if tracking:``), the innermost last.
        steps: how many it took: nodes that were visited, and copied definitions, four a step.
    """

    def __init__(
        self, body: cst.BaseSuite | cst.Module, parameters: Optional[cst.Parameters] = None, most: float = math.inf
    ) -> None:
        self.steps: int = 0
        self._most = most
        self.definitions: Dict[str, List[Definition]] = {}
        self.contexts: Dict[int, Tuple[cst.CSTNode, ...]] = {}
        self._reaching: Dict[int, Reaching] = {}
        self._visited: Dict[int, cst.CSTNode] = {}
        self._made: Dict[Tuple[int, str, str], Definition] = {}
        self._holders: Set[str] = set()  # places of which a part is defined: ``x`` and ``x.y`` of ``x.y['z']``
        self._around: Tuple[cst.CSTNode, ...] = ()
        self._loop_ends: Dict[int, Env] = {}  # by a loop's id: what its end hands back to its start
        self._exits: List[List[Env]] = []  # of the loops around: where a break or a continue leaves the body
        env = Env()
        self._bind_parameters(env, parameters or cst.Parameters())
        self._visit(body, env)
        by_class: Dict[type, List[Any]] = {}  # isinstance on every node takes longer than the walk
        for node in self._visited.values():
            by_class.setdefault(type(node), []).append(node)
        self.calls: List[cst.Call] = by_class.get(cst.Call, [])
        self.calls_of: Dict[str, List[cst.Call]] = {}
        for call in self.calls:
            self.calls_of.setdefault(call_name(call), []).append(call)
        self.expressions: List[cst.CSTNode] = [*self.calls, *by_class.get(cst.BinaryOperation, ())]
        self.reads: List[cst.Name] = by_class.get(cst.Name, [])
        self.imports: List[cst.CSTNode] = [*by_class.get(cst.Import, ()), *by_class.get(cst.ImportFrom, ())]
        values = [node.value for node in [*by_class.get(cst.Return, ()), *by_class.get(cst.Yield, ())]]
        self.returns: List[cst.BaseExpression] = [v for v in values if isinstance(v, cst.BaseExpression)]

    # -- what it knows

    @property
    def every_definition(self) -> List[Definition]:
        """All definitions, place by place."""
        return [definition for definitions in self.definitions.values() for definition in definitions]

    def reaching(self, node: cst.CSTNode) -> Reaching:
        """Return the definitions that this use of a place can come from; empty for what is not local."""
        return self._reaching.get(id(node), _NOTHING)

    @remembered
    def everywhere(self, place: str) -> Reaching:
        """Return all definitions of a place, joined."""
        return Reaching(self.definitions.get(place, ()))

    def assigned(self, node: cst.CSTNode) -> List[cst.CSTNode]:
        """Return the values of the assignments that reach this use."""
        return [d.value for d in self.reaching(node) if d.kind == "assign" and d.value is not None]

    def reads_in(self, node: cst.CSTNode) -> List[cst.Name]:
        """Return the names that are read in an expression, keywords and attributes aside."""
        return [part for part in walk_expressions(node) if isinstance(part, cst.Name) and id(part) in self._visited]

    def value_of(self, node: cst.CSTNode) -> Optional[cst.CSTNode]:
        """Return the value of a name, where exactly one assignment reaches it; else None."""
        found = self.reaching(node) if isinstance(node, cst.Name) else None
        return found.value if isinstance(found, Definition) and found.kind == "assign" else None

    def unchanged(self, *nodes: cst.CSTNode) -> bool:
        """Return whether the names in expressions are not reassigned anywhere in the body."""
        found = [(read, self.reaching(read)) for node in nodes for read in self.reads_in(node)]
        made = [({d for d in self.definitions[read.value] if d.kind != "store"}, some) for read, some in found if some]
        return all(every.issubset(some) for every, some in made)

    def loops_around(self, node: cst.CSTNode) -> List[cst.CSTNode]:
        """Return the loops around a node of the body, the innermost first."""
        return [each for each in reversed(self.contexts.get(id(node), ())) if isinstance(each, (cst.For, cst.While))]

    # -- definitions

    def _bind(self, env: Env, definition: Definition) -> None:
        definition = self._first(definition)
        place = definition.place
        if place in self._holders:  # a top level may bind thousands of names, and few of them have parts
            for other in [other for other in env if other.startswith((place + ".", place + "["))]:
                del env[other]
        env[place] = definition

    def _bind_parameters(self, env: Env, parameters: cst.Parameters) -> None:
        for parameter in every_parameter(parameters):
            self._bind(env, Definition(parameter.name.value, "parameter", parameter, parameter.default))

    def _add(self, env: Env, definition: Definition) -> None:
        definition = self._first(definition)
        env[definition.place] = definition.join(env.get(definition.place))

    def _first(self, made: Definition) -> Definition:
        """Return the definition that a statement was recorded as when it was met first; a loop is walked twice."""
        known = self._made.setdefault((id(made.node), made.place, made.kind), made)
        if known is made:
            made.order = len(self._made)
            self.definitions.setdefault(made.place, []).append(made)
            self._holders.update(made.place[: found.start()] for found in _PART.finditer(made.place))
        return known

    def _assign(
        self,
        env: Env,
        target: cst.CSTNode,
        value: Optional[cst.CSTNode],
        node: cst.CSTNode,
        kind: str = "assign",
        index: Optional[int] = None,
    ) -> None:
        if isinstance(target, (cst.Tuple, cst.List)):
            is_starred = any(isinstance(element, cst.StarredElement) for element in target.elements)
            parts = value.elements if isinstance(value, (cst.Tuple, cst.List)) and kind == "assign" else ()
            # In [a, b], c = f() neither a nor b is the first result of f: they are parts of it.
            # What they iterate over together is no element that is unpacked: for i, (a, b) in enumerate(pairs).
            counts = isinstance(value, cst.Call) and call_name(value) in ("enumerate", "zip")
            inner = "part" if kind == "element" and index is not None and not counts else "element"
            for i, element in enumerate(target.elements):
                if not is_starred and len(parts) == len(target.elements):
                    self._assign(env, element.value, parts[i].value, node)
                else:
                    self._assign(env, element.value, value, node, inner, None if is_starred else i)
            return
        place = path_of(target)
        if place is not None:
            self._bind(env, Definition(place, kind, target if kind in ("element", "part") else node, value, index))
        if isinstance(target, (cst.Attribute, cst.Subscript)):
            for child in children(target) if isinstance(target, cst.Subscript) else [target.value]:
                self._visit(child, env)
            self._store(env, target, value)

    def _store(
        self, env: Env, target: cst.CSTNode, value: Optional[cst.CSTNode], node: Optional[cst.CSTNode] = None
    ) -> None:
        """Record ``x["key"] = v`` and ``x.y = v`` as definitions of ``x``, too."""
        part, whole = target, None
        while whole is None and isinstance(target, (cst.Attribute, cst.Subscript)):
            part, target = target, target.value
            whole = path_of(target)
        if whole is not None:
            key = "." + part.attr.value if isinstance(part, cst.Attribute) else key_of(part)
            self._add(env, Definition(whole, "store", node or part, value, None, key))

    # -- the walk

    def _visit(self, node: cst.CSTNode, env: Env) -> None:
        """Record the definitions that reach a node and its parts, in the order of execution."""
        self.steps += 1
        if self.steps > self._most:
            return
        self._visited.setdefault(id(node), node)
        if self._around:
            self.contexts[id(node)] = self._around
        getattr(self, "_visit_" + type(node).__name__, self._parts)(node, env)

    def _parts(self, node: cst.CSTNode, env: Env) -> None:
        for child in children(node):
            self._visit(child, env)

    def _copy(self, env: Env) -> Env:
        self.steps += len(env) >> 2
        copied = Env(env)
        copied.alive = env.alive
        return copied

    def _inside(self, env: Env, body: cst.CSTNode, *around: cst.CSTNode) -> None:
        """Visit the body of a loop, a ``with`` or a branch."""
        outside = self._around
        self._around = (*outside, *around)
        self._visit(body, env)
        self._around = outside

    def _visit_If(self, node: cst.If, env: Env) -> None:
        self._visit(node.test, env)
        branch = self._copy(env)
        self._inside(branch, node.body, node.test)
        if node.orelse is not None:
            self._inside(env, node.orelse, cst.UnaryOperation(cst.Not(), node.test))
        env.join(branch, env)

    def _visit_For(self, node: cst.For | cst.While, env: Env) -> None:
        if isinstance(node, cst.For):
            self._visit(node.iter, env)
        before, around = self._copy(env), self._copy(env)
        self._exits.append([])
        for _ in range(2 if len(self._exits) == 1 else 1):
            around.join(before, *([self._loop_ends[id(node)]] if id(node) in self._loop_ends else []))
            if isinstance(node, cst.For):
                self._assign(around, node.target, node.iter, node, "element")
            else:
                self._visit(node.test, around)
            self._inside(around, node.body, node)
            self._loop_ends[id(node)] = end = Env()
            end.join(around, *self._exits[-1])
        exits = self._exits.pop()
        env.join(before, end)
        if node.orelse is not None:
            self._visit(node.orelse, env)
        env.join(env, *exits)

    _visit_While = _visit_For

    def _visit_With(self, node: cst.With, env: Env) -> None:
        for item in node.items:
            self._visit(item.item, env)
            if item.asname is not None:
                self._assign(env, item.asname.name, item.item, item, "with")
        self._inside(env, node.body, *(item.item for item in node.items))

    def _visit_Try(self, node: cst.Try, env: Env) -> None:
        before = self._copy(env)
        self._visit(node.body, env)
        handlers = [self._copy(before) for _ in node.handlers]
        for handler, branch in zip(node.handlers, handlers):
            branch.join(before, env)
            self._visit(handler.body, branch)
        if node.orelse is not None:
            self._visit(node.orelse, env)
        env.join(env, *handlers)
        if node.finalbody is not None:
            self._visit(node.finalbody, env)

    _visit_TryStar = _visit_Try

    def _visit_Match(self, node: cst.Match, env: Env) -> None:
        self._visit(node.subject, env)
        cases = [self._copy(env) for _ in node.cases]
        for case, branch in zip(node.cases, cases):
            self._visit(case.body, branch)
        env.join(env, *cases)

    def _visit_FunctionDef(self, node: cst.FunctionDef, env: Env) -> None:
        for decorator in node.decorators:
            self._visit(decorator.decorator, env)
        self._bind(env, Definition(node.name.value, "function", node))

    def _visit_ClassDef(self, node: cst.ClassDef, env: Env) -> None:
        self._bind(env, Definition(node.name.value, "class", node))

    def _visit_Import(self, node: cst.Import | cst.ImportFrom, env: Env) -> None:
        for alias in () if isinstance(node.names, cst.ImportStar) else node.names:
            name = alias.asname.name if alias.asname is not None else alias.name
            self._bind(env, Definition((dotted(name) or "").split(".")[0], "import", alias, node))

    _visit_ImportFrom = _visit_Import

    def _visit_Return(self, node: cst.CSTNode, env: Env) -> None:
        self._parts(node, env)
        env.alive = False

    def _visit_Break(self, node: cst.CSTNode, env: Env) -> None:
        if self._exits:
            self._exits[-1].append(self._copy(env))
        env.alive = False

    _visit_Raise = _visit_Return
    _visit_Continue = _visit_Break

    def _visit_Assign(self, node: cst.Assign, env: Env) -> None:
        self._visit(node.value, env)
        for target in node.targets:
            self._assign(env, target.target, node.value, node)

    def _visit_AnnAssign(self, node: cst.AnnAssign | cst.NamedExpr, env: Env) -> None:
        if node.value is not None:
            self._visit(node.value, env)
            self._assign(env, node.target, node.value, node)

    _visit_NamedExpr = _visit_AnnAssign

    def _visit_AugAssign(self, node: cst.AugAssign, env: Env) -> None:
        self._visit(node.target, env)
        self._visit(node.value, env)
        place = path_of(node.target)
        if place is not None:
            self._bind(env, Definition(place, "augment", node, node.value))
        self._store(env, node.target, node.value, node)

    def _visit_Expr(self, node: cst.Expr, env: Env) -> None:
        self._visit(node.value, env)
        called = node.value.func if isinstance(node.value, cst.Call) else None
        whole = path_of(called.value) if isinstance(called, cst.Attribute) else None
        if isinstance(called, cst.Attribute) and whole is not None:
            name = called.attr.value
            is_inplace = name.endswith("_") and not name.endswith("__")
            if name in MUTATORS or is_inplace:
                self._add(env, Definition(whole, "inplace" if is_inplace else "mutate", node.value, node.value))

    def _visit_Del(self, node: cst.Del, env: Env) -> None:
        pass  # no read of a name

    def _visit_Arg(self, node: cst.Arg, env: Env) -> None:
        self._visit(node.value, env)  # the keyword is not a read of a name

    def _visit_Name(self, node: cst.CSTNode, env: Env) -> None:
        place = path_of(node)
        if place is not None and place in env:
            self._reaching[id(node)] = env[place].join(self._reaching.get(id(node)))

    def _visit_Attribute(self, node: cst.Attribute, env: Env) -> None:
        self._visit_Name(node, env)
        self._visit(node.value, env)

    def _visit_Subscript(self, node: cst.Subscript, env: Env) -> None:
        self._visit_Name(node, env)
        self._parts(node, env)

    def _visit_Lambda(self, node: cst.Lambda, env: Env) -> None:
        inner = self._copy(env)
        self._bind_parameters(inner, node.params)
        self._visit(node.body, inner)

    def _visit_ListComp(self, node: cst.BaseSimpleComp | cst.DictComp, env: Env) -> None:
        inner = self._copy(env)
        for part in (node.for_in, *((node.key, node.value) if isinstance(node, cst.DictComp) else (node.elt,))):
            self._visit(part, inner)

    _visit_GeneratorExp = _visit_SetComp = _visit_DictComp = _visit_ListComp

    def _visit_CompFor(self, node: cst.CompFor, env: Env) -> None:
        self._visit(node.iter, env)
        self._assign(env, node.target, node.iter, node, "element")
        for part in (*node.ifs, *filter(None, [node.inner_for_in])):
            self._visit(part, env)
