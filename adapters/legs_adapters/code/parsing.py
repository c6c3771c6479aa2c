"""Parse a file in parts: its outline first, the body of a function on first use.

LibCST makes a node of every space, and takes some fifteen times as long as Python's own parser. The latter finds the
positions of the bodies; the outline has a number and a comment of the same length in their place, so that every byte
stays where it is. What Python cannot read, or cannot locate (before Python 3.8), is parsed in one part.
"""

from __future__ import annotations

import ast
import bisect
import itertools
import re
import warnings
from dataclasses import dataclass, field
from typing import Any, Dict, Iterator, List, NamedTuple, Optional, Tuple

import libcst as cst
from libcst._nodes.internal import CodegenState

from legs_adapters.code.syntax import code
from legs_loss.system.ctrl_c import held_back

STUB = re.compile("0#x*")  # what stands for a body

_CHECK = cst.CSTNode.__post_init__  # of a new node, a tenth of LibCST's time: what its parser makes needs none
_FORM_FEED = re.compile(rb"^[ \t\f]*\f[ \t\f]*(?=\r?$)", re.M)  # LibCST loses these lines: comments, to it
_NEWLINE = re.compile(rb"\r\n|\r|\n")
_LONE_RETURN = re.compile(rb"\r(?!\n)")
_COMPOUND = (ast.stmt, ast.excepthandler, getattr(ast, "match_case", ast.stmt))


class Place(NamedTuple):
    """The place of a node: bytes of the file without its byte order mark; lines count from 1, columns from 0."""

    start: int
    end: int
    line: int
    column: int
    last_line: int


class Lines:
    """The lines of a file."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self._starts = [0, *(match.end() for match in _NEWLINE.finditer(data))]

    def start(self, line: int) -> int:
        """Return the byte where a line begins; the end of the file for the line after the last."""
        return self._starts[line - 1] if line <= len(self._starts) else len(self.data)

    def text(self, line: int) -> str:
        """Return one line, without the white space around it."""
        return self.data[self.start(line) : self.start(line + 1)].decode("utf-8").strip()

    def place(self, start: int, end: int) -> Place:
        """Return the place of a span of bytes."""
        line, last = bisect.bisect_right(self._starts, start), bisect.bisect_left(self._starts, end)
        return Place(start, end, line, start - self._starts[line - 1], max(line, last))


@dataclass
class _TokenCount(CodegenState):
    """The tokens that LibCST writes, and which are a node's, by its id: LibCST's own spans take twice as long."""

    spans: Dict[int, Tuple[int, int]] = field(default_factory=dict)
    _starts: List[int] = field(default_factory=list)
    _open: List[Any] = field(default_factory=list)

    def before_codegen(self, node: cst.CSTNode) -> None:
        self._starts.append(len(self.tokens))

    def after_codegen(self, node: cst.CSTNode) -> None:
        self.spans.setdefault(id(node), (self._starts.pop(), len(self.tokens)))

    def record_syntactic_position(self, node: Any, *, start_node: Any = None, end_node: Any = None) -> Any:
        self._open.append((len(self.tokens), node, start_node, end_node))
        return self

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        start, node, start_node, end_node = self._open.pop()
        start = start if start_node is None else self.spans[id(start_node)][0]
        self.spans[id(node)] = start, len(self.tokens) if end_node is None else self.spans[id(end_node)][1]


class Part:
    """Bytes that were parsed separately.

    Attributes:
        tree: what was parsed.
        text: what it was parsed from.
    """

    def __init__(self, lines: Lines, text: bytes, shift: int = 0) -> None:
        self.text: bytes = _FORM_FEED.sub(lambda found: b"#" * len(found.group()), text)
        cst.CSTNode.__post_init__ = lambda self: None  # type: ignore[method-assign]
        try:
            self.tree: cst.Module = cst.parse_module(self.text.decode("utf-8"))
        finally:
            cst.CSTNode.__post_init__ = _CHECK  # type: ignore[method-assign]
        self._lines = lines
        self._writing = _TokenCount(self.tree.default_indent, self.tree.default_newline)
        self._starts: List[int] = [shift]  # the byte at which each token starts, and the end
        self._unwritten: Iterator[cst.CSTNode] = itertools.chain(self.tree.header, self.tree.body)

    def place(self, node: cst.CSTNode, brackets: bool = False) -> Place:
        """Return the place of a node in the file, on request with the brackets around it.

        Raises:
            ValueError: LibCST would write another text than it read.
        """
        while id(node) not in self._writing.spans:
            self._write(next(self._unwritten))
        start, end = (self._starts[i] for i in self._writing.spans[id(node)])
        if brackets and isinstance(node, cst.BaseExpression):
            start -= sum(len(code(part).encode()) for part in node.lpar)
            end += sum(len(code(part).encode()) for part in node.rpar)
        return self._lines.place(start, end)

    def _write(self, statement: cst.CSTNode) -> None:
        """Let LibCST write the next statement, and compare it with what was read."""
        with held_back():  # in there LibCST would make a KeyError of Ctrl-C
            statement._codegen(self._writing)
        tokens = [token.encode() for token in self._writing.tokens[len(self._starts) - 1 :]]
        at, written = self._starts[-1], b"".join(tokens)
        start = at - self._starts[0]
        read = self.text[start : start + len(written)]
        # Where the last line has no end, LibCST writes one.
        if written not in (read, read + self.tree.default_newline.encode()):
            at += next((i for i, (one, other) in enumerate(zip(written, read)) if one != other), len(read))
            line = self._lines.place(at, at).line
            raise ValueError(f"cannot be written back exactly: LibCST would write line {line} in another way")
        self._starts[-1:] = itertools.accumulate(itertools.chain([at], map(len, tokens)))


def outline_part(lines: Lines) -> Tuple[Part, List[Optional[slice]]]:
    """Parse a file without the bodies of its functions and methods.

    Returns:
        The outline, and for each of those functions, in source order, the bytes that were cut, whole lines; empty where
        nothing was cut.

    Raises:
        libcst.ParserSyntaxError, RecursionError, ValueError: it does not parse.
    """
    outline, cuts = bytearray(lines.data), _cuts(lines)
    for cut in filter(None, cuts):
        body = lines.data[cut]
        statements = body.lstrip(b" \t").rstrip(b"\r\n")
        stub = b"0#".ljust(len(statements), b"x")[: len(statements)]
        outline[cut] = body.replace(statements, stub)
    return Part(lines, bytes(outline)), cuts


def body_part(lines: Lines, cut: slice) -> Part:
    """Parse what was cut, as the body of the one function of a module.

    Raises:
        libcst.ParserSyntaxError, RecursionError, ValueError: it does not parse.
    """
    newline = _NEWLINE.search(lines.data)
    header = b"async def _():" + (newline.group() if newline is not None else b"\n")
    return Part(lines, header + lines.data[cut], cut.start - len(header))


def read_by_python(data: bytes, flags: int = ast.PyCF_ONLY_AST) -> Any:
    """Return a file as this Python parses or compiles it, or the error: it is newer, or deeper than its parser goes."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return compile(data, "file", "exec", flags, dont_inherit=True)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        return error


def _cuts(lines: Lines) -> List[Optional[slice]]:
    tree = read_by_python(lines.data) if _LONE_RETURN.search(lines.data) is None else None
    return [_cut(lines, node) for node in _functions(tree)] if isinstance(tree, ast.AST) else []


def _functions(node: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Yield the functions and methods that are not nested in another function, in source order."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield child
        elif isinstance(child, _COMPOUND):
            yield from _functions(child)


def _cut(lines: Lines, node: ast.FunctionDef | ast.AsyncFunctionDef) -> Optional[slice]:
    """Return the span of a body, if it has its own lines and Python reports where they end."""
    first, last = node.body[0], node.body[-1]
    end_line, end_column = getattr(last, "end_lineno", None), getattr(last, "end_col_offset", None)
    if end_line is None or end_column is None:
        return None
    decorators = getattr(first, "decorator_list", ())
    first_line = min([first.lineno, *(decorator.lineno for decorator in decorators)])
    start, end = lines.start(first_line), lines.start(end_line + 1)
    before = b"" if decorators else lines.data[start : start + first.col_offset]
    after = lines.data[lines.start(end_line) + end_column : end]
    continued = lines.data[:start].rstrip(b"\r\n").endswith(b"\\") or after.rstrip().endswith(b"\\")
    return slice(start, end) if first_line > node.lineno and not before.strip() and not continued else None
