"""Reaching definitions: for every place that a function reads, the assignments that its value can come from.

A body is walked in the order of execution. Branches are joined; the body of an outermost loop is walked twice.
"""

from __future__ import annotations

import ast
import math
import re
from typing import Any, Dict, List, Optional, Sequence, Set, Tuple

from legs_adapters.code.limits import remembered
from legs_adapters.code.reaching import Definition, Env, Reaching
from legs_adapters.code.syntax import (
    LOOPS,
    call_name,
    children,
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
        self, body: Sequence[ast.stmt], parameters: Optional[ast.arguments] = None, most: float = math.inf
    ) -> None:
        self.steps: int = 0
        self._most = most
        self.definitions: Dict[str, List[Definition]] = {}
        self.contexts: Dict[int, Tuple[ast.AST, ...]] = {}
        self._reaching: Dict[int, Reaching] = {}
        self._visited: Dict[int, ast.AST] = {}
        self._made: Dict[Tuple[int, str, str], Definition] = {}
        self._holders: Set[str] = set()  # places of which a part is defined: ``x`` and ``x.y`` of ``x.y['z']``
        self._around: Tuple[ast.AST, ...] = ()
        self._loop_ends: Dict[int, Env] = {}  # by a loop's id: what its end hands back to its start
        self._exits: List[List[Env]] = []  # of the loops around: where a break or a continue leaves the body
        env = Env()
        if parameters is not None:
            self._bind_parameters(env, parameters)
        self._body(body, env)
        by_class: Dict[type, List[Any]] = {}  # isinstance on every node takes longer than the walk
        for node in self._visited.values():
            by_class.setdefault(type(node), []).append(node)
        self.calls: List[ast.Call] = by_class.get(ast.Call, [])
        self.calls_of: Dict[str, List[ast.Call]] = {}
        for call in self.calls:
            self.calls_of.setdefault(call_name(call), []).append(call)
        self.expressions: List[ast.AST] = [*self.calls, *by_class.get(ast.BinOp, ())]
        self.reads: List[ast.Name] = by_class.get(ast.Name, [])
        self.imports: List[ast.AST] = [*by_class.get(ast.Import, ()), *by_class.get(ast.ImportFrom, ())]
        values = [node.value for node in [*by_class.get(ast.Return, ()), *by_class.get(ast.Yield, ())]]
        self.returns: List[ast.expr] = [value for value in values if value is not None]

    # -- what it knows

    @property
    def every_definition(self) -> List[Definition]:
        """All definitions, place by place."""
        return [definition for definitions in self.definitions.values() for definition in definitions]

    def reaching(self, node: ast.AST) -> Reaching:
        """Return the definitions that this use of a place can come from; empty for what is not local."""
        return self._reaching.get(id(node), _NOTHING)

    @remembered
    def everywhere(self, place: str) -> Reaching:
        """Return all definitions of a place, joined."""
        return Reaching(self.definitions.get(place, ()))

    def assigned(self, node: ast.AST) -> List[ast.AST]:
        """Return the values of the assignments that reach this use."""
        return [d.value for d in self.reaching(node) if d.kind == "assign" and d.value is not None]

    def reads_in(self, node: ast.AST) -> List[ast.Name]:
        """Return the names that are read in an expression, keywords and attributes aside."""
        return [part for part in walk_expressions(node) if isinstance(part, ast.Name) and id(part) in self._visited]

    def value_of(self, node: ast.AST) -> Optional[ast.AST]:
        """Return the value of a name, where exactly one assignment reaches it; else None."""
        found = self.reaching(node) if isinstance(node, ast.Name) else None
        return found.value if isinstance(found, Definition) and found.kind == "assign" else None

    def unchanged(self, *nodes: ast.AST) -> bool:
        """Return whether the names in expressions are not reassigned anywhere in the body."""
        found = [(read, self.reaching(read)) for node in nodes for read in self.reads_in(node)]
        made = [({d for d in self.definitions[read.id] if d.kind != "store"}, some) for read, some in found if some]
        return all(every.issubset(some) for every, some in made)

    def loops_around(self, node: ast.AST) -> List[ast.AST]:
        """Return the loops around a node of the body, the innermost first."""
        return [each for each in reversed(self.contexts.get(id(node), ())) if isinstance(each, LOOPS)]

    # -- definitions

    def _bind(self, env: Env, definition: Definition) -> None:
        definition = self._first(definition)
        place = definition.place
        if place in self._holders:  # a top level may bind thousands of names, and few of them have parts
            for other in [other for other in env if other.startswith((place + ".", place + "["))]:
                del env[other]
        env[place] = definition

    def _bind_parameters(self, env: Env, parameters: ast.arguments) -> None:
        for parameter, default in every_parameter(parameters):
            self._bind(env, Definition(parameter.arg, "parameter", parameter, default))

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
        target: ast.AST,
        value: Optional[ast.AST],
        node: ast.AST,
        kind: str = "assign",
        index: Optional[int] = None,
    ) -> None:
        if isinstance(target, (ast.Tuple, ast.List)):
            is_starred = any(isinstance(element, ast.Starred) for element in target.elts)
            parts = value.elts if isinstance(value, (ast.Tuple, ast.List)) and kind == "assign" else ()
            # In [a, b], c = f() neither a nor b is the first result of f: they are parts of it.
            # What they iterate over together is no element that is unpacked: for i, (a, b) in enumerate(pairs).
            counts = isinstance(value, ast.Call) and call_name(value) in ("enumerate", "zip")
            inner = "part" if kind == "element" and index is not None and not counts else "element"
            for i, element in enumerate(target.elts):
                element = element.value if isinstance(element, ast.Starred) else element
                if not is_starred and len(parts) == len(target.elts):
                    self._assign(env, element, parts[i], node)
                else:
                    self._assign(env, element, value, node, inner, None if is_starred else i)
            return
        place = path_of(target)
        if place is not None:
            self._bind(env, Definition(place, kind, target if kind in ("element", "part") else node, value, index))
        if isinstance(target, (ast.Attribute, ast.Subscript)):
            for child in children(target):
                self._visit(child, env)
            self._store(env, target, value)

    def _store(self, env: Env, target: ast.AST, value: Optional[ast.AST], node: Optional[ast.AST] = None) -> None:
        """Record ``x["key"] = v`` and ``x.y = v`` as definitions of ``x``, too."""
        part, whole = target, None
        while whole is None and isinstance(target, (ast.Attribute, ast.Subscript)):
            part, target = target, target.value
            whole = path_of(target)
        if whole is not None:
            key = "." + part.attr if isinstance(part, ast.Attribute) else key_of(part)
            self._add(env, Definition(whole, "store", node or part, value, None, key))

    # -- the walk

    def _visit(self, node: ast.AST, env: Env) -> None:
        """Record the definitions that reach a node and its parts, in the order of execution."""
        self.steps += 1
        if self.steps > self._most:
            return
        self._visited.setdefault(id(node), node)
        if self._around:
            self.contexts[id(node)] = self._around
        getattr(self, "_visit_" + type(node).__name__, self._parts)(node, env)

    def _body(self, statements: Sequence[ast.stmt], env: Env) -> None:
        for statement in statements:
            self._visit(statement, env)

    def _parts(self, node: ast.AST, env: Env) -> None:
        for child in children(node):
            self._visit(child, env)

    def _copy(self, env: Env) -> Env:
        self.steps += len(env) >> 2
        copied = Env(env)
        copied.alive = env.alive
        return copied

    def _inside(self, env: Env, body: Sequence[ast.stmt], *around: ast.AST) -> None:
        """Visit the body of a loop, a ``with`` or a branch."""
        outside = self._around
        self._around = (*outside, *around)
        self._body(body, env)
        self._around = outside

    def _visit_If(self, node: ast.If, env: Env) -> None:
        self._visit(node.test, env)
        branch = self._copy(env)
        self._inside(branch, node.body, node.test)
        if node.orelse:
            self._inside(env, node.orelse, ast.UnaryOp(ast.Not(), node.test))
        env.join(branch, env)

    def _visit_For(self, node: ast.For | ast.While, env: Env) -> None:
        if not isinstance(node, ast.While):
            self._visit(node.iter, env)
        before, around = self._copy(env), self._copy(env)
        self._exits.append([])
        for _ in range(2 if len(self._exits) == 1 else 1):
            around.join(before, *([self._loop_ends[id(node)]] if id(node) in self._loop_ends else []))
            if isinstance(node, ast.While):
                self._visit(node.test, around)
            else:
                self._assign(around, node.target, node.iter, node, "element")
            self._inside(around, node.body, node)
            self._loop_ends[id(node)] = end = Env()
            end.join(around, *self._exits[-1])
        exits = self._exits.pop()
        env.join(before, end)
        self._body(node.orelse, env)
        env.join(env, *exits)

    _visit_AsyncFor = _visit_While = _visit_For

    def _visit_With(self, node: ast.With, env: Env) -> None:
        for item in node.items:
            self._visit(item.context_expr, env)
            if item.optional_vars is not None:
                self._assign(env, item.optional_vars, item.context_expr, item.context_expr, "with")
        self._inside(env, node.body, *(item.context_expr for item in node.items))

    _visit_AsyncWith = _visit_With

    def _visit_Try(self, node: ast.Try, env: Env) -> None:
        before = self._copy(env)
        self._body(node.body, env)
        handlers = [self._copy(before) for _ in node.handlers]
        for handler, branch in zip(node.handlers, handlers):
            branch.join(before, env)
            self._body(handler.body, branch)
        self._body(node.orelse, env)
        env.join(env, *handlers)
        self._body(node.finalbody, env)

    _visit_TryStar = _visit_Try

    def _visit_Match(self, node: Any, env: Env) -> None:
        self._visit(node.subject, env)
        cases = [self._copy(env) for _ in node.cases]
        for case, branch in zip(node.cases, cases):
            self._body(case.body, branch)
        env.join(env, *cases)

    def _visit_FunctionDef(self, node: ast.FunctionDef, env: Env) -> None:
        for decorator in node.decorator_list:
            self._visit(decorator, env)
        self._bind(env, Definition(node.name, "function", node))

    _visit_AsyncFunctionDef = _visit_FunctionDef

    def _visit_ClassDef(self, node: ast.ClassDef, env: Env) -> None:
        self._bind(env, Definition(node.name, "class", node))

    def _visit_Import(self, node: ast.Import | ast.ImportFrom, env: Env) -> None:
        for alias in node.names:
            if alias.name != "*":
                self._bind(env, Definition((alias.asname or alias.name).split(".")[0], "import", alias, node))

    _visit_ImportFrom = _visit_Import

    def _visit_Return(self, node: ast.AST, env: Env) -> None:
        self._parts(node, env)
        env.alive = False

    def _visit_Break(self, node: ast.AST, env: Env) -> None:
        if self._exits:
            self._exits[-1].append(self._copy(env))
        env.alive = False

    _visit_Raise = _visit_Return
    _visit_Continue = _visit_Break

    def _visit_Assign(self, node: ast.Assign, env: Env) -> None:
        self._visit(node.value, env)
        for target in node.targets:
            self._assign(env, target, node.value, node)

    def _visit_AnnAssign(self, node: Any, env: Env) -> None:
        if node.value is not None:
            self._visit(node.value, env)
            self._assign(env, node.target, node.value, node)

    _visit_NamedExpr = _visit_AnnAssign

    def _visit_AugAssign(self, node: ast.AugAssign, env: Env) -> None:
        self._visit(node.target, env)
        self._visit(node.value, env)
        place = path_of(node.target)
        if place is not None:
            self._bind(env, Definition(place, "augment", node, node.value))
        self._store(env, node.target, node.value, node)

    def _visit_Expr(self, node: ast.Expr, env: Env) -> None:
        self._visit(node.value, env)
        called = node.value.func if isinstance(node.value, ast.Call) else None
        whole = path_of(called.value) if isinstance(called, ast.Attribute) else None
        if isinstance(called, ast.Attribute) and whole is not None:
            is_inplace = called.attr.endswith("_") and not called.attr.endswith("__")
            if called.attr in MUTATORS or is_inplace:
                self._add(env, Definition(whole, "inplace" if is_inplace else "mutate", node.value, node.value))

    def _visit_Delete(self, node: ast.AST, env: Env) -> None:
        pass  # no read of a name

    def _visit_Name(self, node: ast.AST, env: Env) -> None:
        place = path_of(node)
        if place is not None and place in env:
            self._reaching[id(node)] = env[place].join(self._reaching.get(id(node)))

    def _visit_Attribute(self, node: ast.AST, env: Env) -> None:
        self._visit_Name(node, env)
        self._parts(node, env)

    _visit_Subscript = _visit_Attribute

    def _visit_Lambda(self, node: ast.Lambda, env: Env) -> None:
        inner = self._copy(env)
        self._bind_parameters(inner, node.args)
        self._visit(node.body, inner)

    def _visit_ListComp(self, node: Any, env: Env) -> None:
        inner = self._copy(env)
        for part in (*node.generators, *((node.key, node.value) if isinstance(node, ast.DictComp) else (node.elt,))):
            self._visit(part, inner)

    _visit_GeneratorExp = _visit_SetComp = _visit_DictComp = _visit_ListComp

    def _visit_comprehension(self, node: ast.comprehension, env: Env) -> None:
        self._visit(node.iter, env)
        self._assign(env, node.target, node.iter, node, "element")
        for part in node.ifs:
            self._visit(part, env)
