"""Evaluate a function: bind its arguments, then execute its statements."""

from __future__ import annotations

from typing import Any, Dict, NamedTuple, Optional, Sequence

import libcst as cst

from legs_adapters.code.interpreter.expressions import OPERATORS, Env, Expressions
from legs_adapters.code.interpreter.library import Library, Raised
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import one_line

__all__ = ["Interpreter"]

_DEPTH = 8
_SAME_VALUE = {"staticmethod", "script", "compile", "jaxtyped", "typechecked", "beartype"}  # decorators


class _Returned(NamedTuple):
    value: Any


class Interpreter(Expressions):
    """Evaluate functions of one program: for one evaluation, since its steps are counted.

    Args:
        program: the program.
        library: the replacement of its imports.
    """

    def __init__(self, program: Program, library: Library) -> None:
        super().__init__(program, library)
        self._depth = 0

    def call(self, function: Function, given: Sequence[Any], keywords: Dict[str, Any]) -> Any:
        """Return what a function returns for these arguments.

        Raises:
            Unknown: it cannot be evaluated; methods cannot, since the state of objects is not tracked.
            Raised: it raises an error.
        """
        node = function.node
        method = function.owner is not None and not function.static
        if not isinstance(node, cst.FunctionDef) or node.asynchronous is not None or method:
            self.unknown(function, node)
        if self._depth >= _DEPTH or set(function.decorators) - _SAME_VALUE:
            self.unknown(function, node)
        self._depth += 1
        done = self._block(function, function.body, self._bound(function, node, given, keywords))
        self._depth -= 1
        return done.value if done is not None else None

    def _bound(self, function: Function, node: cst.FunctionDef, given: Sequence[Any], keywords: Dict[str, Any]) -> Env:
        params = node.params
        plain = [*params.posonly_params, *params.params]
        if isinstance(params.star_arg, cst.Param) or params.star_kwarg is not None:
            self.unknown(function, node)
        names = [param.name.value for param in (*plain, *params.kwonly_params)]
        if len(given) > len(plain) or set(keywords) - set(names[len(given) :]):
            raise Raised(function.name)
        env = dict(zip(names, given), **keywords)
        for param in (*plain, *params.kwonly_params):
            if param.name.value not in env:
                if param.default is None:
                    raise Raised(function.name)
                env[param.name.value] = self.value(function.parent or function, param.default, {})
        return env

    def _block(self, function: Function, body: Any, env: Env) -> Optional[_Returned]:
        for statement in body.body:
            for part in statement.body if isinstance(statement, cst.SimpleStatementLine) else [statement]:
                done = self._statement(function, part, env)
                if done is not None:
                    return done
        return None

    def _statement(self, function: Function, node: cst.CSTNode, env: Env) -> Optional[_Returned]:
        """Execute one statement; return the function's result, None where it continues."""
        if isinstance(node, cst.Return):
            return _Returned(None if node.value is None else self.value(function, node.value, env))
        if isinstance(node, cst.If):
            return self._branch(function, node, env)
        if isinstance(node, cst.For) and node.orelse is None:
            for value in self.elements(function, node.iter, env):
                self.assign(function, node.target, value, env)
                done = self._block(function, node.body, env)
                if done is not None:
                    return done
        elif isinstance(node, cst.Assign):
            value = self.value(function, node.value, env)
            for target in node.targets:
                self.assign(function, target.target, value, env)
        elif isinstance(node, cst.AnnAssign) and node.value is not None:
            self.assign(function, node.target, self.value(function, node.value, env), env)
        elif isinstance(node, cst.AugAssign):
            self._augment(function, node, env)
        elif isinstance(node, (cst.Assert, cst.Raise)):
            if isinstance(node, cst.Raise) or not self.truth(function, node.test, env):
                raise Raised(one_line(node))
        elif isinstance(node, cst.Expr):
            if not isinstance(node.value, (cst.SimpleString, cst.ConcatenatedString)):  # a docstring
                self.value(function, node.value, env)
        elif not isinstance(node, (cst.Pass, cst.Import, cst.ImportFrom)):
            self.unknown(function, node)
        return None

    def _branch(self, function: Function, node: cst.If, env: Env) -> Optional[_Returned]:
        if self.truth(function, node.test, env):
            return self._block(function, node.body, env)
        if isinstance(node.orelse, cst.If):
            return self._branch(function, node.orelse, env)
        return self._block(function, node.orelse.body, env) if node.orelse is not None else None

    def _augment(self, function: Function, node: cst.AugAssign, env: Env) -> None:
        if not isinstance(node.target, cst.Name) or type(node.operator) not in OPERATORS:
            self.unknown(function, node)
        before, by = self.value(function, node.target, env), self.value(function, node.value, env)
        if not isinstance(before, (int, float)):  # a tensor would be changed in place
            self.unknown(function, node)
        env[node.target.value] = self.operate(function, node, OPERATORS[type(node.operator)], before, by)
