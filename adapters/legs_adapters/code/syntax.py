"""Helpers for syntax trees: a node's name, the words in it, the value of a constant."""

from __future__ import annotations

import ast
import functools
import re
import sys
from typing import Any, Dict, FrozenSet, Iterator, List, NamedTuple, Optional, Set, Tuple

FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
LOOPS = (ast.For, ast.AsyncFor, ast.While)


_CAMEL = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_LITERALS = (ast.Constant, ast.UnaryOp, ast.Tuple, ast.List)
_MISSING = object()
_NO_PARTS = re.compile("ctx|ops?|type_.*|id|attr|arg|(as)?name|module|level|kind|conversion|simple|is_async")
_SCOPES = (*FUNCTIONS, ast.ClassDef)


class Arg(NamedTuple):
    """An argument of a call: its value, its keyword or "", and its stars."""

    value: ast.expr
    keyword: str
    star: str


def code(node: ast.AST, brackets: bool = False) -> str:
    """Return a node's text in its file, on request with brackets around it; of a name that was made here, that name."""
    lines = getattr(node, "source", None)
    return str(lines.code(node, brackets)) if lines is not None else name_of(node)


def one_line(node: ast.AST) -> str:
    """Return a node's source text on one line."""
    return " ".join(code(node).split())


def name_of(node: ast.AST) -> str:
    """Return the identifier that a node has itself, of a variable, attribute, keyword or definition; or ""."""
    for field in ("id", "attr", "arg", "name"):
        name = getattr(node, field, None)
        if isinstance(name, str):
            return name
    return ""


def said_by(node: ast.AST) -> str:
    """Return what a node says itself: its identifier, or a string's text; or ""."""
    text = constant(node) if isinstance(node, ast.Constant) else name_of(node)
    return text if isinstance(text, str) else ""


def dotted(node: ast.AST) -> Optional[str]:
    """Return ``a.b.c`` for a chain of names, else None."""
    path = path_of(node)
    return None if path is None or "[" in path else path


def word_set(text: str) -> FrozenSet[str]:
    """Return the words of a text as a set."""
    return frozenset(text.split())


@functools.lru_cache(maxsize=4096)
def words(name: str) -> Tuple[str, ...]:
    """Return the words of an identifier, lower case: ``gtImage_2`` is gt, image, 2."""
    return tuple(word.lower() for word in _CAMEL.findall(name))


def constant(node: Optional[ast.AST], default: Any = None) -> Any:
    """Return the value of a literal (also a negative number, a tuple of literals), else ``default``."""
    if type(node) is ast.Constant:
        return default if node.value is ... else node.value
    value = _literal(node) if isinstance(node, _LITERALS) else _MISSING
    return default if value is _MISSING else value


def _literal(node: Any) -> Any:
    try:
        value = ast.literal_eval(node)
    except (SyntaxError, ValueError, TypeError):  # a name in it
        return _MISSING
    return tuple(value) if isinstance(value, list) else value


def indices(node: ast.Subscript) -> List[ast.expr]:
    """Return the indices of ``x[a, b:c]``."""
    several = isinstance(node.slice, ast.Tuple) and node.slice.elts
    return list(several) if several else [node.slice]


def index_of(node: Optional[ast.AST]) -> Optional[ast.expr]:
    """Return the only index of ``x[index]``; None for any other node, and for a slice."""
    index = indices(node) if isinstance(node, ast.Subscript) else []
    return index[0] if len(index) == 1 and not isinstance(index[0], (ast.Slice, ast.Starred)) else None


def key_of(node: ast.AST) -> Any:
    """Return the literal key of ``x["key"]`` or ``x[0]``, else None."""
    value = constant(index_of(node))
    return value if isinstance(value, (str, int)) and not isinstance(value, bool) else None


def path_of(node: Optional[ast.AST]) -> Optional[str]:
    """Return one spelling for a place that can be assigned: ``x``, ``self.x``, ``losses['im']``; else None."""
    if isinstance(node, ast.Name):
        return node.id
    base = path_of(node.value) if isinstance(node, (ast.Attribute, ast.Subscript)) else None
    if base is not None and isinstance(node, ast.Attribute):
        return f"{base}.{node.attr}"
    key = key_of(node) if base is not None and node is not None else None
    return None if key is None else f"{base}[{key!r}]"


def attribute_chain(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the node, then what it is an attribute, an item or a call of, down to the root."""
    while True:
        yield node
        if isinstance(node, (ast.Attribute, ast.Subscript)):
            node = node.value
        elif isinstance(node, ast.Call):
            node = node.func
        else:
            return


def root_of(node: ast.Name | ast.Attribute) -> str:
    """Return the last name of ``a.b``: b."""
    return node.id if isinstance(node, ast.Name) else node.attr


def call_name(node: ast.Call) -> str:
    """Return the last name of the callee: ``f`` of ``a.b.f(x)``; empty without one."""
    return root_of(node.func) if isinstance(node.func, (ast.Name, ast.Attribute)) else ""


def given(node: ast.Call) -> List[Arg]:
    """Return all arguments of a call, the positional ones first."""
    starred = (ast.Starred,)
    values = [Arg(a.value, "", "*") if isinstance(a, starred) else Arg(a, "", "") for a in node.args]
    return values + [Arg(each.value, each.arg or "", "" if each.arg else "**") for each in node.keywords]


def arguments(node: ast.Call) -> Tuple[List[ast.expr], Dict[str, ast.expr], bool]:
    """Return positional arguments, keyword arguments, and whether there is a ``*`` or ``**`` among them."""
    positional = [arg for arg in node.args if not isinstance(arg, ast.Starred)]
    keywords = {each.arg: each.value for each in node.keywords if each.arg is not None}
    return positional, keywords, len(positional) + len(keywords) < len(node.args) + len(node.keywords)


def entries(node: ast.AST) -> List[Tuple[ast.expr, ast.expr]]:
    """Return the keys and values of a literal dictionary, without those of ``**other``; nothing of any other node."""
    pairs = zip(node.keys, node.values) if isinstance(node, ast.Dict) else ()
    return [(key, value) for key, value in pairs if key is not None]


def children(node: ast.AST) -> List[ast.AST]:
    """Return a node's direct children, without operators, and of an f-string without its texts.

    Before Python 3.10 an f-string has none: the parser does not know where in the file they stand.
    """
    if isinstance(node, ast.Dict):
        return [each for pair in zip(node.keys, node.values) for each in pair if each is not None]
    if isinstance(node, ast.JoinedStr):
        return [each for each in node.values if isinstance(each, ast.FormattedValue) and sys.version_info >= (3, 10)]
    found: List[ast.AST] = []
    for name in _fields(type(node)):  # type: ignore[arg-type]
        value = getattr(node, name, None)
        if isinstance(value, ast.AST):
            found.append(value)
        elif type(value) is list:
            found += [each for each in value if isinstance(each, ast.AST)]
    return found


def walk_expressions(*nodes: ast.AST) -> Iterator[ast.AST]:
    """Yield nodes and every node under them, but not the bodies of functions and classes under them."""
    stack = list(reversed(nodes))
    while stack:
        node = stack.pop()
        yield node
        stack += [child for child in reversed(children(node)) if type(child) not in _SCOPES]


@functools.lru_cache(maxsize=None)
def _fields(kind: Any) -> Tuple[str, ...]:
    return tuple(name for name in kind._fields if not _NO_PARTS.fullmatch(name))


def same(a: ast.AST, b: ast.AST) -> bool:
    """Return whether two expressions are equal, brackets, spaces and comments aside."""
    return a is b or (type(a) is type(b) and _dumped(a) == _dumped(b))


def _dumped(node: ast.AST) -> str:
    return re.sub(r"ctx=\w+\(\)", "", ast.dump(node))


def names_where(test: ast.AST, holds: bool) -> Tuple[ast.Name | ast.Attribute, ...]:
    """Return the names that are true where a test holds, or does not: ``tracking and x > 0``, ``not tracking``."""
    if isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not):
        return names_where(test.operand, not holds)
    if holds and isinstance(test, ast.BoolOp) and isinstance(test.op, ast.And):
        return tuple(name for value in test.values for name in names_where(value, True))
    return (test,) if holds and isinstance(test, (ast.Name, ast.Attribute)) else ()


def every_parameter(parameters: ast.arguments) -> Iterator[Tuple[ast.arg, Optional[ast.expr]]]:
    """Yield the parameters of a function, ``*args`` and ``**kwargs`` included, each with its default."""
    named = [*getattr(parameters, "posonlyargs", ()), *parameters.args]
    defaults = [None] * (len(named) - len(parameters.defaults)) + list(parameters.defaults)
    yield from zip(named, defaults)
    yield from zip(parameters.kwonlyargs, parameters.kw_defaults)
    yield from ((each, None) for each in (parameters.vararg, parameters.kwarg) if each is not None)


def words_in(*nodes: ast.AST) -> Set[str]:
    """Return the words of the names and strings in expressions."""
    return {word for node in walk_expressions(*nodes) for word in words(said_by(node))}
