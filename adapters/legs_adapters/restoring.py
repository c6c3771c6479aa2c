"""Find what a patch wrote in a file that was edited or formatted since, and put back what stood there before.

Line ends, indentation, line breaks, quotes, and a comma at the end of a line before a bracket make no difference.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from typing import Dict, List, Sequence, Tuple

from legs_adapters.code.folders import first_of
from legs_adapters.code.limits import STRING, Budget
from legs_adapters.edit import why_not_compiled
from legs_adapters.journal import Layer
from legs_adapters.terms.writing import PACKAGE

_TOKEN = re.compile(rf"#[^\r\n]*|\w*(?:{STRING})|\w+|[^\w\s\\]".encode(), re.S)
_LAST_COMMA = re.compile(rb",(?=[^\S\n]*\n\s*[)\]}])")
_FREE, _COMMA = rb"[\s\\]*", rb"(?:,[^\S\n]*\n\s*)?"  # what formatters add, remove and move
_REST_OF_LINE = re.compile(rb"[ \t]*(?:\r?\n|\Z)")
_CALLED = re.compile(rf"{PACKAGE}\s*\.\s*(?:l1_loss|masked|ssim|unweighted)\b".encode())


def restored(name: str, layer: Layer, data: bytes, budget: Budget) -> Tuple[bytes, str]:
    """Put back what stood before a patch in place of what it wrote, everywhere or nowhere; other edits stay.

    Args:
        name: the file, on whose account in ``budget`` the search is.
        layer: the patch.
        data: the file's bytes now.

    Returns:
        The file's bytes; and "", or why they are those of now: what is weighted still, and the lines from before.
    """
    patched = layer.patched
    wrote: Dict[Tuple[int, int], bytes] = {}  # by its place in the patched file what stood there before
    shift = 0
    for edit in layer.edits:
        end = edit.start + shift + len(edit.after.rstrip())
        wrote[end - len(edit.after.strip()), end] = layer.original[edit.start : edit.end]
        shift += len(edit.after) - (edit.end - edit.start)
    places: List[Tuple[int, int, bytes]] = []  # in the file, with what is put there
    missing = {edit.after: edit.start for edit in layer.edits}
    for text in [text for text in missing if PACKAGE.encode() in text]:
        begins = patched.count(_TOKEN.findall(text)[0]) + data.count(_TOKEN.findall(text)[0])
        if budget.spend(name, (len(patched) + len(data) + len(text) * begins) // 32 + 8 * len(text)):
            return data, "it was edited since, and looking for the patched lines takes too long: restore it from git"
        pattern = _pattern(text)
        befores = [wrote.get(found.span()) for found in pattern.finditer(patched)]  # None: of the file's own
        spans = [found.span() for found in pattern.finditer(data)]
        befores = befores[:1] * len(spans) if len(set(befores)) == 1 else befores
        if len(befores) == len(spans):  # else others, which are alike here, were different
            places += [(*span, before) for span, before in zip(spans, befores) if before is not None]
            missing.pop(text) if spans else None
    result = _with(data, sorted(places))
    put = {start + at for start, end, _ in places for at in _names(data[start:end])}
    still = [at for at in _names(data) if at not in put]
    is_whole = all(PACKAGE.encode() in text for text in missing) and len(still) <= len(_names(layer.original))
    if is_whole and (not why_not_compiled(result) or why_not_compiled(data)):
        return result, ""
    weighted, before = _lines(data, still), _lines(layer.original, sorted(missing.values()))
    stays = f"stays weighted ({first_of(weighted, 20, '; ')}); put back {first_of(before, 20, '; ')}"
    return data, f"it was edited since, and {stays}"


def _pattern(text: bytes) -> re.Pattern[bytes]:
    """Return what finds a text as formatters leave it."""
    words = [re.escape(word) for word in _TOKEN.findall(_LAST_COMMA.sub(b"", text))]
    words = [re.sub(rb"['\"]", rb"['\"]", word) if word.endswith((b"'", b'"')) else word for word in words]
    words = [_COMMA + word if word.endswith((b")", b"]", b"}")) else word for word in words]
    if b"lambda" in words:  # ruff puts its body in brackets: to the text's end, or to the call's
        words[words.index(b":", words.index(b"lambda"))] += rb"\s*(?P<open>\()?"
        words.insert(len(words) - (words[0] != b"lambda"), rb"(?(open)\))")
    return re.compile(rb"(?<![\w.])" + _FREE.join(words) + rb"(?!\w)")


def _with(data: bytes, places: Sequence[Tuple[int, int, bytes]]) -> bytes:
    """Return a file with what stood before in these places; of a line that the patch added nothing stays."""
    at, newline = 0, b"\r\n" if b"\r\n" in data else b"\n"
    texts: List[bytes] = []
    for start, end, before in places:
        if start >= at:  # else within another one
            head, rest = data[at:start], _REST_OF_LINE.match(data, end)
            if not before.strip() and rest is not None and head.rstrip(b" \t")[-1:] in (b"", b"\n"):
                head, end = head.rstrip(b" \t"), rest.end()
            texts += [head, before.replace(b"\r\n", b"\n").replace(b"\n", newline)]
            at = end
    return b"".join([*texts, data[at:]])


def _names(text: bytes) -> List[int]:
    """Return where a text names legs_loss, comments and strings aside."""
    return [found.start() for found in _TOKEN.finditer(text) if found.group() == PACKAGE.encode()]


def _lines(text: bytes, places: Sequence[int]) -> List[str]:
    """Return the lines of these bytes of a text, each with its number."""
    lines, breaks = text.split(b"\n"), [found.start() for found in re.finditer(b"\n", text)]
    numbers = [bisect_left(breaks, at) for at in places]
    return [f"line {at + 1}: {lines[at][:400].decode('utf-8', 'ignore').strip()[:200]}" for at in numbers]


def weighted_lines(data: bytes) -> List[str]:
    """Return the lines of a file that name a function of legs_loss which a patch writes, each with its number."""
    return list(dict.fromkeys(_lines(data, [at for at in _names(data) if _CALLED.match(data, at)])))
