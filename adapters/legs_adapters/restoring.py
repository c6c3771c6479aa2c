"""Find a patch's calls in a file that was edited or formatted since, and put back what stood there before.

Words and signs are compared, then syntax trees: line ends, indentation, line breaks, quotes, and the commas and
brackets that formatters add make no difference.
"""

from __future__ import annotations

import ast
import re
from bisect import bisect_left
from typing import Callable, Iterator, List, Match, NamedTuple, Optional, Sequence, Set, Tuple

from legs_adapters.code.folders import first_of
from legs_adapters.code.limits import STRING, Budget
from legs_adapters.edit import why_not_compiled
from legs_adapters.journal import Layer
from legs_adapters.terms.text import apply_edits
from legs_adapters.terms.writing import PACKAGE

_TOKEN = re.compile(rf"(?P<string>\w*(?:{STRING}))|(?P<comment>#[^\r\n]*)|\w+".encode(), re.S)
_SIGN = re.compile(rb"\w+|[^\w\s]")
_WORD = re.compile(rb"\w+|[^\w\s(),;\\]")
_FREE = rb"[\s(),;\\]*"  # what formatters add, remove and move
_AROUND = (16, 4, 0)  # words on both sides that tell equal calls apart, as far as they are still there
_NAMED = re.compile(rf"\b{PACKAGE}\b".encode())
_CALLED = re.compile(rf"\b{PACKAGE}\s*\.\s*(?:l1_loss|masked|ssim|unweighted)\b".encode())


class _TooLongError(Exception):
    """The search takes more steps than a file may."""


class _Piece(NamedTuple):
    """One call or line that a patch wrote.

    Attributes:
        start, end: its bytes, in the patched file.
        before: the bytes from before.
        at: where these stood in the original.
    """

    start: int
    end: int
    before: bytes
    at: int


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
    patched = apply_edits(layer.original, layer.edits)
    code, now = _code(patched), _code(data)
    words, starts = [_spelled(word.group()) for word in _WORD.finditer(code)], [w.start() for w in _WORD.finditer(code)]
    every = list(_parts(layer, code, spend))
    parts = {part.start: part for part in every if _NAMED.search(code, part.start, part.end)}
    left = bytearray(now)  # without what is put back
    places: List[Tuple[int, int, _Piece]] = []
    for around in _AROUND:
        for part in parts.values():
            first, last = bisect_left(starts, part.start), bisect_left(starts, part.end)
            own = b"(?P<own>%s)" % _FREE.join(words[first:last])
            text = _FREE.join([*words[max(0, first - around) : first], own, *words[last : last + around]])
            spend((len(code) + len(now)) // 32 + len(text) // 2)
            pattern = re.compile(b"(?=%s)" % text)
            same = [parts.get(found.start("own")) for found in pattern.finditer(code)]
            if len({each and each.before for each in same}) == 1:  # else others, which are alike here, were different
                for found in pattern.finditer(now):
                    start, end = found.start("own"), _end(now, *found.span("own"), spend)
                    if _NAMED.search(left, start, end) and _is_same(data[start:end], patched[part.start : part.end]):
                        left[start:end] = b" " * (end - start)
                        places.append((start, end, part))
    at, newline = 0, b"\r\n" if b"\r\n" in data else b"\n"
    texts: List[bytes] = []
    for start, end, part in sorted(places):
        if not part.before.strip():
            start, end = _statement(data, start, end, spend)
        if start >= at:  # else within another one
            texts += [data[at:start], part.before.replace(b"\r\n", b"\n").replace(b"\n", newline)]
            at = end
    result = b"".join([*texts, data[at:]])
    weighted = [found.start() for found in _NAMED.finditer(left)]
    is_python = not why_not_compiled(result) or why_not_compiled(data)
    if len(every) == len(parts) and len(weighted) <= len(_NAMED.findall(_code(layer.original))) and is_python:
        return result, ""
    missing = {part.at for part in every if part.before}.difference(part.at for _, _, part in places)
    still, before = _lines(data, weighted), _lines(layer.original, sorted(missing))
    stays = f"stays weighted ({first_of(still, 20, '; ')}); put back {first_of(before, 20, '; ')}"
    return data, f"it was edited since, and {stays}"


def _parts(layer: Layer, code: bytes, spend: Callable[[int], None]) -> Iterator[_Piece]:
    """Yield what a patch wrote; edits within one call are one part."""
    shift = 0
    spans: List[Tuple[int, int, int, int]] = []  # of the parts, in the original and in the patched text
    for edit in layer.edits:
        here, was = edit.start + shift, edit.start
        begun, end = here + len(edit.after) - len(edit.after.lstrip()), here + len(edit.after.rstrip())
        shift += len(edit.after) - (edit.end - edit.start)
        if spans and here <= spans[-1][3]:
            was, _, begun, ended = spans.pop()
            end = max(end, ended)
        end = _end(code, begun, end, spend)
        spans.append((was, max(edit.end, end - shift), begun, end))
    for was, until, begun, end in spans:
        yield _Piece(begun, end, layer.original[was:until], was)


def _code(text: bytes) -> bytes:
    """Return a text with blanks in place of comments, and of what is in strings: a quote is left of each."""

    def hidden(found: Match[bytes]) -> bytes:
        kept = {"string": b'"', "comment": b""}.get(found.lastgroup or "", found.group())
        return kept.ljust(len(found.group()))

    return _TOKEN.sub(hidden, text)


def _spelled(word: bytes) -> bytes:
    """Return the pattern of a word or a sign."""
    pattern = rb"\b%s\b" % word if re.match(rb"\w", word) else re.escape(word)
    return b"(?i:%s)" % pattern if word[:1].isdigit() else pattern


def _end(code: bytes, start: int, end: int, spend: Callable[[int], None]) -> int:
    """Return where the expression from ``start`` ends that goes to ``end``, or to arguments right behind it."""
    depth, last = 0, start
    for found in _SIGN.finditer(code, start):
        is_called = found.group() == b"(" and b"\n" not in code[last : found.start()]
        if found.start() >= end and depth <= 0 and not is_called:
            break
        depth += (found.group() in b"([{") - (found.group() in b")]}")
        last = found.end()
    spend((last - start) // 4)
    return last


def _is_same(written: bytes, wanted: bytes) -> bool:
    """Return whether two texts are the same but for their formatting."""
    tree = _tree(written)
    is_equal = tree is not None and tree == _tree(wanted) and _comments(written) <= _comments(wanted)
    return written == wanted or is_equal


def _tree(text: bytes) -> Optional[str]:
    for each in (b"(%s\n)" % text, text):
        try:
            return ast.dump(ast.parse(each))
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            continue
    return None


def _comments(text: bytes) -> Set[bytes]:
    return {found.group().strip(b"# \t") for found in _TOKEN.finditer(text) if found.lastgroup == "comment"}


def _statement(text: bytes, start: int, end: int, spend: Callable[[int], None]) -> Tuple[int, int]:
    """Return the span of a statement with its line, or on a line with others with its semicolon."""
    line, behind = text.rfind(b"\n", 0, start) + 1, text.find(b"\n", end) + 1 or len(text)
    spend((behind - line) // 64)
    head, tail = text[line:start], text[end:behind]
    if not (head + tail).strip():
        return line, behind
    if tail.lstrip().startswith(b";"):
        return start, behind - len(tail.lstrip()[1:].lstrip(b" \t"))
    return (line + len(head.rstrip()) - 1 if head.rstrip().endswith(b";") else start), end


def _lines(text: bytes, places: Sequence[int]) -> List[str]:
    """Return the lines of these bytes of a text, each with its number."""
    lines, breaks = text.split(b"\n"), [found.start() for found in re.finditer(b"\n", text)]
    numbers = [bisect_left(breaks, at) for at in places]
    return [f"line {at + 1}: {lines[at][:400].decode('utf-8', 'ignore').strip()[:200]}" for at in numbers]


def weighted_lines(data: bytes) -> List[str]:
    """Return the lines of a file that name a function of legs_loss which a patch writes, each with its number."""
    return list(dict.fromkeys(_lines(data, [found.start() for found in _CALLED.finditer(_code(data))])))
