"""Bound what a stranger's code may cost: a budget of steps, and limits of what a parser's stack holds.

What is over is one line of the report, unread, and the rest of the checkout is planned. A step is a node of a syntax
tree that is looked at; a word, sign or line end that is parsed costs twenty. A step takes some 2 microseconds and at
most 200 bytes. Steps are counted, so the result does not depend on the machine or its load.
"""

from __future__ import annotations

import re
from typing import Dict, List, Mapping, Set

__all__ = [
    "MAX_BYTES",
    "MAX_FILE_BYTES",
    "Budget",
    "largest_over",
    "over_the_limits",
    "parsing_steps",
    "too_deep",
]

MAX_FILE_BYTES = 1 << 20
MAX_BYTES = 32 << 20  # of all files
MAX_FILE_STEPS = 3_000_000
MAX_STEPS = 40_000_000  # of all files
MAX_BRACKETS = 150  # in one another; Python itself refuses 200
MAX_BLOCKS = 100  # in one another; as Python
MAX_PARTS = 2000  # of one expression: operators, calls, attributes, strings in a row, `elif` in a row

_TOKEN_STEPS = 20
_LAMBDA = 3  # parts: LibCST's parser takes memory quadratic in lambdas in one another, 200 MB for 1,000
_WHY_OVER = f"its analysis takes more than {MAX_FILE_STEPS} steps"
_PIECE = re.compile(r"\w+|[^\w\s]|\n")
_NO_BRACKETS = bytes(set(range(256)) - set(b"()[]{}"))
_STRING = r"""\'\'\'(?:[^\\]|\\.)*?\'\'\'|\"\"\"(?:[^\\]|\\.)*?\"\"\"|'(?:[^'\\\n]|\\.)*'|"(?:[^"\\\n]|\\.)*\""""
_TOKEN = re.compile(
    rf"(?P<string>{_STRING})|\#[^\n]*|\\\r?\n|(?P<end>[\r\n]+)|(?P<open>[(\[{{])|(?P<close>[)\]}}])|(?P<comma>,)|(?P<semi>;)"
    r"|\b(?P<lambda>lambda)\b|\b(?P<word>if|else|and|or|not|in|is|await|for|yield)\b|(?P<signs>[-+*/%@&|^~<>=!.]+)",
    re.S,
)
_FIELD = re.compile(r"\{[^{}]*\}")
_LINE = re.compile(r"^([ \t]*)(elif\b|else\b|[^\s#])", re.M)


def too_deep(data: bytes) -> str:
    """Return why a file's brackets are too deep for any parser, or "": by the brackets alone, in strings too."""
    brackets = data.translate(None, _NO_BRACKETS)
    for _ in range(MAX_BRACKETS):
        inner = brackets.replace(b"()", b"").replace(b"[]", b"").replace(b"{}", b"")
        if len(inner) == len(brackets):
            # Unpaired brackets, in strings for example, are shallow unless many open in a row.
            runs = re.findall(rb"[(\[{]+", brackets)
            return _DEEP if max(map(len, runs), default=0) > MAX_BRACKETS else ""
        brackets = inner
    return _DEEP if brackets else ""


_DEEP = f"brackets are nested more than {MAX_BRACKETS} deep"


class Budget:
    """The steps that the analysis of one checkout takes, each file's on its own account."""

    def __init__(self) -> None:
        self._spent: Dict[str, int] = {}
        self._together = 0

    def spend(self, path: str, steps: int) -> str:
        """Count steps of a file; return why it may take no more, or ""."""
        self._spent[path] = self._spent.get(path, 0) + steps
        self._together += steps
        return _WHY_OVER if self._spent[path] > MAX_FILE_STEPS else ""

    def left(self, path: str) -> int:
        """Return how many steps a file may still take."""
        return MAX_FILE_STEPS - self._spent.get(path, 0)

    def why_none_left(self) -> str:
        """Return why no further file is read, or ""; what was read before stays."""
        if self._together <= MAX_STEPS:
            return ""
        return f"all files together take more than {MAX_STEPS} steps: leave others out by --exclude"


def parsing_steps(text: str) -> int:
    """Return the steps of parsing a text: by words, signs and line ends, in strings and comments too."""
    return _TOKEN_STEPS * len(_PIECE.findall(text))


def largest_over(sizes: Mapping[str, int], most: int) -> Set[str]:
    """Return the largest files, without which the others have at most this total size."""
    over: Set[str] = set()
    total = sum(sizes.values())
    for path in sorted(sizes, key=lambda path: (-sizes[path], path)):
        if total <= most:
            break
        total -= sizes[path]
        over.add(path)
    return over


def over_the_limits(text: str) -> str:
    """Return why a file is not parsed, or "": it is too long, or its blocks or an expression are too deep."""
    if _TOKEN_STEPS * len(text) > MAX_FILE_STEPS and parsing_steps(text) > MAX_FILE_STEPS:
        return _WHY_OVER
    return _blocks(text) or (f"an expression of more than {MAX_PARTS} parts" if _longest(text) > MAX_PARTS else "")


def _longest(text: str) -> int:
    """Return an upper bound of the parts that are nested in one another in any expression.

    Parts between commas are not nested in one another, except for lambda bodies; parts in brackets are nested in the
    expression before them.
    """
    longest, before, here = 0, [], [0, 0]  # of a bracket: since its last comma, its lambdas
    outer = 0
    for found in _TOKEN.finditer(text):
        kind = found.lastgroup
        if kind == "string":
            here[0] += 1 + max((len(field) // 2 for field in _FIELD.findall(found.group())), default=0)
        elif kind == "word":
            here[0] += 1
        elif kind == "signs":
            here[0] += len(found.group())
        elif kind == "lambda":
            here[1] += _LAMBDA
        elif kind == "open":
            here[0] += 1
            before.append(here)
            outer += sum(here)
            here = [0, 0]
        elif kind == "close" and before:
            here = before.pop()
            outer -= sum(here)
        elif kind == "comma":
            here[0] = 0
        elif (kind == "end" and not before) or kind == "semi":
            before, outer, here = [], 0, [0, 0]
        else:
            continue
        longest = max(longest, outer + sum(here))
    return longest


def _blocks(text: str) -> str:
    """Return which limit on blocks is exceeded, from the indentation of lines."""
    columns: List[int] = []  # of the blocks that a line is in
    branches: Dict[int, int] = {}  # `elif` in a row, by column
    for found in _LINE.finditer(text):
        column, word = len(found.group(1).expandtabs()), found.group(2)
        while columns and columns[-1] >= column:
            branches.pop(columns.pop(), None) if columns[-1] > column else columns.pop()
        columns.append(column)
        if len(columns) > MAX_BLOCKS:
            return f"blocks are nested more than {MAX_BLOCKS} deep"
        branches[column] = branches.get(column, 0) + 1 if word == "elif" else branches.get(column, 0) * (word == "else")
        if branches[column] > MAX_PARTS:
            return f"more than {MAX_PARTS} elif in a row"
    return ""
