"""Walk one function body in the order of execution, and record what reaches each use.

Branches are joined. A loop is walked twice, and once more for each further walk of a loop around it.
"""

from __future__ import annotations

import math
from typing import Callable, Dict, List, Optional, Sequence, Set, Tuple

import libcst as cst

from legs_adapters.code.reaching import Definition, Env, Reaching, join
from legs_adapters.code.syntax import (
    call_name,
    children,
    constant,
    dotted,
    every_parameter,
    names_where_false,
    names_where_true,
    path_of,
)

__all__ = ["Flow"]

_MUTATORS = {"append", "add", "extend", "insert", "update", "setdefault", "appendleft", "__setitem__"}


class Flow(Reaching):
    """Walk one function body, or a module's top level.

    Args:
        body: its statements.
        parameters: the function's parameters; None for a module.
        most: the steps after which the walk ends.

    Attributes:
        calls: every call in the body, in source order, nested functions excepted.
        expressions: every call and binary operation, in source order.
        returns: the expressions that it returns or yields.
        contexts: by a node's id, the context managers around it: ``with torch.no_grad():``.
        reads: every name that is read, in source order.
        conditions: by a call's id, the names that must be true where it runs: ``if tracking:``.
        steps: how many it took: nodes that were visited, and definitions that were copied, four a step.
    """

    def __init__(
        self,
        body: cst.BaseSuite | cst.Module,
        parameters: Optional[cst.Parameters] = None,
        most: float = math.inf,
    ) -> None:
        super().__init__()
        self.steps: int = 0
        self._most = most
        self.calls: List[cst.Call] = []
        self.expressions: List[cst.CSTNode] = []
        self.returns: List[cst.BaseExpression] = []
        self.imports: List[cst.CSTNode] = []
        self.contexts: Dict[int, Tuple[cst.CSTNode, ...]] = {}
        self._seen: Set[int] = set()
        self.conditions: Dict[int, Tuple[str, ...]] = {}
        self.reads: List[cst.Name] = []
        self._around: Tuple[cst.CSTNode, ...] = ()
        self._conditions: Tuple[str, ...] = ()
        self._carried: Dict[int, Optional[Env]] = {}  # by a loop's id: what its end hands back to its start
        self._breaks: List[List[Env]] = []
        self._continues: List[List[Env]] = []
        env: Env = {}
        if parameters is not None:
            for param in every_parameter(parameters):
                self._bind(env, Definition(param.name.value, "parameter", param, param.default))
        self._block(_statements(body), env)

    # -- definitions

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
            elements = target.elements
            parts = value.elements if isinstance(value, (cst.Tuple, cst.List)) and kind == "assign" else None
            plain = not any(isinstance(element, cst.StarredElement) for element in elements)
            # In [a, b], c = f() neither a nor b is the first result of f: they are parts of it.
            inner = "part" if kind == "element" and index is not None and not _counts(value) else "element"
            for i, element in enumerate(elements):
                if parts is not None and plain and len(parts) == len(elements):
                    self._assign(env, element.value, parts[i].value, node)
                else:
                    self._assign(env, element.value, value, node, inner, i if plain else None)
            return
        if isinstance(target, cst.StarredElement):
            self._assign(env, target.value, value, node, "element")
            return
        place = path_of(target)
        if place is not None:
            unpacked = kind in ("element", "part")
            self._bind(env, Definition(place, kind, target if unpacked else node, value, index))
        if isinstance(target, (cst.Attribute, cst.Subscript)):
            self._visit(target.value, env)
            if isinstance(target, cst.Subscript):
                for part in target.slice:
                    self._visit(part, env)
            whole = path_of(target.value)
            while whole is None and isinstance(target.value, (cst.Attribute, cst.Subscript)):
                target = target.value
                whole = path_of(target.value)
            if whole is not None:
                key: object = None
                if isinstance(target, cst.Attribute):
                    key = "." + target.attr.value
                elif len(target.slice) == 1 and isinstance(target.slice[0].slice, cst.Index):
                    key = constant(target.slice[0].slice.value)
                self._add(env, Definition(whole, "store", target, value, None, key))

    # -- statements

    def _block(self, statements: Sequence[cst.CSTNode], env: Optional[Env]) -> Optional[Env]:
        for statement in statements:
            if self.steps > self._most:
                return None
            if env is None:
                # Unreachable (after a return or a continue), but its names are recorded.
                self._statement(statement, {})
                continue
            env = self._statement(statement, env)
        return env

    def _statement(self, node: cst.CSTNode, env: Env) -> Optional[Env]:
        if isinstance(node, cst.SimpleStatementLine):
            return self._block(node.body, env)
        if isinstance(node, cst.If):
            self._visit(node.test, env)
            outer = self._conditions
            self._conditions = outer + names_where_true(node.test)
            taken = self._block(_statements(node.body), self._copy(env))
            self._conditions = outer + names_where_false(node.test)
            left: Optional[Env] = env
            if isinstance(node.orelse, cst.If):
                left = self._statement(node.orelse, self._copy(env))
            elif node.orelse is not None:
                left = self._block(_statements(node.orelse.body), self._copy(env))
            self._conditions = outer
            return join([taken, left])
        if isinstance(node, (cst.For, cst.While)):
            return self._loop(node, env)
        if isinstance(node, cst.With):
            for item in node.items:
                self._visit(item.item, env)
                if item.asname is not None:
                    self._assign(env, item.asname.name, item.item, item, "with")
            outside = self._around
            self._around = (*outside, *(item.item for item in node.items))
            after = self._block(_statements(node.body), env)
            self._around = outside
            return after
        if isinstance(node, (cst.Try, cst.TryStar)):
            before = self._copy(env)
            body = self._block(_statements(node.body), env)
            ends = []
            for handler in node.handlers:
                entry = join([before, body]) or self._copy(before)
                if handler.name is not None:
                    self._assign(entry, handler.name.name, handler.type, handler, "with")
                ends.append(self._block(_statements(handler.body), self._copy(entry)))
            if node.orelse is not None:
                body = self._block(_statements(node.orelse.body), body)
            after = join([body, *ends])
            if node.finalbody is not None:
                reached = after is not None
                after = self._block(_statements(node.finalbody.body), after if after is not None else dict(before))
                return after if reached else None
            return after
        if isinstance(node, cst.FunctionDef):
            for decorator in node.decorators:
                self._visit(decorator.decorator, env)
            if self._around:
                self.contexts[id(node)] = self._around
            self._bind(env, Definition(node.name.value, "function", node))
            return env
        if isinstance(node, cst.ClassDef):
            self._bind(env, Definition(node.name.value, "class", node))
            return env
        if type(node).__name__ == "Match":
            self._visit(node.subject, env)  # type: ignore[attr-defined]
            ends = [env]
            for case in node.cases:  # type: ignore[attr-defined]
                ends.append(self._block(_statements(case.body), self._copy(env)))
            return join(ends)
        return self._small(node, env)

    def _small(self, node: cst.CSTNode, env: Env) -> Optional[Env]:
        if isinstance(node, cst.Assign):
            self._visit(node.value, env)
            for target in node.targets:
                self._assign(env, target.target, node.value, node)
        elif isinstance(node, cst.AnnAssign):
            if node.value is not None:
                self._visit(node.value, env)
                self._assign(env, node.target, node.value, node)
        elif isinstance(node, cst.AugAssign):
            self._visit(node.target, env)
            self._visit(node.value, env)
            place = path_of(node.target)
            if place is not None:
                self._bind(env, Definition(place, "augment", node, node.value))
            if isinstance(node.target, (cst.Attribute, cst.Subscript)):
                whole = path_of(node.target.value)
                if whole is not None:
                    self._add(env, Definition(whole, "store", node, node.value))
        elif isinstance(node, cst.Expr):
            self._visit(node.value, env)
            self._mutation(node.value, env)
        elif isinstance(node, cst.Return):
            if node.value is not None:
                self._visit(node.value, env)
                if self._is_first(node):
                    self.returns.append(node.value)
            return None
        elif isinstance(node, cst.Raise):
            return None
        elif isinstance(node, cst.Break):
            if self._breaks:
                self._breaks[-1].append(env)
            return None
        elif isinstance(node, cst.Continue):
            if self._continues:
                self._continues[-1].append(env)
            return None
        elif isinstance(node, (cst.Import, cst.ImportFrom)):
            self._import(node, env)
        elif isinstance(node, cst.Del):
            pass
        else:
            for child in children(node):
                self._visit(child, env)
        return env

    def _loop(self, node: cst.For | cst.While, env: Env) -> Optional[Env]:
        if isinstance(node, cst.For):
            self._visit(node.iter, env)
        breaks: List[Env] = []
        for _ in range(1 if id(node) in self._carried else 2):
            self._breaks.append([])
            self._continues.append([])
            around: Env = self._copy(join([env, self._carried.get(id(node))]) or {})
            if isinstance(node, cst.For):
                self._assign(around, node.target, node.iter, node, "element")
            else:
                self._visit(node.test, around)
            end = self._block(_statements(node.body), around)
            breaks = breaks + self._breaks.pop()
            self._carried[id(node)] = join([end, *self._continues.pop()])
        entry = join([env, self._carried[id(node)]])
        if node.orelse is not None:
            entry = self._block(_statements(node.orelse.body), entry)
        return join([entry, *breaks])

    def _copy(self, env: Env) -> Env:
        self.steps += len(env) >> 2
        return dict(env)

    def _mutation(self, node: cst.CSTNode, env: Env) -> None:
        if not isinstance(node, cst.Call) or not isinstance(node.func, cst.Attribute):
            return
        whole, name = path_of(node.func.value), node.func.attr.value
        if whole is None:
            return
        if name in _MUTATORS:
            self._add(env, Definition(whole, "mutate", node, node))
        elif name.endswith("_") and not name.endswith("__"):
            self._add(env, Definition(whole, "inplace", node, node))

    def _import(self, node: cst.Import | cst.ImportFrom, env: Env) -> None:
        if self._is_first(node):
            self.imports.append(node)
        if isinstance(node.names, cst.ImportStar):
            return
        for alias in node.names:
            if alias.asname is not None:
                name = path_of(alias.asname.name)
            else:
                name = (dotted(alias.name) or "").split(".")[0]
            if name:
                self._bind(env, Definition(name, "import", alias, node))

    # -- expressions

    def _visit(self, node: cst.CSTNode, env: Env) -> None:
        """Record the definitions that reach an expression and its parts, in the order of evaluation."""
        self.steps += 1
        if self._around:
            self.contexts[id(node)] = self._around
        visit = self._VISITS.get(type(node))  # by class: isinstance on every node takes half of the walk's time
        if visit is not None:
            visit(self, node, env)
        else:
            self._parts(node, env)

    def _parts(self, node: cst.CSTNode, env: Env) -> None:
        for child in children(node):
            self._visit(child, env)

    def _is_first(self, node: cst.CSTNode) -> bool:
        """Return whether a node is visited for the first time: the body of a loop is walked twice."""
        first = id(node) not in self._seen
        self._seen.add(id(node))
        return first

    def _reach(self, node: cst.CSTNode, env: Env) -> None:
        place = path_of(node)
        if place is not None and place in env:
            self._reaching.setdefault(id(node), set()).update(env[place])

    def _call(self, node: cst.Call, env: Env) -> None:
        self.conditions[id(node)] = self._conditions
        if self._snapshot is None or self._snapshot[0] is not env:
            self._snapshot = env, self._copy(env)
        self._names.setdefault(id(node), []).append(self._snapshot[1])
        if self._is_first(node):
            self.expressions.append(node)
            self.calls.append(node)
        self._parts(node, env)

    def _argument(self, node: cst.Arg, env: Env) -> None:
        self._visit(node.value, env)  # the keyword is not a read of a name

    def _operation(self, node: cst.BinaryOperation, env: Env) -> None:
        if self._is_first(node):
            self.expressions.append(node)
        self._parts(node, env)

    def _name(self, node: cst.Name, env: Env) -> None:
        if self._is_first(node):
            self.reads.append(node)
        self._reach(node, env)

    def _attribute(self, node: cst.Attribute, env: Env) -> None:
        self._reach(node, env)
        self._visit(node.value, env)

    def _subscript(self, node: cst.Subscript, env: Env) -> None:
        self._reach(node, env)
        self._parts(node, env)

    def _named(self, node: cst.NamedExpr, env: Env) -> None:
        self._visit(node.value, env)
        self._assign(env, node.target, node.value, node)

    def _yield(self, node: cst.Yield, env: Env) -> None:
        if self._is_first(node) and isinstance(node.value, cst.BaseExpression):
            self.returns.append(node.value)
        self._parts(node, env)

    def _lambda(self, node: cst.Lambda, env: Env) -> None:
        inner = self._copy(env)
        for param in every_parameter(node.params):
            self._bind(inner, Definition(param.name.value, "parameter", param, param.default))
        self._visit(node.body, inner)

    def _comprehension(self, node: cst.BaseSimpleComp | cst.DictComp, env: Env) -> None:
        inner = self._copy(env)
        loop: Optional[cst.CompFor] = node.for_in
        while loop is not None:
            self._visit(loop.iter, inner)
            self._assign(inner, loop.target, loop.iter, loop, "element")
            for condition in loop.ifs:
                self._visit(condition.test, inner)
            loop = loop.inner_for_in
        for part in (node.key, node.value) if isinstance(node, cst.DictComp) else (node.elt,):
            self._visit(part, inner)

    _VISITS: Dict[type, Callable[..., None]] = {
        cst.Call: _call,
        cst.Arg: _argument,
        cst.BinaryOperation: _operation,
        cst.Name: _name,
        cst.Attribute: _attribute,
        cst.Subscript: _subscript,
        cst.NamedExpr: _named,
        cst.Yield: _yield,
        cst.Lambda: _lambda,
        **dict.fromkeys((cst.GeneratorExp, cst.ListComp, cst.SetComp, cst.DictComp), _comprehension),
    }


def _statements(body: cst.BaseSuite | cst.Module) -> Sequence[cst.CSTNode]:
    return body.body


def _counts(value: Optional[cst.CSTNode]) -> bool:
    """Return whether a loop iterates over several things together: ``enumerate(...)``, ``zip(...)``."""
    return isinstance(value, cst.Call) and call_name(value) in ("enumerate", "zip")
