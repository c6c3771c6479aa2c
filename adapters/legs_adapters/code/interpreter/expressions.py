"""Evaluate the expressions of a function, given the values of its names."""

from __future__ import annotations

import operator
from typing import Any, Callable, Dict, List, NoReturn, Sequence

import libcst as cst

from legs_adapters.code.interpreter.library import Library, Raised, Unknown, Unsupported
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import constant, dotted

__all__ = ["OPERATORS", "Env", "Expressions"]

Env = Dict[str, Any]

_STEPS = 20_000
_MOST = 4096  # elements of a range, and bits of a number
OPERATORS: Dict[type, Callable[[Any, Any], Any]] = {
    cst.Add: operator.add,
    cst.Subtract: operator.sub,
    cst.Multiply: operator.mul,
    cst.Divide: operator.truediv,
    cst.FloorDivide: operator.floordiv,
    cst.Modulo: operator.mod,
    cst.Power: operator.pow,
    cst.MatrixMultiply: operator.matmul,
    cst.AddAssign: operator.add,
    cst.SubtractAssign: operator.sub,
    cst.MultiplyAssign: operator.mul,
    cst.DivideAssign: operator.truediv,
}
_COMPARISONS: Dict[type, Callable[[Any, Any], Any]] = {
    cst.Equal: operator.eq,
    cst.NotEqual: operator.ne,
    cst.LessThan: operator.lt,
    cst.LessThanEqual: operator.le,
    cst.GreaterThan: operator.gt,
    cst.GreaterThanEqual: operator.ge,
    cst.In: lambda left, right: left in right,
    cst.NotIn: lambda left, right: left not in right,
}
_MISSING = object()


class Expressions:
    """Evaluates the expressions of one program.

    Args:
        program: the program.
        library: the replacement of its imports.
    """

    def __init__(self, program: Program, library: Library) -> None:
        self.program = program
        self.library = library
        self._steps = 0

    def call(self, function: Function, given: Sequence[Any], keywords: Dict[str, Any]) -> Any:
        """Return what a function of the program returns."""
        raise NotImplementedError

    def value(self, function: Function, node: cst.CSTNode, env: Env) -> Any:
        """Return the value of an expression of a function, in which names have the values of ``env``.

        Raises:
            Unknown: it cannot be evaluated.
            Raised: it raises an error.
        """
        self._steps += 1
        handler = getattr(self, "_of_" + type(node).__name__, None)
        if handler is None or self._steps > _STEPS:
            self.unknown(function, node)
        return handler(function, node, env)

    def truth(self, function: Function, node: cst.CSTNode, env: Env) -> bool:
        """Return whether an expression is true."""
        value = self.value(function, node, env)
        if not _is_plain(value):
            self.unknown(function, node)
        return bool(value)

    def elements(self, function: Function, node: cst.CSTNode, env: Env) -> Sequence[Any]:
        """Return the elements of a loop over an expression."""
        value = self.value(function, node, env)
        if not isinstance(value, (tuple, range)) or len(value) > _MOST:
            self.unknown(function, node)
        return value

    def assign(self, function: Function, target: cst.CSTNode, value: Any, env: Env) -> None:
        """Assign a value to a name, or its parts to several."""
        if isinstance(target, cst.Name):
            env[target.value] = value
            return
        if not isinstance(target, (cst.Tuple, cst.List)) or not isinstance(value, tuple):
            self.unknown(function, target)
        if any(isinstance(element, cst.StarredElement) for element in target.elements):
            self.unknown(function, target)
        if len(target.elements) != len(value):
            raise Raised("values to unpack")
        for element, part in zip(target.elements, value):
            self.assign(function, element.value, part, env)

    def operate(
        self, function: Function, node: cst.CSTNode, apply: Callable[[Any, Any], Any], left: Any, right: Any
    ) -> Any:
        """Return the result of an operator on two values."""
        if not all(isinstance(value, (int, float)) for value in (left, right)):
            return self._asked(function, node, self.library.operate, apply, left, right)
        if isinstance(left, int) and left.bit_length() * (abs(right) if apply is operator.pow else 1) > _MOST:
            self.unknown(function, node)  # unbounded growth would take all memory
        return self._asked(function, node, apply, left, right)

    def unknown(self, function: Function, node: cst.CSTNode) -> NoReturn:
        """End the evaluation at a node."""
        raise Unknown(function, node)

    def _asked(
        self, function: Function, node: cst.CSTNode, answer: Callable[..., Any], *given: Any, **named: Any
    ) -> Any:
        try:
            return answer(*given, **named)
        except (Unsupported, TypeError, ValueError, ArithmeticError, LookupError, AttributeError):
            return self.unknown(function, node)

    # -- names

    def _of_Name(self, function: Function, node: cst.Name, env: Env) -> Any:
        if node.value in env:
            return env[node.value]
        return constant(node) if node.value in ("None", "True", "False") else self._global(function, node)

    def _of_Attribute(self, function: Function, node: cst.Attribute, env: Env) -> Any:
        place = dotted(node)
        if place is not None and place.split(".")[0] not in env:
            return self._global(function, node)
        return self._asked(
            function, node, self.library.attribute, self.value(function, node.value, env), node.attr.value
        )

    def _global(self, function: Function, node: cst.Name | cst.Attribute) -> Any:
        """Return the value of a global name: a function, a library's name, a constant."""
        references = self.program.resolve(function, node)
        if len(references) == 1 and not references[0].guess:
            if references[0].kind == "function":
                return references[0].target
            if references[0].kind == "external":
                return self._asked(function, node, self.library.external, str(references[0].target))
        if references or not isinstance(node, cst.Name):
            self.unknown(function, node)
        found = self.program.lookup(function, node)
        if found is None:
            return self._asked(function, node, self.library.external, node.value)
        where, definition = found[0]
        changes = f"global {node.value}" in where.module.text
        if len(found) > 1 or where.parent is not None or definition.kind != "assign" or changes:
            self.unknown(function, node)
        assert definition.value is not None
        return self.value(where, definition.value, {})

    # -- values computed from values

    def _of_literal(self, function: Function, node: cst.CSTNode, env: Env) -> Any:
        value = constant(node, _MISSING)
        return self.unknown(function, node) if value is _MISSING else value

    _of_Integer = _of_Float = _of_SimpleString = _of_literal

    def _of_Ellipsis(self, function: Function, node: cst.Ellipsis, env: Env) -> Any:
        return Ellipsis

    def _of_Call(self, function: Function, node: cst.Call, env: Env) -> Any:
        called = self.value(function, node.func, env)
        given: List[Any] = []
        keywords: Dict[str, Any] = {}
        for arg in node.args:
            if arg.star:
                self.unknown(function, node)
            value = self.value(function, arg.value, env)
            if arg.keyword is None:
                given.append(value)
            else:
                keywords[arg.keyword.value] = value
        if isinstance(called, Function):
            return self.call(called, given, keywords)
        return self._asked(function, node, called, *given, **keywords)

    def _of_BinaryOperation(self, function: Function, node: cst.BinaryOperation, env: Env) -> Any:
        if type(node.operator) not in OPERATORS:
            self.unknown(function, node)
        left, right = self.value(function, node.left, env), self.value(function, node.right, env)
        return self.operate(function, node, OPERATORS[type(node.operator)], left, right)

    def _of_UnaryOperation(self, function: Function, node: cst.UnaryOperation, env: Env) -> Any:
        if isinstance(node.operator, cst.Not):
            return not self.truth(function, node.expression, env)
        if not isinstance(node.operator, cst.Minus):
            self.unknown(function, node)
        return self.operate(function, node, operator.mul, -1, self.value(function, node.expression, env))

    def _of_Comparison(self, function: Function, node: cst.Comparison, env: Env) -> bool:
        left = self.value(function, node.left, env)
        for comparison in node.comparisons:
            right = self.value(function, comparison.comparator, env)
            kind = type(comparison.operator)
            if kind in (cst.Is, cst.IsNot) and (left is None or right is None):
                holds = (left is right) == (kind is cst.Is)
            elif kind in _COMPARISONS and _is_plain(left) and _is_plain(right):
                holds = bool(self._asked(function, node, _COMPARISONS[kind], left, right))
            else:
                self.unknown(function, node)
            if not holds:
                return False
            left = right
        return True

    def _of_BooleanOperation(self, function: Function, node: cst.BooleanOperation, env: Env) -> bool:
        left = self.truth(function, node.left, env)
        decides = not left if isinstance(node.operator, cst.And) else left
        return left if decides else self.truth(function, node.right, env)

    def _of_IfExp(self, function: Function, node: cst.IfExp, env: Env) -> Any:
        return self.value(function, node.body if self.truth(function, node.test, env) else node.orelse, env)

    def _of_sequence(self, function: Function, node: cst.Tuple | cst.List, env: Env) -> Any:
        if any(isinstance(element, cst.StarredElement) for element in node.elements):
            self.unknown(function, node)
        return tuple(self.value(function, element.value, env) for element in node.elements)

    _of_Tuple = _of_List = _of_sequence

    def _of_comprehension(self, function: Function, node: cst.ListComp | cst.GeneratorExp, env: Env) -> Any:
        loop = node.for_in
        if loop.inner_for_in is not None or loop.ifs:
            self.unknown(function, node)
        found: List[Any] = []
        for value in self.elements(function, loop.iter, env):
            inner = dict(env)
            self.assign(function, loop.target, value, inner)
            found.append(self.value(function, node.elt, inner))
        return tuple(found)

    _of_ListComp = _of_GeneratorExp = _of_comprehension

    def _of_Subscript(self, function: Function, node: cst.Subscript, env: Env) -> Any:
        value = self.value(function, node.value, env)
        keys = tuple(self._key(function, element.slice, env) for element in node.slice)
        return self._asked(function, node, self.library.index, value, keys[0] if len(keys) == 1 else keys)

    def _key(self, function: Function, node: cst.CSTNode, env: Env) -> Any:
        if isinstance(node, cst.Slice) and node.lower is None and node.upper is None and node.step is None:
            return slice(None)
        return self.value(function, node.value, env) if isinstance(node, cst.Index) else self.unknown(function, node)


def _is_plain(value: Any) -> bool:
    """Return whether a value is of a built-in type, which can be compared."""
    if isinstance(value, tuple):
        return all(map(_is_plain, value))
    return isinstance(value, (int, float, str, type(None)))
