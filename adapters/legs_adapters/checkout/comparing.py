"""Compare the lines of two texts in bounded time: some files make a plain diff take days."""

from __future__ import annotations

import difflib
import re
from collections import Counter
from typing import List, Sequence, Tuple, TypeVar

__all__ = ["matching_lines", "unified_diff"]

_LINES, _PAIRS = 100_000, 10_000_000  # of both texts, and of equal lines in them: some seconds
_CONTEXT = 3  # lines around a change in a diff
_HUNK = re.compile(r"@@ -(\d+)(.*) \+(\d+)(.*@@\n)", re.S)
_Line = TypeVar("_Line", str, bytes)


def matching_lines(before: Sequence[_Line], after: Sequence[_Line]) -> List[Tuple[int, int, int]]:
    """Return the blocks of lines that two texts share, in order: where in each, and how many lines.

    Everything between the first and the last difference counts as different where it is too long or too repetitive
    to be compared.
    """
    head, tail = _ends(before, after)
    middles = before[head : len(before) - tail], after[head : len(after) - tail]
    blocks = [(0, 0, head)]
    if _is_affordable(*middles):
        found = difflib.SequenceMatcher(None, *middles, autojunk=False).get_matching_blocks()
        blocks += [(head + block.a, head + block.b, block.size) for block in found]
    blocks.append((len(before) - tail, len(after) - tail, tail))
    return [block for block in blocks if block[2]]


def unified_diff(before: Sequence[str], after: Sequence[str], names: Tuple[str, str]) -> List[str]:
    """Return the lines of a unified diff of two texts; a single hunk where comparing would take too long."""
    head, tail = _ends(before, after)
    start = max(head - _CONTEXT, 0)
    gone, come = (lines[start : len(lines) - max(tail - _CONTEXT, 0)] for lines in (before, after))
    if _is_affordable(gone, come):
        diff = difflib.unified_diff(gone, come, *names, n=_CONTEXT, lineterm="\n")
        return [_shifted(line, start) for line in diff]
    where = f"@@ -{start + 1},{len(gone)} +{start + 1},{len(come)} @@\n"
    changed = [f"-{line}" for line in gone] + [f"+{line}" for line in come]
    return [f"--- {names[0]}\n", f"+++ {names[1]}\n", where, *changed]


def _shifted(line: str, by: int) -> str:
    """Return a line of a diff, with the line numbers of a hunk's header shifted."""
    found = _HUNK.fullmatch(line)
    return f"@@ -{int(found[1]) + by}{found[2]} +{int(found[3]) + by}{found[4]}" if found is not None else line


def _ends(before: Sequence[_Line], after: Sequence[_Line]) -> Tuple[int, int]:
    """Return how many lines two texts share at their starts, and how many more at their ends."""
    shorter = min(len(before), len(after))
    head = next((i for i in range(shorter) if before[i] != after[i]), shorter)
    tail = next((i for i in range(shorter - head) if before[-1 - i] != after[-1 - i]), shorter - head)
    return head, tail


def _is_affordable(before: Sequence[_Line], after: Sequence[_Line]) -> bool:
    if len(before) + len(after) > _LINES:
        return False
    counts = Counter(after)
    return sum(count * counts[line] for line, count in Counter(before).items()) <= _PAIRS
