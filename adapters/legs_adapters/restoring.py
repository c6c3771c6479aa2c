"""Find a patch's calls in a file that was edited or formatted since, and put back what stood there before.

Words and signs are compared, then syntax trees: line ends, indentation, line breaks, quotes, and the commas and
brackets that formatters add make no difference.
"""

from __future__ import annotations

import ast
import bisect
import re
from typing import Callable, Dict, Iterator, List, NamedTuple, Optional, Set, Tuple

from legs_adapters.code.folders import first_of
from legs_adapters.code.limits import STRING, Budget
from legs_adapters.edit import why_not_compiled
from legs_adapters.journal import Layer
from legs_adapters.terms.text import apply_edits
from legs_adapters.terms.writing import PACKAGE

_TOKEN = re.compile(rf"(?P<string>\w*{STRING})|(?P<comment>#[^\r\n]*)|\w+|[^\w\s]", re.S)
_FREE = frozenset("(),;\\")  # what formatters add, remove and move
_AROUND = (16, 4, 0)  # words on both sides that tell equal calls apart, as far as they are still there
_WRITTEN = frozenset(("l1_loss", "masked", "ssim", "unweighted"))  # the functions of legs_loss that a patch calls
_UTF8 = ("utf-8", "surrogateescape")


class _TooLongError(Exception):
    """The search takes more steps than a file may."""


class _Words:
    """A text as words and signs, without comments and those of `_FREE`; ``weighted``: which are the package's name.

    ``spend`` is told the steps of each search in it.
    """

    def __init__(self, text: str, spend: Callable[[int], None] = lambda steps: None) -> None:
        self.text, self.spend = text, spend
        self.newline = "\r\n" if "\r\n" in text else "\n"
        self._breaks = [found.start() for found in re.finditer("\n", text)]
        self.words: List[str] = []
        self.starts: List[int] = []
        self.ends: List[int] = []
        for found in _TOKEN.finditer(text):
            word = found.group()
            if word not in _FREE and found.lastgroup != "comment":
                is_value = found.lastgroup == "string" or word[0].isdigit()
                self.words.append(word.lower().replace("'", '"') if is_value else word)
                self.starts.append(found.start())
                self.ends.append(found.end())
        self.weighted = [at for at, word in enumerate(self.words) if word == PACKAGE]

    def end(self, start: int, end: int) -> int:
        """Return where the expression from ``start`` ends that goes to ``end``, or to arguments right behind it."""
        depth, last = 0, start
        for found in _TOKEN.finditer(self.text, start):
            word = found.group()
            is_called = word == "(" and "\n" not in self.text[last : found.start()]
            if found.start() >= end and depth <= 0 and not is_called:
                break
            if found.lastgroup != "comment":
                depth += (word in ("(", "[", "{")) - (word in (")", "]", "}"))
                last = found.end()
        self.spend((last - start) // 4)
        return last

    def line(self, at: int) -> str:
        """Return the line of a character, with its number."""
        number = bisect.bisect_left(self._breaks, at)
        start = self._breaks[number - 1] + 1 if number else 0
        return f"line {number + 1}: {self.text[start : start + 400].partition(chr(10))[0].strip()[:200]}"


class _Part(NamedTuple):
    """One call or line that a patch wrote.

    Attributes:
        first, last: its words, in the patched text.
        anchor: the first of them that is the package's name.
        before: the text from before.
        line: its line from before, with its number.
    """

    first: int
    last: int
    anchor: int
    before: str
    line: str


def restored(name: str, layer: Layer, data: bytes, budget: Budget) -> Tuple[bytes, str]:
    """Put back what stood before a patch in place of what it wrote, everywhere or nowhere; other edits stay.

    Args:
        name: the file, on whose account in ``budget`` the search is.
        layer: the patch.
        data: the file's bytes now.

    Returns:
        The file's bytes; and "", or why they are those of now: what is weighted still, and the lines from before.
    """

    def spend(steps: int) -> None:
        if budget.spend(name, steps):
            raise _TooLongError

    try:
        return _restored(layer, data, spend)
    except _TooLongError:
        return data, "it was edited since, and looking for the patched lines takes too long: restore it from git"


def _restored(layer: Layer, data: bytes, spend: Callable[[int], None]) -> Tuple[bytes, str]:
    spend((2 * len(layer.original) + len(data)) // 8 + len(layer.edits))
    three = layer.original, apply_edits(layer.original, layer.edits), data
    original, patched, now = (_Words(text.decode(*_UTF8), spend) for text in three)
    every = list(_parts(layer, original, patched))
    parts = {part.anchor: part for part in every if part.anchor >= 0}
    places: List[Tuple[int, int, str]] = []
    covered: Dict[int, Optional[_Part]] = {}  # words of the file now
    for around in _AROUND:
        for part in parts.values():
            ahead, size = min(around, part.first) + part.anchor - part.first, part.last - part.first + 2 * around
            key = patched.words[part.anchor - ahead : part.anchor - ahead + size]
            spend((len(patched.weighted) + len(now.weighted)) * (1 + size // 64))
            same = [parts.get(at) for at in patched.weighted if patched.words[at - ahead : at - ahead + size] == key]
            if len({each and each.before for each in same}) == 1:  # else others, which are alike here, were different
                for at in now.weighted:
                    if at >= ahead and at not in covered and now.words[at - ahead : at - ahead + size] == key:
                        places += _places(part, patched, now, at, covered)
    left = [at for at in now.weighted if at not in covered]
    at = 0
    texts: List[str] = []
    for start, end, before in sorted(places):
        if start >= at:  # else within another one
            texts += [now.text[at:start], before]
            at = end
    result = "".join([*texts, now.text[at:]]).encode(*_UTF8)
    is_python = not why_not_compiled(result) or why_not_compiled(data)
    if len(every) == len(parts) and len(left) <= len(original.weighted) and is_python:
        return result, ""
    still = first_of([now.line(now.starts[at]) for at in left], 20, "; ")
    missing = [part.line for part in every if part.before and part not in covered.values()]
    return data, f"it was edited since, and stays weighted ({still}); put back {first_of(missing, 20, '; ')}"


def _parts(layer: Layer, original: _Words, patched: _Words) -> Iterator[_Part]:
    """Yield what a patch wrote; edits within one call are one part."""
    at = was = here = 0  # in the original: bytes, characters; in the patched text: characters
    spans: List[Tuple[int, int, int, int]] = []  # of the parts, in both texts
    for edit in layer.edits:
        gap = len(layer.original[at : edit.start].decode(*_UTF8))
        was, here, at = was + gap, here + gap, edit.end
        before, after = edit.before.decode(*_UTF8), edit.after.decode(*_UTF8)
        start = here + len(after) - len(after.lstrip())
        if spans and here <= spans[-1][3]:
            first, begun, last, ended = spans.pop()
            end = patched.end(begun, max(ended, here + len(after.rstrip())))
        else:
            first, begun, end = was, start, patched.end(start, here + len(after.rstrip()))
        was, here = was + len(before), here + len(after)
        spans.append((first, begun, was + max(0, end - here), end))
    for first, begun, last, end in spans:
        i, j = bisect.bisect_left(patched.starts, begun), bisect.bisect_left(patched.starts, end)
        anchor = next((word for word in range(i, j) if patched.words[word] == PACKAGE), -1)
        if anchor >= 0 and begun != patched.starts[i]:
            anchor = -1
        yield _Part(i, j, anchor, original.text[first:last], original.line(first))


def _places(
    part: _Part, patched: _Words, now: _Words, at: int, covered: Dict[int, Optional[_Part]]
) -> Iterator[Tuple[int, int, str]]:
    """Yield the span that a part has now, and the text from before, if it is the same but for its formatting."""
    first = at - part.anchor + part.first
    last = first + part.last - part.first
    (start, end), (begun, ended) = (
        (words.starts[i], words.end(words.starts[i], words.ends[j - 1]))
        for words, i, j in ((now, first, last), (patched, part.first, part.last))
    )
    written, wanted = now.text[start:end], patched.text[begun:ended]
    tree = _tree(written)
    if written != wanted and (tree is None or tree != _tree(wanted) or not _comments(written) <= _comments(wanted)):
        return
    covered.update((word, part) for word in range(first, last))
    before = part.before.replace("\r\n", "\n")
    if not before.strip():  # a line of its own, or before or behind a semicolon
        line, behind = now.text.rfind("\n", 0, start) + 1, now.text.find("\n", end) + 1 or len(now.text)
        now.spend((behind - line) // 64)
        head, tail = now.text[line:start], now.text[end:behind]
        if not head.strip() and not tail.strip():
            start, end = line, behind
        elif tail.lstrip().startswith(";"):
            end += len(tail) - len(tail.lstrip()[1:].lstrip(" \t"))
        elif head.rstrip().endswith(";"):
            start = line + len(head.rstrip()) - 1
    yield start, end, before.replace("\n", now.newline)


def _tree(text: str) -> Optional[str]:
    for code_ in (f"({text}\n)", text):
        try:
            return ast.dump(ast.parse(code_))
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            continue
    return None


def _comments(text: str) -> Set[str]:
    found = _TOKEN.finditer(text)
    return {each.group().strip("# \t") for each in found if each.lastgroup == "comment"}


def weighted_lines(text: str) -> List[str]:
    """Return the lines of a file that name a function of legs_loss which a patch writes, each with its number."""
    found = _Words(text)
    members = [at for at in found.weighted if found.words[at + 1 : at + 2] == ["."]]
    written = [at for at in members if _WRITTEN.intersection(found.words[at + 2 : at + 3])]
    return list(dict.fromkeys(found.line(found.starts[at]) for at in written))
