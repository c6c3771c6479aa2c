"""Read and replace spans of a file's text; keep the comments and line breaks between two nodes."""

from __future__ import annotations

import ast
import re
from typing import NamedTuple, Sequence, Tuple

from legs_adapters.code.limits import STRING
from legs_adapters.code.module import Function, Module
from legs_adapters.code.sources import Source
from legs_adapters.code.syntax import Arg, code, given

_GAP = re.compile(rf"({STRING})|(?:\s|\\(?=[\r\n])|#[^\r\n]*)+", re.S)  # no comment begins in a string
_COMMENT_OR_BREAK = re.compile(rf"({STRING})|((?:(?<![ \t])[ \t]+)?#[^\r\n]*|\\?(?:\r\n|\r|\n)[ \t]*)", re.S)


class Edit(NamedTuple):
    """Bytes from ``start`` to ``end`` of a file (its byte order mark counted) become ``after``."""

    start: int
    end: int
    after: bytes


def apply_edits(data: bytes, edits: Sequence[Edit]) -> bytes:
    """Return the file's bytes with the edits made; a ValueError says that one is in another."""
    parts, at = [], 0
    for edit in sorted(edits):
        if edit.start < at:
            raise ValueError("one term is in another: weight the inner one by hand")
        parts += [data[at : edit.start], edit.after]
        at = edit.end
    return b"".join([*parts, data[at:]])


class Text:
    """A file's bytes, and the positions of one function's nodes."""

    def __init__(self, source: Source, function: Function) -> None:
        self.source = source
        self.function = function
        self.module: Module = function.module
        self.bytes: bytes = self.module.lines.data
        self._shift = len(source.data) - len(self.bytes)  # a byte order mark

    def span(self, node: ast.AST, brackets: bool = False) -> Tuple[int, int]:
        """Return where a node begins and ends, on request with the brackets around it."""
        place = self.function.place(node, brackets)
        return place.start, place.end

    def between(self, start: int, end: int) -> str:
        """Return the text of a span of bytes."""
        return self.bytes[start:end].decode("utf-8")

    def argument_span(self, call: ast.Call, at: int) -> Tuple[int, int]:
        """Return where an argument of a call begins and ends, its keyword included."""
        value, keyword, _ = given(call)[at]
        start, end = self.span(value, True)
        return self.module.lines.keyword_start(self.span(call.func)[1], start) if keyword else start, end

    def replace(self, start: int, end: int, after: str) -> Edit:
        """Return the edit that replaces a span of bytes by a text."""
        return Edit(start + self._shift, end + self._shift, after.encode("utf-8"))

    def argument(self, node: ast.expr, index: str) -> str:
        """Return an image as written, without the index that it carries."""
        if not index or not isinstance(node, ast.Subscript):
            return code(node, True)
        return code(node.value, True) + residue(self.between(self.span(node.value, True)[1], self.span(node)[1]))


def names_for_two(text: str) -> Tuple[str, str]:
    """Return two names for a lambda's parameters that a text does not use."""
    used = set(re.findall(r"\w+", text))
    pairs = [("a", "b"), ("prediction", "target"), ("prediction_", "target_")]
    return next((pair for pair in pairs if not used & set(pair)), ("_prediction", "_target"))


def flat(arg: Arg) -> str:
    """Return an argument on one line, with its keyword or stars."""
    value = on_one_line(code(arg.value, True))
    return f"{arg.keyword}={value}" if arg.keyword else f"{arg.star}{value}"


def on_one_line(text: str) -> str:
    """Return an expression on one line, without its comments."""
    return _GAP.sub(lambda gap: gap.group(1) or " ", text).strip()


def residue(text: str) -> str:
    """Return what is kept of a text that is removed: its comments and its line breaks."""
    return "".join(part for _, part in _COMMENT_OR_BREAK.findall(text))
