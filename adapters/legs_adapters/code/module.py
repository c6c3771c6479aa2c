"""One parsed file: its functions and classes, and the byte positions of its nodes."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from platform import python_version
from typing import Any, Callable, Dict, Iterable, Iterator, List, Optional, Sequence, Tuple, TypeVar

from legs_adapters.code.flow import Flow
from legs_adapters.code.limits import Budget, over_the_limits, parsing_steps, remembered
from legs_adapters.code.parsing import Lines, Place
from legs_adapters.code.reaching import Definition
from legs_adapters.code.sources import Source, Unreadable
from legs_adapters.code.syntax import FUNCTIONS, arguments, children, dotted, walk_expressions

CALLED = ("forward", "__call__")  # what calling an instance runs: a torch module's own, and Python's

_T = TypeVar("_T")

_WORD = re.compile(r"\w+(?:\s*\()?")  # a word, and whether it is called


@dataclass(eq=False, repr=False)  # the text of one would be that of all its nodes
class Function:
    """A function, a method, or a module's top level.

    Attributes:
        module, name: its file and its name.
        node, body: its definition, and the statements in it.
        parent: the function around it, or the module's top level; None for the top level itself.
        owner: its class, for a method.
        inner: the functions that are defined in its body, in source order; of a top level none.
    """

    module: Module
    node: ast.FunctionDef | ast.AsyncFunctionDef | ast.Module
    parent: Optional[Function] = None
    owner: Optional[Class] = None

    def __post_init__(self) -> None:
        self.inner: List[Function] = []
        self.name: str = getattr(self.node, "name", "")
        self.body: List[ast.stmt] = self.node.body

    @property
    @remembered
    def text(self) -> str:
        """Its body as written; of a top level the file without the bodies of its functions."""
        data = self.module.lines.data
        if self.parent is not None:
            return data[self.span].decode("utf-8")
        cuts = [each.span for each in self.module.functions]
        starts, ends = [0, *(cut.stop for cut in cuts)], [*(cut.start for cut in cuts), len(data)]
        return b"".join(data[start:end] for start, end in zip(starts, ends)).decode("utf-8")

    @property
    def span(self) -> slice:
        """The bytes of its body."""
        return slice(self.place(self.body[0]).start, self.place(self.body[-1]).end)

    def walk(self) -> Iterator[ast.AST]:
        """Yield the nodes of its body, but for the functions and classes in it."""
        return walk_expressions(*(node for node in self.body if not isinstance(node, (*FUNCTIONS, ast.ClassDef))))

    def place(self, node: ast.AST, brackets: bool = False) -> Place:
        """Return the place of a node in the file, on request with the brackets around it."""
        return self.module.lines.place(node, brackets)

    @property
    @remembered
    def flow(self) -> Flow:
        """Its reaching definitions, computed once."""
        parameters = None if isinstance(self.node, ast.Module) else self.node.args
        try:
            flow = Flow(self.body, parameters, self.module.budget.left(self.module.path))
            if self.module.spend(flow.steps):
                return flow
        except RecursionError as error:
            self.module.failure = _failure(self.module.path, error)
        return Flow([], parameters)

    @property
    def parameters(self) -> List[str]:
        """Positional parameters' names, ``self`` and ``cls`` excepted."""
        if isinstance(self.node, ast.Module):
            return []
        names = [param.arg for param in (*getattr(self.node.args, "posonlyargs", ()), *self.node.args.args)]
        return names[1:] if self.owner is not None and "staticmethod" not in self.decorators and names else names

    def is_parameter(self, node: ast.AST) -> bool:
        """Return whether a name is a parameter of the function and has no other definition."""
        known = isinstance(node, ast.Name) and node.id in self.parameters
        return known and all(definition.kind == "parameter" for definition in self.flow.reaching(node))

    def given(self, call: ast.Call, parameter: str) -> Optional[ast.expr]:
        """Return the argument of a call of it for a parameter; None where it is missing or starred."""
        positional, keywords, _ = arguments(call)
        if parameter in keywords or parameter not in self.parameters:
            return keywords.get(parameter)
        position = self.parameters.index(parameter)
        return positional[position] if position < len(positional) else None

    @property
    def decorators(self) -> List[str]:
        """The last names of its decorators."""
        found = [] if isinstance(self.node, ast.Module) else self.node.decorator_list
        names = [dotted(node.func if isinstance(node, ast.Call) else node) or "" for node in found]
        return [name.split(".")[-1] for name in names]


@dataclass(eq=False, repr=False)  # the text of one would be that of all its nodes
class Class:
    """A class: its methods, and the values that they store in its attributes."""

    module: Module
    node: ast.ClassDef
    parent: Function

    def __post_init__(self) -> None:
        self.name: str = self.node.name
        self.methods: Dict[str, Function] = {}

    @remembered
    def stores(self, attribute: str) -> List[Tuple[Function, Definition]]:
        """Return what its methods assign to ``self.attribute``."""
        place = f"self.{attribute}"
        methods = [each for each in self.methods.values() if place in each.text]
        found = [(method, made) for method in methods for made in method.flow.definitions.get(place, ())]
        # Of `self.x.y = v` nothing is stored in x itself; of `self.x["key"] = v` something is.
        return [(method, made) for method, made in found if not str(made.key).startswith(".")]


class Module:
    """A parsed file.

    Attributes:
        text, lines: the file's text.
        functions: its functions and methods that are in no other, in source order.
        failure: why it is not analysed further.
        budget: what its analysis may take, with that of the other files.
    """

    def __init__(self, path: str, text: str, budget: Optional[Budget] = None) -> None:
        self.path = path
        self.budget: Budget = budget or Budget()
        self.text = text
        self.lines: Lines = Lines(text.encode("utf-8"))
        self.failure: Optional[Unreadable] = None
        self.spend(parsing_steps(text))
        self.by_node: Dict[int, Function | Class] = {}
        self.top: Function = Function(self, self.lines.tree())
        self._by_word: Optional[Dict[str, List[Function]]] = None
        self.functions: List[Function] = self._collect(self.top.body, self.top)

    def _collect(self, body: Sequence[ast.stmt], parent: Function, owner: Optional[Class] = None) -> List[Function]:
        """Record what a body defines; return its functions, in source order."""
        functions: List[Function] = []
        for node in _definitions(body):
            if isinstance(node, ast.ClassDef):
                found = Class(self, node, parent)
                self.by_node[id(node)] = found
                functions += self._collect(node.body, parent, found)
                continue
            function = Function(self, node, parent, owner)
            functions.append(function)
            self.by_node[id(node)] = function
            if owner is not None:
                owner.methods.setdefault(function.name, function)
            function.inner = self._collect(node.body, function)
        return functions

    def spend(self, steps: int) -> bool:
        """Count steps of its analysis; return whether it goes on. A file that is over is as one that does not parse."""
        why = self.budget.spend(self.path, steps)
        if why and self.failure is None:
            self.failure = Unreadable(self.path, why)
        return self.failure is None

    def scopes(self, matches: Callable[[str], object]) -> Iterator[Function]:
        """Yield the top level and the functions whose text matches."""
        return _chosen([self.top, *self.functions], matches)

    def mentioning(self, name: str, called: bool = False) -> Iterator[Function]:
        """Yield the scopes whose text has a word, or calls it, from an index of words."""
        if self._by_word is None:
            self._by_word = index_by_word((scope, scope.text) for scope in (self.top, *self.functions))
        for scope in self._by_word.get(f"{name}(" if called else name, ()):
            yield scope
            if scope.inner:
                pattern = re.compile(rf"\b{re.escape(name)}" + (r"\s*\(" if called else r"\b"))
                yield from _chosen(scope.inner, pattern.search)


def index_by_word(texts: Iterable[Tuple[_T, str]]) -> Dict[str, List[_T]]:
    """Return what has a word in its text, by the word; by ``word(`` what calls it."""
    found: Dict[str, List[_T]] = {}
    for entry, text in texts:
        called = {"".join(each.split()) for each in set(_WORD.findall(text))}
        for word in called.union(each.rstrip("(") for each in called):
            found.setdefault(word, []).append(entry)
    return found


def _chosen(functions: Sequence[Function], matches: Callable[[str], object]) -> Iterator[Function]:
    """Yield the functions whose text matches."""
    for function in functions:
        if matches(function.text):
            yield function
            yield from _chosen(function.inner, matches)


def parse(source: Source, budget: Optional[Budget] = None) -> Module | Unreadable:
    """Parse one file; a file that does not parse or is over the limits is returned with the reason."""
    over = (budget.why_none_left() if budget is not None else "") or over_the_limits(source.text)
    if over:
        return Unreadable(source.path, over)
    try:
        return Module(source.path, source.text, budget)
    except (SyntaxError, RecursionError, ValueError, MemoryError) as error:
        return _failure(source.path, error)


def _failure(path: str, error: Exception) -> Unreadable:
    if isinstance(error, SyntaxError):
        return Unreadable(path, f"does not parse (line {error.lineno or '?'}: {error.msg}; Python {python_version()})")
    if isinstance(error, (RecursionError, MemoryError)):
        return Unreadable(path, "is nested too deeply")
    return Unreadable(path, f"does not parse ({error})")


def _definitions(body: Iterable[ast.AST]) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef]:
    """Yield the functions and classes that a body defines, in branches and loops too, in source order."""
    for node in body:
        if isinstance(node, (*FUNCTIONS, ast.ClassDef)):
            yield node
        elif not isinstance(node, ast.expr):
            yield from _definitions(children(node))


def blocks_of(node: Any) -> Iterator[List[ast.stmt]]:
    """Yield the blocks of a statement: of a compound one those of all its branches, with each ``elif``."""
    parts = [node, *getattr(node, "handlers", ()), *getattr(node, "cases", ())]
    for block in [getattr(part, name, None) for part in parts for name in ("body", "orelse", "finalbody")]:
        if isinstance(block, list) and block:
            is_elif = isinstance(block[0], ast.If) and block[0].col_offset == node.col_offset
            yield from blocks_of(block[0]) if is_elif else [block]
