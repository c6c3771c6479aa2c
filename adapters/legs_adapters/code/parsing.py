"""Parse a file by Python's own parser, and tell where its nodes stand.

Trees are the same for every Python: literals are ``ast.Constant``, an index is an expression, a slice or a tuple of
these, and nodes know where they end.
"""

from __future__ import annotations

import ast
import bisect
import itertools
import keyword
import re
import sys
import warnings
from typing import Any, List, NamedTuple, Tuple

from legs_adapters.code.limits import STRING, remembered
from legs_adapters.code.syntax import FUNCTIONS, children

_NEWLINE = re.compile(rb"\r\n|\r|\n")
_TOKEN = re.compile(rf"\#[^\r\n]*|({STRING}|[\w\x80-\xff]+|\*\*|[^\s\\])".encode(), re.S)  # a group, but for a comment


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

    def code(self, node: Any, brackets: bool = False) -> str:
        """Return the text of a node, on request with the brackets around it."""
        place = self.place(node, brackets)
        return self.data[place.start : place.end].decode("utf-8", "replace")

    def place(self, node: Any, brackets: bool = False) -> Place:
        """Return the place of a node, on request with the brackets around it."""
        start = self.start(node.lineno) + node.col_offset
        end = self.start(node.end_lineno) + node.end_col_offset
        start, end = self._with_brackets(start, end) if brackets else (start, end)
        line, last = bisect.bisect_right(self._starts, start), bisect.bisect_left(self._starts, end)
        return Place(start, end, line, start - self._starts[line - 1], max(line, last))

    def _with_brackets(self, start: int, end: int) -> Tuple[int, int]:
        """Return the span of what stands there with the brackets around it, but for those of a call."""
        starts, texts = self._tokens()
        first, last = bisect.bisect_left(starts, start), bisect.bisect_left(starts, end) - 1
        while texts[first - 1 : first] == ["("] and texts[last + 1 : last + 2] == [")"]:
            before = texts[first - 2] if first > 1 else "="
            if (before[-1:] in "\"')]}" or before.isidentifier()) and not keyword.iskeyword(before):
                break
            first, last = first - 1, last + 1
            start, end = starts[first], starts[last] + 1
        return start, end

    def keyword_start(self, brackets: int, value: int) -> int:
        """Return where the keyword of an argument begins: of a value at a byte, in a call's brackets at another."""
        return [match.start() for match in _TOKEN.finditer(self.data, brackets, value) if match.group(1)][-2]

    @remembered
    def _tokens(self) -> Tuple[List[int], List[str]]:
        """Return where the tokens begin, and their texts. Of `tokenize` each Python has another, some slow or wrong."""
        found = [match for match in _TOKEN.finditer(self.data) if match.group(1)]
        return [match.start() for match in found], [match.group().decode("utf-8") for match in found]

    def byte(self, line: int, letter: int) -> int:
        """Return the byte at which a letter of a line begins."""
        return self._letters(line)[letter]

    @remembered
    def _letters(self, line: int) -> List[int]:
        start = self.start(line)
        letters = self.data[start : self.start(line + 1)].decode("utf-8")
        return list(itertools.accumulate([start, *(len(letter.encode("utf-8")) for letter in letters)]))

    def tree(self) -> ast.Module:
        """Parse the file.

        Raises:
            SyntaxError, ValueError, RecursionError, MemoryError: it does not parse.
        """
        tree = read_by_python(self.data.decode("utf-8"))
        if not isinstance(tree, ast.Module):
            raise tree
        if sys.version_info < (3, 10):
            _modernised(tree, self)
        nodes: List[Any] = [tree]
        for node in nodes:  # which grows
            node.source = self
            nodes += children(node)
        return tree


def read_by_python(text: bytes | str, flags: int = ast.PyCF_ONLY_AST) -> Any:
    """Return a text as this Python parses or compiles it, or the error: it is newer, or deeper than its parser goes."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return compile(text, "file", "exec", flags, dont_inherit=True)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        return error


def _modernised(tree: ast.Module, lines: Lines) -> None:
    """Make of a tree of an older Python one of 3.10."""
    values = {"Num": "n", "Str": "s", "Bytes": "s", "NameConstant": "value", "Ellipsis": "value"}
    if sys.version_info < (3, 8):
        _with_ends(tree, lines)
    for node in list(ast.walk(tree)):
        kind = type(node).__name__
        if kind in values:
            value = getattr(node, values[kind], ...)
            node.__class__ = ast.Constant
            node.value = value  # type: ignore[attr-defined]
        for part in ast.iter_child_nodes(node):
            if isinstance(part, (ast.alias, ast.keyword)):
                ast.copy_location(part, getattr(part, "value", node))
        if isinstance(node, ast.Subscript):
            parts = getattr(node.slice, "dims", [node.slice])
            plain = [part.value if type(part).__name__ == "Index" else part for part in parts]
            node.slice = plain[0] if len(plain) == 1 else ast.Tuple(plain, ast.Load())


def _with_ends(tree: ast.Module, lines: Lines) -> None:
    """Let the nodes of a tree of Python 3.7 know where they begin and end, as those of later Pythons do."""
    from asttokens import ASTTokens

    text = re.sub("\r(?!\n)", "\n", lines.data.decode("utf-8")).rstrip(" \t\f\r\n\\")  # it reads neither
    marked = ASTTokens(text, tree=tree)
    for node in ast.walk(tree):
        first, last = vars(node)["first_token"], vars(node)["last_token"]
        for child in ast.iter_child_nodes(node):  # what is in an f-string has no tokens of its own
            vars(child).setdefault("first_token", first)
            vars(child).setdefault("last_token", last)
        while isinstance(node, (*FUNCTIONS, ast.ClassDef)) and first.string not in ("def", "class", "async"):
            first = marked.next_token(first)  # a decorator
        if hasattr(node, "lineno"):
            for name, (line, letter) in (("", first.start), ("end_", last.end)):
                setattr(node, f"{name}lineno", line)
                setattr(node, f"{name}col_offset", lines.byte(line, letter) - lines.start(line))
