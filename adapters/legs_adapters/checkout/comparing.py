"""Compare the lines of two texts in bounded time: some files make a plain diff take days."""

from __future__ import annotations

import difflib
import itertools
import re
from collections import Counter
from typing import Any, List, Mapping, Optional, Sequence, Tuple, TypeVar

__all__ = ["Effort", "matching_lines", "unified_diff"]

_MAX_STEPS = 10_000_000  # lines, and pairs of equal lines, that are looked at in all files: some seconds
_CONTEXT = 3  # lines around a change in a diff
_HUNK = re.compile(r"@@ -(\d+)(.*) \+(\d+)(.*@@\n)", re.S)
_Line = TypeVar("_Line", str, bytes)


class Effort:
    """The steps that comparing the files of one checkout may still take."""

    def __init__(self) -> None:
        self.left: int = _MAX_STEPS

    def matching_blocks(self, before: Sequence[_Line], after: Sequence[_Line]) -> Optional[List[Tuple[int, int, int]]]:
        """Return the blocks that two texts share; None where that takes too many steps."""
        if not before or not after:
            return []
        try:
            return [(block.a, block.b, block.size) for block in _Matcher(self, before, after).get_matching_blocks()]
        except _TooLong:
            return None

    def spend(self, steps: int) -> None:
        """Count steps.

        Raises:
            _TooLong: there are none left.
        """
        if steps > self.left:
            raise _TooLong
        self.left -= steps


class _TooLong(Exception):
    pass


class _Matcher(difflib.SequenceMatcher):
    """Match lines, and count the steps: difflib's are cubic in lines that are alike, or in another order."""

    def __init__(self, effort: Effort, before: Sequence[_Line], after: Sequence[_Line]) -> None:
        effort.spend(len(before) + len(after))
        counts: Mapping[Any, int] = Counter(after)
        self._effort: Effort = effort
        self._steps: List[int] = [0, *itertools.accumulate(1 + counts[line] for line in before)]
        super().__init__(None, before, after, autojunk=False)

    def find_longest_match(self, alo: int = 0, ahi: Any = None, blo: int = 0, bhi: Any = None) -> Any:
        """Find the longest block of equal lines in parts of both texts."""
        self._effort.spend(self._steps[ahi] - self._steps[alo])
        return super().find_longest_match(alo, ahi, blo, bhi)


def matching_lines(before: Sequence[_Line], after: Sequence[_Line], effort: Effort) -> List[Tuple[int, int, int]]:
    """Return the blocks of lines that two texts share, in order: where in each, and how many lines.

    Everything between the first and the last difference counts as different where it is too long or too repetitive
    to be compared.
    """
    head, tail = _ends(before, after)
    middles = before[head : len(before) - tail], after[head : len(after) - tail]
    blocks = [(0, 0, head)]
    blocks += [(head + a, head + b, size) for a, b, size in effort.matching_blocks(*middles) or ()]
    blocks.append((len(before) - tail, len(after) - tail, tail))
    return [block for block in blocks if block[2]]


def unified_diff(before: Sequence[str], after: Sequence[str], names: Tuple[str, str], effort: Effort) -> List[str]:
    """Return the lines of a unified diff of two texts; a single hunk where comparing would take too long."""
    head, tail = _ends(before, after)
    start = max(head - _CONTEXT, 0)
    gone, come = (lines[start : len(lines) - max(tail - _CONTEXT, 0)] for lines in (before, after))
    if effort.matching_blocks(gone, come) is not None:
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
