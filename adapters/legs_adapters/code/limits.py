"""Limits of what is planned: a file over them is reported as not read, and the rest of the checkout is planned.

They are checked on the text, before it is parsed: deep code may crash a parser, and the walk of a long expression takes
time quadratic in its parts. So the result does not depend on the machine or its load.

LibCST takes up to 4 KB and 40 microseconds for each word, sign and line end. The maxima in 251 checkouts: 41,000 of
them in a file, 693,000 in a checkout, whose Python files have 2.7 MB; of ``ASKED`` 439,000, and 916,000 together.
"""

from __future__ import annotations

import re
from typing import Dict, List, Mapping, Set

__all__ = [
    "ASKED",
    "ASKED_TOGETHER",
    "LARGEST",
    "ONE",
    "READ",
    "TOGETHER",
    "largest_over",
    "over_the_limits",
    "pieces",
    "too_deep",
]

LARGEST = 1 << 20  # bytes of a file
READ = 32 << 20  # bytes of all files
ONE = 250_000  # words, signs and line ends of a file
TOGETHER = 2_000_000  # of all files
ASKED = 2_000_000  # of a function, times the places in it that speak of an L1: each is asked about all of it
ASKED_TOGETHER = 20_000_000  # of all functions
DEEPEST = 150  # brackets in brackets; Python itself refuses 200
BLOCKS = 100  # in blocks; as Python
PARTS = 2000  # of one expression: operators, calls, attributes, strings in a row, `elif` in a row
INNER = 200  # functions in one function

_PIECE = re.compile(r"\w+|[^\w\s]|\n")
_NO_BRACKETS = bytes(set(range(256)) - set(b"()[]{}"))
_STRING = r"""\'\'\'(?:[^\\]|\\.)*?\'\'\'|\"\"\"(?:[^\\]|\\.)*?\"\"\"|'(?:[^'\\\n]|\\.)*'|"(?:[^"\\\n]|\\.)*\""""
_TOKEN = re.compile(
    rf"(?P<string>{_STRING})|\#[^\n]*|\\\r?\n|(?P<end>[\r\n]+)|(?P<open>[(\[{{])|(?P<close>[)\]}}])|(?P<comma>,)|(?P<semi>;)"
    r"|\b(?P<lambda>lambda)\b|\b(?P<word>if|else|and|or|not|in|is|await|for|yield)\b|(?P<signs>[-+*/%@&|^~<>=!.]+)",
    re.S,
)
_FIELD = re.compile(r"\{[^{}]*\}")
_LINE = re.compile(r"^([ \t]*)(elif\b|else\b|(?:async[ \t]+)?def\b|[^\s#])", re.M)


def too_deep(data: bytes) -> str:
    """Return why a file's brackets are too deep for any parser, or "": by the brackets alone, in strings too."""
    brackets = data.translate(None, _NO_BRACKETS)
    for _ in range(DEEPEST):
        inner = brackets.replace(b"()", b"").replace(b"[]", b"").replace(b"{}", b"")
        if len(inner) == len(brackets):
            # Unpaired brackets, in strings for example, are shallow unless many open in a row.
            runs = re.findall(rb"[(\[{]+", brackets)
            return _DEEP if max(map(len, runs), default=0) > DEEPEST else ""
        brackets = inner
    return _DEEP if brackets else ""


_DEEP = f"brackets are nested more than {DEEPEST} deep"


def pieces(text: str) -> int:
    """Count words, signs and line ends, in strings and comments too: they determine the cost of parsing."""
    return len(_PIECE.findall(text))


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
    """Return why the code of a file is not analysed, or "" where it is within the limits."""
    if len(text) > ONE and pieces(text) > ONE:
        return f"more than {ONE} words and signs"
    return _blocks(text) or (f"an expression of more than {PARTS} parts" if _longest(text) > PARTS else "")


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
            here[1] += 1
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
    functions: List[int] = []  # the columns of `def` that a line is in
    inner = 0
    for found in _LINE.finditer(text):
        column, word = len(found.group(1).expandtabs()), found.group(2)
        while columns and columns[-1] >= column:
            branches.pop(columns.pop(), None) if columns[-1] > column else columns.pop()
        columns.append(column)
        if len(columns) > BLOCKS:
            return f"blocks are nested more than {BLOCKS} deep"
        branches[column] = branches.get(column, 0) + 1 if word == "elif" else branches.get(column, 0) * (word == "else")
        if branches[column] > PARTS:
            return f"more than {PARTS} elif in a row"
        while functions and functions[-1] >= column:
            functions.pop()
        if word.endswith("def"):
            inner = inner + 1 if functions else 0
            functions.append(column)
            if inner > INNER:
                return f"more than {INNER} functions in one function"
    return ""
