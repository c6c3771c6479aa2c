"""Compare texts that differ in single lines, as a patch leaves them, in one pass: a plain diff may take days."""

from __future__ import annotations

from typing import List, Sequence, Tuple, TypeVar

__all__ = ["changed_lines", "unified_diff"]

_CONTEXT = 3  # lines around a change in a diff
# How many lines to pass over in both texts where they differ, until two are the same again; the fewest first.
_AHEAD = sorted(((i, j) for i in range(6) for j in range(6)), key=sum)[1:]
_Line = TypeVar("_Line", str, bytes)


def changed_lines(before: Sequence[_Line], after: Sequence[_Line]) -> List[Tuple[int, int, int, int]]:
    """Return the parts that differ: the first line and the end in the text before, and in the text after.

    Texts that differ in more than single lines may have larger parts than they need.
    """
    changed: List[Tuple[int, int, int, int]] = []
    i = j = 0
    while i < len(before) or j < len(after):
        if before[i : i + 1] == after[j : j + 1]:
            i, j = i + 1, j + 1
            continue
        ahead = ((m, n) for m, n in _AHEAD if before[i + m : i + m + 2] == after[j + n : j + n + 2])
        skipped, added = next(ahead, (1, 1))
        end, last = min(i + skipped, len(before)), min(j + added, len(after))
        if changed and changed[-1][1::2] == (i, j):
            i, _, j, _ = changed.pop()
        changed.append((i, end, j, last))
        i, j = end, last
    return changed


def unified_diff(before: Sequence[str], after: Sequence[str], names: Tuple[str, str]) -> List[str]:
    """Return the lines of a unified diff of two texts."""
    hunks: List[List[Tuple[int, int, int, int]]] = []
    for change in changed_lines(before, after):
        if not hunks or change[0] - hunks[-1][-1][1] > 2 * _CONTEXT:
            hunks.append([])
        hunks[-1].append(change)
    shown = [f"--- {names[0]}\n", f"+++ {names[1]}\n"]
    for hunk in hunks:
        head, tail = min(_CONTEXT, hunk[0][0]), min(_CONTEXT, len(before) - hunk[-1][1])
        at, end = hunk[0][0] - head, hunk[-1][1] + tail
        shown.append(f"@@ -{_range(at, end)} +{_range(hunk[0][2] - head, hunk[-1][3] + tail)} @@\n")
        for start, stop, first, last in [*hunk, (end, end, 0, 0)]:
            shown += [f" {line}" for line in before[at:start]] + [f"-{line}" for line in before[start:stop]]
            shown += [f"+{line}" for line in after[first:last]]
            at = stop
    return shown


def _range(start: int, end: int) -> str:
    """Return lines as a hunk's head has them: the first, from 1, and how many; of none it is the line before."""
    return f"{start + 1}" if end - start == 1 else f"{start + (end > start)},{end - start}"
