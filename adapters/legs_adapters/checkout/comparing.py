"""Compare texts that differ in single lines, as a patch leaves them, in one pass: a plain diff may take days."""

from __future__ import annotations

import difflib
from typing import List, Sequence, Tuple, TypeVar

# How many lines to pass over in both texts where they differ, until two are the same again; the fewest first.
_AHEAD = sorted(((i, j) for i in range(6) for j in range(6)), key=sum)[1:]
_Line = TypeVar("_Line", str, bytes)


def compared(before: Sequence[_Line], after: Sequence[_Line]) -> List[Tuple[str, int, int, int, int]]:
    """Return the parts of two texts in turns, "equal" and "replace", as `difflib.SequenceMatcher.get_opcodes` has them.

    A part is its word, the first line and the end in the text before, and in the text after. Texts that differ in more
    than single lines may have larger parts to replace than they need.
    """
    parts: List[Tuple[str, int, int, int, int]] = []
    i = j = 0
    while i < len(before) or j < len(after):
        word, m, n = "equal", 1, 1
        if before[i : i + 1] != after[j : j + 1]:
            ahead = ((m, n) for m, n in _AHEAD if before[i + m : i + m + 2] == after[j + n : j + n + 2])
            word, (m, n) = "replace", next(ahead, (1, 1))
        end, last = min(i + m, len(before)), min(j + n, len(after))
        if parts and parts[-1][0] == word:
            _, i, _, j, _ = parts.pop()
        parts.append((word, i, end, j, last))
        i, j = end, last
    return parts


def unified_diff(before: Sequence[str], after: Sequence[str], names: Tuple[str, str]) -> List[str]:
    """Return the lines of a unified diff of two texts."""
    matcher = difflib.SequenceMatcher()
    matcher.get_opcodes = lambda: compared(before, after)  # type: ignore
    shown = [f"--- {names[0]}\n", f"+++ {names[1]}\n"]
    for hunk in matcher.get_grouped_opcodes():
        (_, at, _, to, _), (_, _, end, _, last) = hunk[0], hunk[-1]
        shown.append(f"@@ -{_range(at, end)} +{_range(to, last)} @@\n")
        for word, start, end, first, last in hunk:
            shown += [f"{' ' if word == 'equal' else '-'}{line}" for line in before[start:end]]
            shown += [f"+{line}" for line in after[first:last] if word != "equal"]
    return shown


def _range(start: int, end: int) -> str:
    """Return lines as a hunk's head has them: the first, from 1, and how many; of none it is the line before."""
    return f"{start + 1}" if end - start == 1 else f"{start + (end > start)},{end - start}"
