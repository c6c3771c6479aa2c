"""Helpers for LibCST trees: a node's name, the words in it, the value of a constant."""

from __future__ import annotations

import ast
import dataclasses
import functools
import re
from typing import Any, Dict, FrozenSet, Iterator, List, Optional, Set, Tuple

import libcst as cst

_CAMEL = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_EMPTY = cst.Module(body=[])
_WORDS = (cst.Name, cst.SimpleString, cst.Integer, cst.Float)
_LITERALS = (*_WORDS, cst.UnaryOperation, cst.Tuple, cst.List)
_MISSING = object()
_PUNCTUATION = re.compile(
    "whitespace|[lr]par|[lr]brac|l.*_lines|lines_|trailing_|header|footer|comma|equal|dot|.*colon"
)
_NO_NODES = (str, bool, type(None), cst.MaybeSentinel)  # isinstance on every node is slow
_SCOPES = (cst.FunctionDef, cst.ClassDef)


def code(node: cst.CSTNode) -> str:
    """Return a node's source text, exactly."""
    if isinstance(node, _WORDS) and not node.lpar:
        return node.value
    return _EMPTY.code_for_node(node)


def one_line(node: cst.CSTNode) -> str:
    """Return a node's source text on one line."""
    return " ".join(code(node).split())


def dotted(node: cst.CSTNode) -> Optional[str]:
    """Return ``a.b.c`` for a chain of names, else None."""
    path = path_of(node)
    return None if path is None or "[" in path else path


def word_set(text: str) -> FrozenSet[str]:
    """Return the words of a text as a set."""
    return frozenset(text.split())


def words(name: str) -> Tuple[str, ...]:
    """Return the words of an identifier, lower case: ``gtImage_2`` is gt, image, 2."""
    return tuple(word.lower() for word in _CAMEL.findall(name))


def constant(node: Optional[cst.CSTNode], default: Any = None) -> Any:
    """Return the value of a literal (also a negative number, a tuple of literals), else ``default``."""
    value = _literal(code(node)) if isinstance(node, _LITERALS) else _MISSING
    return default if value is _MISSING else value


@functools.lru_cache(maxsize=4096)
def _literal(text: str) -> Any:
    try:
        value = ast.literal_eval(text)
    except (SyntaxError, ValueError, TypeError):  # a name, "\x", or of a newer Python
        return _MISSING
    return tuple(value) if isinstance(value, list) else value


def index_of(node: cst.CSTNode) -> Optional[cst.BaseExpression]:
    """Return the only index of ``x[index]``; None for any other node, and for a slice."""
    index = node.slice[0].slice if isinstance(node, cst.Subscript) and len(node.slice) == 1 else None
    return index.value if isinstance(index, cst.Index) and index.star is None else None


def key_of(node: cst.CSTNode) -> Any:
    """Return the literal key of ``x["key"]`` or ``x[0]``, else None."""
    value = constant(index_of(node))
    return value if isinstance(value, (str, int)) and not isinstance(value, bool) else None


def path_of(node: cst.CSTNode) -> Optional[str]:
    """Return one spelling for a place that can be assigned: ``x``, ``self.x``, ``losses['im']``; else None."""
    if isinstance(node, cst.Name):
        return node.value
    base = path_of(node.value) if isinstance(node, (cst.Attribute, cst.Subscript)) else None
    if base is not None and isinstance(node, cst.Attribute):
        return f"{base}.{node.attr.value}"
    key = key_of(node) if base is not None else None
    return None if key is None else f"{base}[{key!r}]"


def attribute_chain(node: cst.CSTNode) -> Iterator[cst.CSTNode]:
    """Yield the node, then what it is an attribute, an item or a call of, down to the root."""
    while True:
        yield node
        if isinstance(node, (cst.Attribute, cst.Subscript)):
            node = node.value
        elif isinstance(node, cst.Call):
            node = node.func
        else:
            return


def root_of(node: cst.Name | cst.Attribute) -> str:
    """Return the last name of ``a.b``: b."""
    return node.value if isinstance(node, cst.Name) else node.attr.value


def call_name(node: cst.Call) -> str:
    """Return the last name of the callee: ``f`` of ``a.b.f(x)``; empty without one."""
    return root_of(node.func) if isinstance(node.func, (cst.Name, cst.Attribute)) else ""


def arguments(node: cst.Call) -> Tuple[List[cst.BaseExpression], Dict[str, cst.BaseExpression], bool]:
    """Return positional arguments, keyword arguments, and whether there is a ``*`` or ``**`` among them."""
    plain = [arg for arg in node.args if not arg.star]
    positional = [arg.value for arg in plain if arg.keyword is None]
    keywords = {arg.keyword.value: arg.value for arg in plain if arg.keyword is not None}
    return positional, keywords, len(plain) < len(node.args)


def children(node: cst.CSTNode) -> List[cst.CSTNode]:
    """Return a node's direct children in source order, without white space and punctuation."""
    found: List[Any] = []
    for name in _fields(type(node)):
        value = getattr(node, name)
        if type(value) not in _NO_NODES:
            found += value if type(value) in (list, tuple) else (value,)
    return found


def walk_expressions(node: cst.CSTNode) -> Iterator[cst.CSTNode]:
    """Yield a node and every node under it, but not the bodies of functions and classes under it."""
    stack = [node]
    while stack:
        node = stack.pop()
        yield node
        stack += [child for child in reversed(children(node)) if type(child) not in _SCOPES]


@functools.lru_cache(maxsize=None)
def _fields(kind: Any) -> Tuple[str, ...]:
    """Return the fields of a class of nodes, without those of white space, punctuation and text."""
    fields = [field.name for field in dataclasses.fields(kind) if field.type is not str]
    return tuple(name for name in fields if not _PUNCTUATION.match(name))


def same(a: cst.CSTNode, b: cst.CSTNode) -> bool:
    """Return whether two expressions have the same text, brackets and spaces aside."""
    return a is b or _squeezed(a) == _squeezed(b)


def _squeezed(node: cst.CSTNode) -> str:
    """Return the text of an expression without brackets around it, spaces and comments."""
    bare = node.with_changes(lpar=(), rpar=()) if isinstance(node, cst.BaseExpression) else node
    return re.sub(r"\s+|#[^\n]*", "", code(bare))


def names_where(test: cst.CSTNode, holds: bool) -> Tuple[cst.Name | cst.Attribute, ...]:
    """Return the names that are true where a test holds, or does not: ``tracking and x > 0``, ``not tracking``."""
    if isinstance(test, cst.UnaryOperation) and isinstance(test.operator, cst.Not):
        return names_where(test.expression, not holds)
    if holds and isinstance(test, cst.BooleanOperation) and isinstance(test.operator, cst.And):
        return names_where(test.left, True) + names_where(test.right, True)
    return (test,) if holds and isinstance(test, (cst.Name, cst.Attribute)) else ()


def every_parameter(parameters: cst.Parameters) -> Iterator[cst.Param]:
    """Yield the parameters of a function, ``*args`` and ``**kwargs`` included."""
    named = (*parameters.posonly_params, *parameters.params, *parameters.kwonly_params)
    return (each for each in (*named, parameters.star_arg, parameters.star_kwarg) if isinstance(each, cst.Param))


def words_in(*nodes: cst.CSTNode) -> Set[str]:
    """Return the words of the names and strings in expressions."""
    found: Set[str] = set()
    for node in (part for each in nodes for part in walk_expressions(each)):
        if isinstance(node, cst.Name):
            found.update(words(node.value))
        elif isinstance(node, cst.SimpleString) and isinstance(constant(node), str):
            found.update(words(constant(node)))
    return found
