"""One parsed file: its functions and classes, and where its nodes stand in its bytes."""

from __future__ import annotations

import bisect
import re
from typing import Dict, Iterator, List, NamedTuple, Optional, Sequence, Tuple

import libcst as cst
from libcst.metadata import ByteSpanPositionProvider, MetadataWrapper

from legs_adapters.flow import Definition, Flow
from legs_adapters.repo import Source, Unreadable
from legs_adapters.syntax import code, dotted

__all__ = ["Class", "Function", "Module", "Place", "parse"]

_PRINT_STATEMENT = re.compile(
    r"^\s*(print\s+[\"'\w]|exec\s+[\"']|raise\s+\w+\s*,)|^\s*except\s+[\w.]+\s*,\s*\w+\s*:", re.M
)
_FORM_FEED = re.compile(r"^[ \t\f]*\f", re.M)  # LibCST loses these
_NEWLINE = re.compile(rb"\r\n|\r|\n")


class Function:
    """A function, a method, or a module's top level.

    Attributes:
        module, node, name: where it stands.
        parent: the function around it; a module's top level for what is defined there; None for the top level itself.
        owner: its class, for a method.
    """

    def __init__(
        self,
        module: Module,
        node: cst.FunctionDef | cst.Module,
        parent: Optional[Function] = None,
        owner: Optional[Class] = None,
    ) -> None:
        self.module = module
        self.node = node
        self.parent = parent
        self.owner = owner
        self.name = node.name.value if isinstance(node, cst.FunctionDef) else ""
        self._flow: Optional[Flow] = None

    def __repr__(self) -> str:
        return f"<{self.module.path}:{self.name or 'top level'}>"

    @property
    def flow(self) -> Flow:
        """Its reaching definitions, computed once."""
        if self._flow is None:
            if isinstance(self.node, cst.FunctionDef):
                self._flow = Flow(self.node.body, self.node.params)
            else:
                self._flow = Flow(self.node)
        return self._flow

    @property
    def parameters(self) -> List[str]:
        """Positional parameters' names, ``self`` and ``cls`` excepted."""
        if not isinstance(self.node, cst.FunctionDef):
            return []
        names = [param.name.value for param in (*self.node.params.posonly_params, *self.node.params.params)]
        return names[1:] if self.owner is not None and not self.static and names else names

    @property
    def static(self) -> bool:
        """Whether it is a static method."""
        return "staticmethod" in self.decorators

    @property
    def decorators(self) -> List[str]:
        """The last names of its decorators."""
        if not isinstance(self.node, cst.FunctionDef):
            return []
        names = []
        for decorator in self.node.decorators:
            node = decorator.decorator
            names.append((dotted(node.func if isinstance(node, cst.Call) else node) or "").split(".")[-1])
        return names


class Class:
    """A class: its methods, and what is stored in its attributes by any of them."""

    def __init__(self, module: Module, node: cst.ClassDef, parent: Function) -> None:
        self.module = module
        self.node = node
        self.parent = parent
        self.name = node.name.value
        self.methods: Dict[str, Function] = {}
        self.fields: Dict[str, cst.BaseExpression] = dict(_fields(node))
        self._stores: Optional[Dict[str, List[Tuple[Function, Definition]]]] = None

    @property
    def bases(self) -> List[str]:
        """The last names of its base classes."""
        return [(dotted(arg.value) or "").split(".")[-1] for arg in self.node.bases]

    def stores(self, attribute: str) -> List[Tuple[Function, Definition]]:
        """Return what its methods assign to ``self.attribute``."""
        if self._stores is None:
            self._stores = {}
            for method in self.methods.values():
                for place, definitions in method.flow.definitions.items():
                    if place.startswith("self.") and place.count(".") == 1 and "[" not in place:
                        entries = self._stores.setdefault(place[5:], [])
                        # Of `self.x.y = v` nothing is stored in x itself; of `self.x["key"] = v` something is.
                        entries.extend((method, d) for d in definitions if not str(d.key).startswith("."))
        return self._stores.get(attribute, [])


def _fields(node: cst.ClassDef) -> Iterator[Tuple[str, cst.BaseExpression]]:
    for statement in node.body.body:
        for small in statement.body if isinstance(statement, cst.SimpleStatementLine) else ():
            if isinstance(small, cst.Assign):
                for target in small.targets:
                    if isinstance(target.target, cst.Name):
                        yield target.target.value, small.value
            elif isinstance(small, cst.AnnAssign) and isinstance(small.target, cst.Name) and small.value:
                yield small.target.value, small.value


class Place(NamedTuple):
    """Where a node stands: bytes of the file without its byte order mark; lines count from 1, columns from 0."""

    start: int
    end: int
    line: int
    column: int
    last_line: int


class Module:
    """A parsed file.

    Attributes:
        text: the file's text.
        functions: every function in it, methods and nested functions too, in source order; ``top`` is its top level.
        classes: every class in it.
    """

    def __init__(self, path: str, tree: cst.Module, text: str) -> None:
        self.path = path
        self.tree = tree
        self.text = text
        self.top = Function(self, tree)
        self.functions: List[Function] = []
        self.classes: List[Class] = []
        self.by_node: Dict[int, Function | Class] = {}
        self._collect(tree.body, self.top)
        self._places: Optional[_Places] = None

    def _collect(self, statements: Sequence[cst.CSTNode], parent: Function, owner: Optional[Class] = None) -> None:
        for node in _definitions(statements):
            if isinstance(node, cst.FunctionDef):
                function = Function(self, node, parent, owner)
                self.functions.append(function)
                self.by_node[id(node)] = function
                if owner is not None:
                    owner.methods.setdefault(function.name, function)
                self._collect(node.body.body, function)
            else:
                found = Class(self, node, parent)
                self.classes.append(found)
                self.by_node[id(node)] = found
                self._collect(node.body.body, parent, found)

    def everything(self) -> List[Function]:
        """Every function and the top level."""
        return [self.top, *self.functions]

    @property
    def places(self) -> _Places:
        """Where its nodes stand, computed once."""
        if self._places is None:
            self._places = _Places(self.tree, self.text)
        return self._places


class _Places:
    """Where the nodes of a tree stand in the file that it was parsed from."""

    def __init__(self, tree: cst.Module, text: str) -> None:
        parsed, shifts = _without_form_feeds(text)
        self.bytes = text.encode("utf-8")
        self._spans = MetadataWrapper(tree, unsafe_skip_copy=True).resolve(ByteSpanPositionProvider)
        self._lines = [0, *(match.end() for match in _NEWLINE.finditer(self.bytes))]
        self._shifts = shifts
        if tree.bytes != parsed.encode("utf-8"):
            raise ValueError("LibCST would write another text")

    def of(self, node: cst.CSTNode, brackets: bool = False) -> Place:
        """Return where a node begins and ends, on request with the brackets around it."""
        span = self._spans[node]
        start, end = span.start, span.start + span.length
        if brackets and isinstance(node, cst.BaseExpression):
            start -= sum(len(code(part).encode()) for part in node.lpar)
            end += sum(len(code(part).encode()) for part in node.rpar)
        start, end = self._in_file(start), self._in_file(end)
        line, last = bisect.bisect_right(self._lines, start), bisect.bisect_left(self._lines, end)
        return Place(start, end, line, start - self._lines[line - 1], max(line, last))

    def line_start(self, line: int) -> int:
        """Return the byte where a line begins; the end of the file for the line after the last."""
        return self._lines[line - 1] if line <= len(self._lines) else len(self.bytes)

    def _in_file(self, at: int) -> int:
        return at + self._shifts[bisect.bisect_right(self._shifts, (at, len(self.bytes))) - 1][1]


def _without_form_feeds(text: str) -> Tuple[str, List[Tuple[int, int]]]:
    """Return a text without the form feeds that begin its lines, and (byte, bytes that are missing from there on)."""
    shifts, parts, at, length, missing = [(0, 0)], [], 0, 0, 0
    for match in _FORM_FEED.finditer(text):
        parts.append(text[at : match.start()])
        length += len(parts[-1].encode("utf-8"))
        missing += match.end() - match.start()
        shifts.append((length, missing))
        at = match.end()
    return "".join([*parts, text[at:]]), shifts


def parse(source: Source) -> Module | Unreadable:
    """Parse one file; what is not Python, or not of this version, is returned with its reason."""
    try:
        return Module(source.path, cst.parse_module(_without_form_feeds(source.text)[0]), source.text)
    except cst.ParserSyntaxError as error:
        python2 = _PRINT_STATEMENT.search(source.text) is not None
        reason = "Python 2" if python2 else f"does not parse (line {getattr(error, 'raw_line', 0)})"
        return Unreadable(source.path, reason)
    except RecursionError:
        return Unreadable(source.path, "is nested too deeply")
    except ValueError as error:
        return Unreadable(source.path, f"cannot be parsed: {type(error).__name__}")


def _definitions(statements: Sequence[cst.CSTNode]) -> Iterator[cst.FunctionDef | cst.ClassDef]:
    """Yield the functions and classes that statements define, in branches and loops too, in source order."""
    for node in statements:
        if isinstance(node, (cst.FunctionDef, cst.ClassDef)):
            yield node
        elif isinstance(node, cst.BaseCompoundStatement):
            for body in _bodies(node):
                yield from _definitions(body)


def _bodies(node: cst.CSTNode) -> Iterator[Sequence[cst.CSTNode]]:
    """Yield the blocks of a compound statement."""
    if hasattr(node, "body"):
        yield node.body.body
    for clause in (*getattr(node, "handlers", ()), *getattr(node, "cases", ())):
        yield clause.body.body
    for name in ("orelse", "finalbody"):
        clause = getattr(node, name, None)
        if clause is not None:
            yield from _bodies(clause)
