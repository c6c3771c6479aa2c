"""Bound what a stranger's code may cost: a budget of steps, and limits of what a parser's stack holds.

What is over is one line of the report, unread, and the rest of the checkout is planned. A step is a node of a syntax
tree that is looked at; a word, sign or line end that is parsed costs six. A step takes some 2 microseconds and at
most 200 bytes. Steps are counted, so the result does not depend on the machine or its load.
"""

from __future__ import annotations

import functools
import re
from collections import Counter
from typing import Any, Callable, List, Optional, TypeVar

MAX_FILE_BYTES = 1 << 20
MAX_BYTES = 32 << 20  # of all files
MAX_FILE_STEPS = 3_000_000
MAX_STEPS = 40_000_000  # of all files
MAX_BRACKETS = 150  # in one another; Python itself refuses 200
MAX_PARTS = 2000  # of one expression: operators, calls, attributes, strings in a row; `elif` in a file

_TOKEN_STEPS = 6
_WHY_OVER = f"its analysis takes more than {MAX_FILE_STEPS} steps"
_PIECE = re.compile(r"\w+|[^\w\s]|\n")
# One that does not end goes to the end of the file or line: looking for an end from each quote would be quadratic.
STRING = "|".join(
    [rf"{quotes}(?:[^\\]|\\.?)*?(?:{quotes}|\Z)" for quotes in ("'''", '"""')]
    + [rf"{quote}(?:[^{quote}\\\n]|\\.?)*{quote}?" for quote in "'\""]
)
_TOKEN = re.compile(
    rf"(?P<string>{STRING})|\#[^\n]*|\\\r?\n|(?P<end>[\r\n;]+)|(?P<open>[(\[{{])|(?P<close>[)\]}}])|(?P<comma>,)"
    r"|(?P<word>if|else|and|or|not|in|is|await|for|yield)\b|\w+|(?P<signs>[-+*/%@&|^~<>=!.]+)",
    re.S,
)
_FIELD = re.compile(r"\{[^{}]*\}")
_Method = TypeVar("_Method", bound=Callable[..., Any])


def remembered(method: _Method) -> _Method:
    """Let an object answer each question to a method once, and keep the answer, by its positional arguments."""
    name = f"_known {method.__name__}"

    @functools.wraps(method)
    def ask(self: Any, *question: Any) -> Any:
        known = vars(self).setdefault(name, {})
        if question not in known:
            known[question] = method(self, *question)
        return known[question]

    return ask  # type: ignore[return-value]


class Budget:
    """The steps that the analysis of one checkout takes, each file's on its own account.

    Args:
        beside: that of a checkout around it, which the steps count to, too.
    """

    def __init__(self, beside: Optional[Budget] = None) -> None:
        self._spent: Counter[str] = Counter()
        self._of_all: List[int] = [0] if beside is None else beside._of_all

    def spend(self, path: str, steps: int) -> str:
        """Count steps of a file; return why it may take no more, or ""."""
        self._spent[path] += steps
        self._of_all[0] += steps
        return _WHY_OVER if self._spent[path] > MAX_FILE_STEPS else ""

    def left(self, path: str) -> int:
        """Return how many steps a file may still take."""
        return MAX_FILE_STEPS - self._spent[path]

    def why_none_left(self) -> str:
        """Return why no further file is read, or ""; what was read before stays."""
        if self._of_all[0] <= MAX_STEPS:
            return ""
        return f"all files together take more than {MAX_STEPS} steps: leave others out by --exclude"


def parsing_steps(text: str) -> int:
    """Return the steps of parsing a text: by words, signs and line ends, in strings and comments too."""
    return _TOKEN_STEPS * len(_PIECE.findall(text))


def over_the_limits(text: str) -> str:
    """Return why a file is not parsed, or "": it is too long, or an expression is too deep. Parsers count blocks."""
    if _TOKEN_STEPS * len(text) > MAX_FILE_STEPS and parsing_steps(text) > MAX_FILE_STEPS:
        return _WHY_OVER
    if text.count("elif") > MAX_PARTS:
        return f"more than {MAX_PARTS} elif"
    return _why_too_deep(text)


def _why_too_deep(text: str) -> str:
    """Return why an expression is nested too deeply, or "": by an upper bound of its parts.

    Parts between commas are not nested in one another; parts in brackets are nested in the expression before them.
    """
    here, outside = 0, 0  # parts since the last comma: in the innermost brackets, and in all around
    around: List[int] = []
    for found in _TOKEN.finditer(text):
        kind = found.lastgroup
        if kind in ("signs", "word"):
            here += len(found.group()) if kind == "signs" else 1
        elif kind == "comma" or (kind == "end" and not around):
            here = 0
        elif kind == "open":
            around.append(here + 1)
            here, outside = 0, outside + here + 1
            if len(around) > MAX_BRACKETS:
                return f"brackets are nested more than {MAX_BRACKETS} deep"
        elif kind == "close" and around:
            here = around.pop()
            outside -= here
        elif kind == "string":
            here += 1 + max((len(field) // 2 for field in _FIELD.findall(found.group())), default=0)
        if outside + here > MAX_PARTS:
            return f"an expression of more than {MAX_PARTS} parts"
    return ""
