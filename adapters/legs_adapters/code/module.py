"""One parsed file: its functions and classes, and the byte positions of its nodes."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Callable, Dict, Iterable, Iterator, List, Optional, Sequence, Tuple, TypeVar

import libcst as cst

from legs_adapters.code.flow import MUTATORS, Flow
from legs_adapters.code.limits import Budget, over_the_limits, parsing_steps, remembered
from legs_adapters.code.parsing import STUB, Lines, Part, Place, body_part, outline_part, read_by_python
from legs_adapters.code.reaching import Definition
from legs_adapters.code.sources import Source, Unreadable
from legs_adapters.code.syntax import arguments, children, dotted

CALLED = ("forward", "__call__")  # what calling an instance runs: a torch module's own, and Python's

_T = TypeVar("_T")
_WORD = re.compile(r"\w+(?:\s*\()?")  # a word, and whether it is called
# What a text may store; for what it only reads, its function is not parsed.
# Neither called nor read through an attribute, and behind it an assignment, an ``in``, a colon or a line that goes on.
_STORED = re.compile(
    rf"self\.(\w+)(?:(?=\.(?:{'|'.join(sorted(MUTATORS))}|\w+_)[ \t]*\()|(?!\w|[ \t]*[.(])"
    r"(?=(?:[^\n]{0,400}(?:[^=!<>]|<<|>>))?=(?!=)|[^\n]{0,400}\bin\b|[^\n)[]{0,400}:"
    r"|[^\n)]{0,400}(?:[,([\\]\s*(?:#[^\n]*)?$|\n\s*[])])))",
    re.M,
)
_DEFINES = re.compile(r"^[ \t]+(async[ \t]+)?(def|class)\b", re.M)


@dataclass(eq=False, repr=False)  # the text of one would be that of all its nodes
class Function:
    """A function, a method, or a module's top level.

    Attributes:
        module, name: its file and its name.
        node: its header; its body is ``body``.
        parent: the function around it, or the module's top level; None for the top level itself.
        owner: its class, for a method.
        cut: the bytes of its body, where that is not part of ``node``.
        text: the text that contains it: its own body, or (where that was not cut out) the text around it. It is
            searched before anything is parsed.
    """

    module: Module
    node: cst.FunctionDef | cst.Module
    parent: Optional[Function] = None
    owner: Optional[Class] = None
    cut: Optional[slice] = None
    _part: Optional[Part] = None

    def __post_init__(self) -> None:
        self._inner: List[Function] = []
        self.name: str = self.node.name.value if isinstance(self.node, cst.FunctionDef) else ""
        is_inside = self.parent is not None and self.parent.parent is not None
        around = self.parent.text if is_inside and self.parent is not None else self.module.outline_text
        self.text: str = around if self.cut is None else self.module.lines.data[self.cut].decode("utf-8")

    @property
    @remembered
    def body(self) -> cst.BaseSuite | cst.Module:
        """Its statements, parsed on first use."""
        if self.cut is not None and self.module.spend(parsing_steps(self.text)):
            try:
                self._part = body_part(self.module.lines, self.cut)
                header = self._part.tree.body[0]
                assert isinstance(header, cst.FunctionDef)
                self._inner = self.module.collect(header.body, self)
                return header.body
            except (cst.ParserSyntaxError, RecursionError, ValueError) as error:
                before = self.module.lines.place(self.cut.start, self.cut.start).line - 2
                self.module.failure = _failure(self.module.path, self.module.text, error, before)
        return self.node if isinstance(self.node, cst.Module) else self.node.body

    @property
    @remembered
    def inner(self) -> List[Function]:
        """The functions that are defined in its body, and theirs, in source order."""
        if self.cut is not None and _DEFINES.search(self.text):
            assert self.body is not None  # which finds them
        return self._inner

    def place(self, node: cst.CSTNode, brackets: bool = False) -> Place:
        """Return the place of a node of it in the file, on request with the brackets around it.

        Raises:
            ValueError: LibCST would write another text than it read.
        """
        scope: Function = self.parent if self.parent is not None and node is self.node else self
        while scope._part is None and scope.parent is not None:
            scope = scope.parent
        return (scope._part or self.module.outline).place(node, brackets)

    @property
    @remembered
    def flow(self) -> Flow:
        """Its reaching definitions, computed once."""
        parameters = self.node.params if isinstance(self.node, cst.FunctionDef) else None
        try:
            flow = Flow(self.body, parameters, self.module.budget.left(self.module.path))
            if self.module.spend(flow.steps):
                return flow
        except RecursionError as error:
            self.module.failure = _failure(self.module.path, self.module.text, error)
        return Flow(cst.Module(body=[]), parameters)

    @property
    def parameters(self) -> List[str]:
        """Positional parameters' names, ``self`` and ``cls`` excepted."""
        if not isinstance(self.node, cst.FunctionDef):
            return []
        names = [param.name.value for param in (*self.node.params.posonly_params, *self.node.params.params)]
        return names[1:] if self.owner is not None and "staticmethod" not in self.decorators and names else names

    def is_parameter(self, node: cst.CSTNode) -> bool:
        """Return whether a name is a parameter of the function and has no other definition."""
        known = isinstance(node, cst.Name) and node.value in self.parameters
        return known and all(definition.kind == "parameter" for definition in self.flow.reaching(node))

    def given(self, call: cst.Call, parameter: str) -> Optional[cst.BaseExpression]:
        """Return the argument of a call of it for a parameter; None where it is missing or starred."""
        positional, keywords, _ = arguments(call)
        if parameter in keywords or parameter not in self.parameters:
            return keywords.get(parameter)
        position = self.parameters.index(parameter)
        return positional[position] if position < len(positional) else None

    @property
    def decorators(self) -> List[str]:
        """The last names of its decorators."""
        found = [each.decorator for each in self.node.decorators] if isinstance(self.node, cst.FunctionDef) else []
        names = [dotted(node.func if isinstance(node, cst.Call) else node) or "" for node in found]
        return [name.split(".")[-1] for name in names]


@dataclass(eq=False, repr=False)  # the text of one would be that of all its nodes
class Class:
    """A class: its methods, and the values that they store in its attributes."""

    module: Module
    node: cst.ClassDef
    parent: Function

    def __post_init__(self) -> None:
        self.name: str = self.node.name.value
        self.methods: Dict[str, Function] = {}

    @remembered
    def stores(self, attribute: str, where: Callable[[Function], bool] = bool) -> List[Tuple[Function, Definition]]:
        """Return what its methods (those of which ``where`` is true) assign to ``self.attribute``."""
        mentions = [method for method in self.methods.values() if f"self.{attribute}" in method.text]
        methods = [each for each in mentions if attribute in _STORED.findall(each.text) and where(each)]
        found = [(method, d) for method in methods for d in method.flow.definitions.get(f"self.{attribute}", ())]
        # Of `self.x.y = v` nothing is stored in x itself; of `self.x["key"] = v` something is.
        return [(method, made) for method, made in found if not str(made.key).startswith(".")]


class Module:
    """A parsed file.

    Attributes:
        text, lines: the file's text.
        outline, outline_text: the file without the bodies of its functions.
        failure: why a body of it could not be parsed, or is not analysed further.
        budget: what its analysis may take, with that of the other files.
    """

    def __init__(self, path: str, text: str, budget: Optional[Budget] = None) -> None:
        self.path = path
        self.budget: Budget = budget or Budget()
        self.text = text
        self.lines: Lines = Lines(text.encode("utf-8"))
        parts = outline_part(self.lines)
        self.outline: Part = parts[0]
        self.outline_text: str = STUB.sub("0", self.outline.text.decode("utf-8"))
        self.failure: Optional[Unreadable] = None
        self.spend(parsing_steps(self.outline_text))
        self.by_node: Dict[int, Function | Class] = {}
        self.top: Function = Function(self, self.outline.tree)
        self._by_word: Optional[Dict[str, List[Function]]] = None
        self._cuts: Iterator[Optional[slice]] = iter(parts[1])
        self._functions = self.collect(self.outline.tree, self.top)

    def collect(self, body: cst.CSTNode, parent: Function, owner: Optional[Class] = None) -> List[Function]:
        """Record what a body defines; return its functions, in source order."""
        functions: List[Function] = []
        for node in _definitions(body):
            if isinstance(node, cst.FunctionDef):
                cut = next(self._cuts, None) if parent is self.top else None
                function = Function(self, node, parent, owner, cut)
                functions.append(function)
                self.by_node[id(node)] = function
                if owner is not None:
                    owner.methods.setdefault(function.name, function)
                if cut is None:
                    function._inner = self.collect(node.body, function)
            else:
                found = Class(self, node, parent)
                self.by_node[id(node)] = found
                functions += self.collect(node.body, parent, found)
        return functions

    def spend(self, steps: int) -> bool:
        """Count steps of its analysis; return whether it goes on. A file that is over is as one that does not parse."""
        why = self.budget.spend(self.path, steps)
        if why and self.failure is None:
            self.failure = Unreadable(self.path, why)
        return self.failure is None

    def scopes(self, matches: Callable[[str], object]) -> Iterator[Function]:
        """Yield the top level and the functions whose text matches."""
        return _chosen([self.top, *self._functions], matches)

    def mentioning(self, name: str, called: bool = False) -> Iterator[Function]:
        """Yield the scopes whose text has a word, or calls it, from an index of words."""
        if self._by_word is None:
            self._by_word = index_by_word((scope, scope.text) for scope in (self.top, *self._functions))
        for scope in self._by_word.get(f"{name}(" if called else name, ()):
            yield scope
            if scope.inner:
                pattern = re.compile(rf"\b{re.escape(name)}" + (r"\s*\(" if called else r"\b"))
                yield from _chosen(scope.inner, pattern.search, scope.text)


def index_by_word(texts: Iterable[Tuple[_T, str]]) -> Dict[str, List[_T]]:
    """Return what has a word in its text, by the word; by ``word(`` what calls it."""
    found: Dict[str, List[_T]] = {}
    before, known = "", {""}
    for entry, text in texts:
        if text is not before:  # before Python 3.8 all functions of a file share its text
            called = {"".join(each.split()) for each in set(_WORD.findall(text))}
            before, known = text, called.union(each.rstrip("(") for each in called)
        for word in known:
            found.setdefault(word, []).append(entry)
    return found


def _chosen(
    functions: Sequence[Function], matches: Callable[[str], object], matched: Optional[str] = None
) -> Iterator[Function]:
    """Yield the functions whose text matches; a text that several share is matched once."""
    for function in functions:
        if function.text is matched or matches(function.text):
            yield function
            yield from _chosen(function.inner, matches, function.text)


def parse(source: Source, budget: Optional[Budget] = None) -> Module | Unreadable:
    """Parse one file; a file that does not parse or is over the limits is returned with the reason."""
    over = (budget.why_none_left() if budget is not None else "") or over_the_limits(source.text)
    if over:
        return Unreadable(source.path, over)
    try:
        return Module(source.path, source.text, budget)
    except (cst.ParserSyntaxError, RecursionError, ValueError) as error:
        return _failure(source.path, source.text, error)


def _failure(path: str, text: str, error: Exception, lines_before: int = 0) -> Unreadable:
    if isinstance(error, cst.ParserSyntaxError):
        known, line = read_by_python(text.encode("utf-8")), lines_before + error.raw_line
        why = "Python reads it, and LibCST does not"
        if isinstance(known, SyntaxError):
            line, why = known.lineno or line, known.msg
        return Unreadable(path, f"does not parse (line {line}: {why})")
    if isinstance(error, RecursionError):
        return Unreadable(path, "is nested too deeply")
    return Unreadable(path, f"cannot be parsed: {type(error).__name__}")


def _definitions(node: cst.CSTNode) -> Iterator[cst.FunctionDef | cst.ClassDef]:
    """Yield the functions and classes that a body defines, in branches and loops too, in source order."""
    for child in children(node):
        if isinstance(child, (cst.FunctionDef, cst.ClassDef)):
            yield child
        elif not isinstance(child, (cst.BaseExpression, cst.SimpleStatementLine)):
            yield from _definitions(child)


def blocks_of(node: cst.CSTNode) -> Iterator[Sequence[cst.CSTNode]]:
    """Yield the blocks of a statement: of a compound one those of all its branches."""
    for child in children(node):
        if isinstance(child, cst.BaseSuite):
            yield child.body
        elif not isinstance(child, cst.BaseExpression):
            yield from blocks_of(child)
